"""Evidence for the orders of a driver that `order="auto"` tried."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

Order = int | Literal["auto"]
AUTO: Literal["auto"] = "auto"
# A transformer has a slow pole (magnetising inductance), a resonance (leakage inductance and
# winding capacitance), and faster poles at the edge of the band. At 40 dB noise hides these from
# every test, and yet they shift elements by more than a standard error if the driver has no pole
# for them (`python -m benchmarks driver_order`). Four is therefore the least order.
LEAST, LARGEST = 4, 8


class OrderEvidence(eqx.Module):
    """Evidence of the calibrations for each order that `order="auto"` tried.

    The arrays have one place for each order from `LEAST` to `LARGEST`. Drivers therefore share
    compiled functions, however many orders were tried.

    Attributes:
        bic: Schwarz's criterion; NaN if the order was not tried.
        missing_pole: Largest score statistic of one more section; NaN if the order was not tried.
        adequate: Whether the driver of this order was successful.
    """

    bic: Float[Array | np.ndarray, " order"]
    missing_pole: Float[Array | np.ndarray, " order"]
    adequate: Bool[Array | np.ndarray, " order"]

    @classmethod
    def none(cls) -> "OrderEvidence":
        """No order was tried, because the user chose it."""
        empty = np.full(LARGEST - LEAST + 1, np.nan)
        return cls(empty, empty, np.zeros(empty.shape, bool))

    @property
    def orders(self) -> list[int]:
        """The orders that were tried."""
        return (LEAST + np.flatnonzero(~np.isnan(self.bic))).tolist()

    @np.errstate(over="ignore", invalid="ignore")  # a driver that failed may hold any number
    def __str__(self) -> str:
        """One line; empty if no order was tried."""
        if not self.orders:
            return ""
        least = min(self.bic[order - LEAST] for order in self.orders)
        found = [
            f"{order} {self.bic[order - LEAST] - least:+.3g}"
            + ("" if self.adequate[order - LEAST] else " (not adequate)")
            for order in self.orders
        ]
        return f"orders tried and their BIC above the least: {', '.join(found)}"
