"""Search among candidate circuits: from the usual one to where the data ask to go.

The first candidate is fitted to all recordings. If the score tests of the fit, which cost no
further fit, show a change that its circuit cannot make, all candidates with as many or more
elements are fitted: the weight of a circuit means nothing while a likelier one may be missing. The
simpler ones are fitted if an element is hardly determined. An ordinary recording thus needs one
fit.
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
    SkinWarburg,
)
from etid.results.fit import Fit
from etid.selection.evidence import best, rank, values_of

# From the usual circuit to the unusual ones. Classes, because the elements of a circuit are arrays:
# to make one starts JAX, which no import may do.
USUAL: tuple[type[AbstractCircuit], ...] = (
    SkinRC,
    ParallelRC,
    Resistor,
    SkinCole,
    SkinLayers,
    SkinWarburg,
)
# Standard deviations of a score that asks for another circuit. The evidence needs 2.8 for one more
# element; the score is not the ratio of likelihoods exactly.
ASKS = 2.5
# Relative standard error of an element that asks for a simpler circuit: an element of seven
# standard errors has the evidence 49, more than its penalty by far.
DOUBTFUL = 1 / 7
FitRows = Callable[[int, Sequence[int]], Sequence[Fit]]


def usual_circuits() -> tuple[AbstractCircuit, ...]:
    """The candidates of a choice that names none."""
    return tuple(kind() for kind in USUAL)


def search(count: int, candidates: Sequence[AbstractCircuit], fit: FitRows) -> list[dict[int, Fit]]:
    """Fits of the candidates that each recording asks for, by number of the candidate.

    Args:
        count: Number of recordings.
        candidates: Circuits; the search starts at the first one.
        fit: Fits the candidate of a number to some recordings.
    """
    size = [len(circuit.names()) for circuit in candidates]
    found = [{0: one} for one in fit(0, range(count))]
    while True:
        wanted: dict[int, list[int]] = {}
        for row, fits in enumerate(found):
            for number in _asked(fits, size):
                wanted.setdefault(number, []).append(row)
        if not wanted:
            return found
        for number, rows in wanted.items():
            for row, one in zip(rows, fit(number, rows), strict=True):
                found[row][number] = one


def _asked(fits: dict[int, Fit], size: Sequence[int]) -> list[int]:
    """Numbers of the candidates to fit next; none if the search ends.

    Args:
        fits: The fits so far, by number of the candidate.
        size: Number of elements of each candidate.
    """
    left = [number for number in range(len(size)) if number not in fits]
    if not left:
        return []
    number = best(fits)
    fit, own = fits[number], size[number]
    accepted = rank(fit)
    asked = []
    if accepted == 2 or _lacks(fit) > ASKS:
        asked += [number for number in left if size[number] >= own]
    if accepted == 1 or _is_doubtful(fit):
        asked += [number for number in left if size[number] < own]
    return asked


def _lacks(fit: Fit) -> float:
    """Largest score of the changes that the circuit cannot make [standard deviations]."""
    if fit.support is None:
        return 0.0
    z = np.array(fit.support.z[:-1])  # without that of a gain
    # A negative score means less spread than a capacitor has, α > 1, which is not passive.
    z[0] = max(z[0], 0.0)
    return float(np.nanmax(np.abs(z), initial=0.0))


def _is_doubtful(fit: Fit) -> bool:
    """Whether an element may be superfluous."""
    errors = np.sqrt(np.diagonal(np.asarray(fit.cov)))
    # An error of 0 belongs to an element without any effect.
    return not bool(((errors > 0) & (errors < DOUBTFUL * values_of(fit))).all())
