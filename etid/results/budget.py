"""What each source of error adds to the standard errors of a fit."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from etid.circuits.overview import Overview, Overviewed

# What the rows of errors that nobody stated are for [relative, F].
EXAMPLES = {"gain": 1e-3, "r_load": 1e-3, "crosstalk": 1e-3, "capacitance": 1e-12}


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
            stated, of the size in `EXAMPLES`.
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
            shown[f"if {_named(source, EXAMPLES[source])}"] = change
        rows = [(name, *(f"± {100 * of:.2g} %" for of in part)) for name, part in shown.items()]
        return Overview("Budget of the standard errors", rows, ("", *self.names))
