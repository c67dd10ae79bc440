"""What an instrument may do that no recording shows: a budget of stated tolerances."""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_Number = float | Float[Array | np.ndarray, ""]
_Kind = TypeVar("_Kind", bound="Instrument")

# Largest possible value of each field; a larger one has a wrong unit.
LARGEST = {"gain": 1.0, "r_load": 1.0, "crosstalk": 1.0, "capacitance": 1e-7}


class Instrument(eqx.Module):
    """Standard deviations of errors of the instrument, each of mean 0 and independent.

    Some errors change a recording almost as the elements do: at 60 dB 0.1 % of gain moves R_p of
    dry skin by 2 %, and χ² stays 1. What is known of them comes from a data sheet (JCGM 100, the
    GUM: type B). The fit estimates each error with its elements, so that the standard errors
    contain it, as far as the recording does not determine it.

    Attributes:
        gain: Of the gain of V_out relative to that of V_th, in all recordings [relative].
        r_load: Of each known resistor [relative].
        crosstalk: Of the part of V_th that V_out shows in all recordings [relative].
        capacitance: Of a capacitance across the skin that the calibrations did not have [F].
    """

    gain: _Number = 0.0
    r_load: _Number = 0.0
    crosstalk: _Number = 0.0
    capacitance: _Number = 0.0

    def __check_init__(self) -> None:
        for name, largest in LARGEST.items():
            value = getattr(self, name)
            if isinstance(value, int | float) and not 0 <= value < largest:
                unit = "F" if name == "capacitance" else "relative to the value"
                raise ValueError(
                    f"{name} of an instrument is {value!r}; it is a standard deviation [{unit}], "
                    f"at least 0 and below {largest:g}"
                )

    def of_loads(self) -> Float[Array, "3"]:
        """Standard deviations of gain, crosstalk and capacitance, which change loads directly."""
        return jnp.stack([jnp.asarray(of) for of in (self.gain, self.crosstalk, self.capacitance)])

    def stored(self) -> dict[str, float]:
        """The numbers by name."""
        return {name: float(getattr(self, name)) for name in LARGEST}

    def as_arrays(self: _Kind) -> _Kind:
        """The same with arrays, which a traced program takes as operands."""
        return type(self)(**{name: np.asarray(value) for name, value in self.stored().items()})
