"""Errors of an instrument that no recording shows, and what each adds to the standard errors."""

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.overview import Overview, Overviewed

_Number = float | Float[Array | np.ndarray, ""]
_Kind = TypeVar("_Kind", bound="Instrument")

# Largest possible value of each tolerance, above which it has a wrong unit; and the value for which
# a budget shows the effect of an error that nobody stated [relative, F].
TOLERANCES = {
    "gain": (1.0, 1e-3),
    "r_load": (1.0, 1e-3),
    "crosstalk": (1.0, 1e-3),
    "capacitance": (1e-7, 1e-12),
}
NARROW = 1e-3  # of a tolerance that nobody stated: a prior that no recording changes


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
        for name, (largest, _) in TOLERANCES.items():
            value = getattr(self, name)
            if isinstance(value, int | float) and not 0 <= value < largest:
                unit = "F" if name == "capacitance" else "relative to the value"
                raise ValueError(
                    f"{name} of an instrument is {value!r}; it is a standard deviation [{unit}], "
                    f"at least 0 and below {largest:g}"
                )

    def deviations(self, resistors: int) -> Float[Array, " error"]:
        """Standard deviations of gain, crosstalk, capacitance, and of each known resistor."""
        of_loads = self.gain, self.crosstalk, self.capacitance  # change loads directly
        return jnp.stack([jnp.asarray(of) for of in (*of_loads, *[self.r_load] * resistors)])

    def narrow(self: _Kind) -> _Kind:
        """The same with a small deviation for each tolerance that nobody stated, for a budget."""
        told = self.stored()
        narrow = {name: told[name] or NARROW * size for name, (_, size) in TOLERANCES.items()}
        return type(self)(**narrow).as_arrays()

    def stored(self) -> dict[str, float]:
        """The numbers by name."""
        return {name: float(getattr(self, name)) for name in TOLERANCES}

    def as_arrays(self: _Kind) -> _Kind:
        """The same with arrays, which a traced program takes as operands."""
        return type(self)(**{name: np.asarray(value) for name, value in self.stored().items()})


def by_tolerance(effects: Float[Array, "error element"]) -> Float[Array, "tolerance element"]:
    """Size of the effect of each of `TOLERANCES`; the errors are those of `deviations`."""
    gain, crosstalk, capacitance = jnp.abs(effects[:3])
    r_load = jnp.sqrt(jnp.sum(effects[3:] ** 2, axis=0))  # the resistors are independent
    return jnp.stack([gain, r_load, crosstalk, capacitance])


def _named(source: str, size: float) -> str:
    """A source with its size, as in "gain 0.1 %"."""
    return (
        f"{source} {size * 1e12:g} pF" if source == "capacitance" else f"{source} {100 * size:g} %"
    )


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Budget(Overviewed):
    """The uncertainty budget of a fit (JCGM 100, the GUM). All numbers are relative.

    Attributes:
        names: The elements.
        parts: Standard deviation that each source adds to each element, by the source: the
            recording, its driver (noise of the calibrations, and drift), and each stated tolerance
            of the instrument.
        tolerances: The stated tolerances [relative, F].
        unstated: Size of the change of each element by an error of the instrument that nobody
            stated, of the size in `TOLERANCES`.
    """

    names: tuple[str, ...]
    parts: Mapping[str, Float[np.ndarray, " element"]]
    tolerances: Mapping[str, float]
    unstated: Mapping[str, Float[np.ndarray, " element"]]

    @property
    def together(self) -> Float[np.ndarray, " element"]:
        """Relative standard errors of the elements, from all sources."""
        return np.sqrt(sum(part**2 for part in self.parts.values()))

    def _overview(self) -> Overview:
        shown = dict[str, Float[np.ndarray, " element"]]()
        for source, part in self.parts.items():
            size = self.tolerances.get(source)
            shown[source if size is None else _named(source, size)] = part
        shown["together"] = self.together
        for source, change in self.unstated.items():
            shown[f"if {_named(source, TOLERANCES[source][1])}"] = change
        rows = [(name, *(f"± {100 * of:.2g} %" for of in part)) for name, part in shown.items()]
        return Overview("Budget of the standard errors", rows, ("", *self.names))
