"""Bounds of the elements of a fit, and how far an estimate without them lies outside."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.display import quantity


class Limited(eqx.Module):
    """Bounds of the elements of a fit, or of a batch of fits.

    Attributes:
        lower: Lower bounds [SI]; 0 without one.
        upper: Upper bounds [SI]; infinite without one.
        outside: Distance from its bounds of each element as it would be without them [standard
            errors]: negative below the lower one, positive above the upper one, 0 inside.
    """

    lower: Float[Array | np.ndarray, "*lane parameter"]
    upper: Float[Array | np.ndarray, "*lane parameter"]
    outside: Float[Array | np.ndarray, "*lane parameter"]

    def text(self, units: Mapping[str, str]) -> str:
        """A sentence that names the elements outside and their bounds; empty if there are none.

        Args:
            units: SI units of the elements by name.
        """
        found = []
        for row, (name, unit) in enumerate(units.items()):
            by = float(self.outside[row])
            if not abs(by) > 0:  # NaN where a fit failed
                continue
            bound, where = (self.lower, "below") if by < 0 else (self.upper, "above")
            end = quantity(float(bound[row]), unit)
            found.append(f"{name} would be {abs(by):.1f} standard errors {where} {end}")
        return f"Without bounds, {' and '.join(found)}." if found else ""
