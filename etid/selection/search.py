"""Search among candidate circuits: from the usual one to where the data ask to go.

The first candidate is fitted to all recordings. A richer one is fitted if the score tests of the
fit, which cost no further fit, show a change that its circuit cannot make; first only those with
the fewest elements. A simpler one is fitted if an element is hardly determined. An ordinary
recording thus needs one fit.
"""

from collections.abc import Callable, Sequence

import numpy as np

from etid.circuits.circuit import (
    AbstractCircuit,
    ParallelRC,
    Resistor,
    SkinCole,
    SkinLayers,
    SkinRC,
)
from etid.results.fits import Fit
from etid.selection.evidence import best, elements, rank, values_of

# From the usual circuit to the unusual ones.
CANDIDATES: tuple[AbstractCircuit, ...] = (
    SkinRC(),
    ParallelRC(),
    Resistor(),
    SkinCole(),
    SkinLayers(),
)
# Standard deviations of a score that asks for a richer circuit. The evidence needs 2.8 for one more
# element; the score is not the ratio of likelihoods exactly.
ASKS = 2.5
# Relative standard error of an element that asks for a simpler circuit: an element of seven
# standard errors has the evidence 49, more than its penalty by far.
DOUBTFUL = 1 / 7
FitRows = Callable[[int, Sequence[int]], Sequence[Fit]]


def search(count: int, candidates: Sequence[AbstractCircuit], fit: FitRows) -> list[dict[int, Fit]]:
    """Fits of the candidates that each recording asks for, by number of the candidate.

    Args:
        count: Number of recordings.
        candidates: Circuits; the search starts at the first one.
        fit: Fits the candidate of a number to some recordings.
    """
    found = [{0: one} for one in fit(0, range(count))]
    while True:
        wanted: dict[int, list[int]] = {}
        for row, fits in enumerate(found):
            for number in _asked(fits, candidates):
                wanted.setdefault(number, []).append(row)
        if not wanted:
            return found
        for number, rows in wanted.items():
            for row, one in zip(rows, fit(number, rows), strict=True):
                found[row][number] = one


def _asked(fits: dict[int, Fit], candidates: Sequence[AbstractCircuit]) -> list[int]:
    """Numbers of the candidates to fit next; none if the search ends."""
    left = [number for number in range(len(candidates)) if number not in fits]
    if not left:
        return []
    fit = fits[best(fits)]
    size = {number: len(candidates[number].names()) for number in left}
    own = elements(fit)
    asked = []
    richer = [number for number in left if size[number] >= own]
    if richer and _lacks(fit):
        least = min(size[number] for number in richer)
        asked += [number for number in richer if size[number] == least]
    if _is_doubtful(fit):
        asked += [number for number in left if size[number] < own]
    return asked


def _lacks(fit: Fit) -> bool:
    """Whether the scores show a change that the circuit cannot make."""
    if fit.support is None:
        return False
    z = np.array(fit.support.z[:-1])  # without that of a gain
    # A negative score means less spread than a capacitor has, α > 1, which is not passive.
    z[0] = max(z[0], 0.0)
    return rank(fit) == 2 or bool(np.nanmax(np.abs(z), initial=0.0) > ASKS)


def _is_doubtful(fit: Fit) -> bool:
    """Whether an element may be superfluous."""
    errors = np.sqrt(np.diagonal(np.asarray(fit.cov)))
    # An error of 0 belongs to an element without any effect.
    return rank(fit) == 1 or not bool(((errors > 0) & (errors < DOUBTFUL * values_of(fit))).all())
