"""An order of a driver whose standard errors contain what the choice of an order leaves open.

The calibrations decide; no skin is needed. Orders are fitted from `FIRST` upwards. Each is judged
by the criterion of Schwarz (1978),

    BIC = Σ r² + k ln n,

with k unknowns and n terms r of unit variance. One more pole costs two unknowns, 2 ln n. The score
test for a missing pole predicts by how much one more section would lower Σ r², before a driver
with that section is fitted. The search therefore stops at the first order where this is less than
the price of a pole: the next order is then not even fitted.

**Why it begins so high.** A Z_th with too few poles fixes the delay of a calibration with one
resistor by its shape, and no test of the calibrations sees this. At 50 dB, C_p is up to 4.6
standard errors off with order 4; with order 5, R_s and C_p are 3 to 6 off behind a transformer with
a second, weak resonance. Weights by BIC do not help, because the poorer order has all the weight:
the data hardly tell of the pole, and its price is 16. But an order contains all lower ones, since a
section with ζ > 1 is two real poles and gains may be 0. Poles that the calibrations do not
determine are then part of the covariance of Z_th, and so of the standard errors of skin. They cost
little: behind transformers without a second resonance the errors of the elements are 0 to 2 %
larger than with order 5 (`python -m benchmarks driver_order`).
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from etid.results.driver import LARGEST, LEAST, OrderEvidence

# A transformer has a slow pole (magnetising inductance), a resonance (leakage inductance and
# winding capacitance), and two faster poles at the edge of the band. One more section is what the
# calibrations may not show.
FIRST = 7


@dataclasses.dataclass(frozen=True)
class TriedOrder:
    """A fitted order.

    Attributes:
        order: Number of poles of Z_th.
        squares: Σ r² at the minimum, with the priors.
        unknowns: k.
        terms: n.
        missing_pole: Largest score statistic of one more section.
        adequate: Whether the driver of this order is successful.
    """

    order: int
    squares: float
    unknowns: int
    terms: int
    missing_pole: float
    adequate: bool

    @property
    def bic(self) -> float:
        """The criterion; infinite if the fit gave no number."""
        found = self.squares + self.unknowns * math.log(self.terms)
        return found if math.isfinite(found) else math.inf

    @property
    def asks_for_more(self) -> bool:
        """Whether one more section would lower Σ r² by more than a pole costs."""
        return not self.missing_pole <= 2 * math.log(self.terms)


def best(tried: Sequence[TriedOrder]) -> TriedOrder:
    """The adequate order with the smallest BIC; if none is adequate, the smallest BIC of all."""
    adequate = [one for one in tried if one.adequate]
    return min(adequate or tried, key=lambda one: one.bic)


def next_order(tried: Sequence[TriedOrder]) -> int | None:
    """The next order to fit, of those above the last of `tried`; None if the search is over."""
    if not tried:
        return FIRST
    last = tried[-1]
    satisfied = last.adequate and not last.asks_for_more
    return None if satisfied or last.order == LARGEST else last.order + 1


def evidence(tried: Sequence[TriedOrder]) -> OrderEvidence:
    """The evidence for all orders, as a driver keeps it."""
    found = OrderEvidence.none()
    bic, missing_pole, adequate = map(np.array, (found.bic, found.missing_pole, found.adequate))
    for one in tried:
        place = one.order - LEAST
        bic[place], missing_pole[place], adequate[place] = one.bic, one.missing_pole, one.adequate
    return OrderEvidence(bic, missing_pole, adequate)
