"""What the fits search for, by name.

A solver sees one vector. Its order is known to `of` and `vector` here, and nowhere else.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class LoadUnknowns(eqx.Module):
    """What is unknown of a load and its recording; several may be stacked along leading axes.

    Attributes:
        log_elements: Logarithms of the elements of the circuit [SI].
        delay_samples: Trigger delay of the recording [samples].
    """

    log_elements: Float[Array, "*lane element"]
    delay_samples: Float[Array, "*lane"]

    @classmethod
    def of(cls, vector: Float[Array, "*lane own"]) -> "LoadUnknowns":
        """From the vector of a solver, or from other numbers in its order along the last axis."""
        return cls(vector[..., :-1], vector[..., -1])

    def vector(self) -> Float[Array, "*lane own"]:
        """For a solver."""
        return jnp.concatenate([self.log_elements, self.delay_samples[..., None]], axis=-1)


class Nuisance(eqx.Module):
    """What is unknown of a recording in time, besides its load; several may be stacked.

    Attributes:
        state: State of the loaded driver at the first sample.
        offset: Of V_out [V].
        delay_samples: Trigger delay of the recording [samples].
    """

    state: Float[Array, "*lane state"]
    offset: Float[Array, "*lane"]
    delay_samples: Float[Array, "*lane"]

    @classmethod
    def of(cls, vector: Float[Array, "*lane nuisance"]) -> "Nuisance":
        """From the vector of a solver."""
        return cls(vector[..., :-2], vector[..., -2], vector[..., -1])

    def vector(self) -> Float[Array, "*lane nuisance"]:
        """For a solver."""
        last = jnp.stack([self.offset, self.delay_samples], axis=-1)
        return jnp.concatenate([self.state, last], axis=-1)


class DriverUnknowns(eqx.Module):
    """What is unknown of a driver and its calibrations.

    Attributes:
        source: Parameters of Z_th, flattened in field order.
        delay_samples: Trigger delay of each calibration [samples].
    """

    source: Float[Array, " source"]
    delay_samples: Float[Array, " record"]

    @classmethod
    def of(cls, vector: Float[Array, " common"], records: int) -> "DriverUnknowns":
        """From the vector of a solver."""
        return cls(vector[:-records], vector[-records:])

    def vector(self) -> Float[Array, " common"]:
        """For a solver."""
        return jnp.concatenate([self.source, self.delay_samples])
