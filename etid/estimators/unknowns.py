"""The unknowns of the fits, by name.

A solver uses one vector. Only `of` and `vector` of these classes know its order.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LoadUnknowns(eqx.Module):
    """Unknowns of a load and its recording; several can be stacked along leading axes.

    Attributes:
        log_elements: Logarithms of the elements of the circuit [SI].
        delay_samples: Trigger delay of V_out [samples].
        current_delay_samples: That of a current that was measured beside V_th; None without.
    """

    log_elements: Float[Array, "*lane element"]
    delay_samples: Float[Array, "*lane"]
    current_delay_samples: Float[Array, "*lane"] | None = None

    @classmethod
    def of(cls, vector: Float[Array, "*lane own"], with_current: bool = False) -> "LoadUnknowns":
        """The unknowns, or other numbers by name, from a vector in the solver's order."""
        if with_current:
            return cls(vector[..., :-2], vector[..., -2], vector[..., -1])
        return cls(vector[..., :-1], vector[..., -1])

    def delays(self) -> tuple[Any, ...]:
        """The delays of V_out and of the current [samples]."""
        each = (self.delay_samples, self.current_delay_samples)
        return tuple(one for one in each if one is not None)

    def vector(self) -> Float[Array, "*lane own"]:
        """The vector for a solver."""
        return jnp.concatenate([self.log_elements, jnp.stack(self.delays(), axis=-1)], axis=-1)
