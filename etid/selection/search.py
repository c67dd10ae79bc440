"""Search among candidate circuits: from the usual one to where the data ask to go.

The first candidate is fitted to all recordings. If the score tests of the fit, which cost no
further fit, show a change that its circuit cannot make, all candidates with as many or more
elements are fitted: the weight of a circuit means nothing while a likelier one may be missing. The
simpler ones are fitted if an element is hardly determined. Those with as many elements are fitted
where noise could hide them from the tests: behind damp skin at 40 dB, a layer through which charge
diffuses looks like R_s + R_p ‖ C_p with half more R_s. The fit tells how much such a layer would
show. Dry skin at 40 dB thus needs one fit. Records of millions of samples end the search after
`PATIENCE`, with what was found so far.
"""

import time
from collections.abc import Callable, Mapping, Sequence

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
ASKS = 2.8
# Relative standard error of an element that asks for simpler circuits, and for those with as many
# elements: an element of seven standard errors has the evidence 49, more than its penalty by far.
DOUBTFUL = 1 / 7
# Standard deviations that a layer of diffusion would show, from which on it cannot hide: the
# evidence for or against it is their square, and `ASKS` of them ask for it.
SHOWS = 6.0
PATIENCE = 60.0  # [s] for each recording, after which no further candidate is fitted
FitRows = Callable[[int, Sequence[int]], Sequence[Fit]]


def usual_circuits() -> tuple[AbstractCircuit, ...]:
    """The candidates of a choice that names none."""
    return tuple(kind() for kind in USUAL)


def search(count: int, candidates: Sequence[AbstractCircuit], fit: FitRows) -> list[dict[int, Fit]]:
    """Fits of the candidates that each recording asks for, by number of the candidate.

    `fit` fits the candidate of a number to some of the recordings. The search starts at the first.
    """
    begin, patience = time.monotonic(), PATIENCE * count
    found = [{0: one} for one in fit(0, range(count))]
    while True:
        wanted: dict[int, list[int]] = {}
        for row, fits in enumerate(found):
            for number in asked(fits, candidates):
                wanted.setdefault(number, []).append(row)
        if not wanted:
            return found
        for number, rows in wanted.items():
            if time.monotonic() - begin > patience:
                return found
            for row, one in zip(rows, fit(number, rows), strict=True):
                found[row][number] = one


def asked(fits: Mapping[int, Fit], candidates: Sequence[AbstractCircuit]) -> list[int]:
    """Numbers of the candidates to fit next, after these fits; none if the search ends."""
    size = [len(circuit.names()) for circuit in candidates]
    left = [number for number in range(len(size)) if number not in fits]
    left.sort(key=lambda number: size[number])  # time may end the search, so simple ones first
    if not left:
        return []
    number = best(fits)
    fit, own = fits[number], size[number]
    accepted, known = rank(fit), _is_known(fit)
    more = []
    if accepted == 2 or _lacks(fit) > ASKS:
        more += [number for number in left if size[number] >= own]
    elif not known or fit.support is None or not fit.support.layer_shows > SHOWS:
        more += [number for number in left if size[number] == own]
    if accepted == 1 or not known:
        more += [number for number in left if size[number] < own]
    return more


def _lacks(fit: Fit) -> float:
    """Largest score of the changes that the circuit cannot make [standard deviations]."""
    if fit.support is None:
        return 0.0
    # A negative score means less spread than a capacitor has, α > 1, which is not passive.
    spread = np.maximum(fit.support.of("spread"), 0.0)
    every = np.append(spread, fit.support.of("relaxation"))
    return float(np.nanmax(np.abs(every), initial=0.0))


def _is_known(fit: Fit) -> bool:
    """Whether the standard error of each element is less than `DOUBTFUL`."""
    errors = np.sqrt(np.diagonal(np.asarray(fit.cov)))
    # An error of 0 belongs to an element without any effect.
    return bool(((errors > 0) & (errors < DOUBTFUL * values_of(fit))).all())
