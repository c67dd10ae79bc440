"""One circuit for all recordings of a study, so that groups can be compared.

The joint evidence of a circuit is the sum over the recordings. No recording counts more than
`LIMIT`: one disturbed recording must not decide for all others.
"""

import math
from collections.abc import Sequence

from etid.circuits.circuit import AbstractCircuit
from etid.selection.evidence import best, bic, elements, first_alike, rank
from etid.selection.selection import Selection

LIMIT = 20.0  # largest loss of 2 log evidence by one recording; "very strong" begins at 10


def common(found: Sequence[Selection], candidates: Sequence[AbstractCircuit]) -> int:
    """Number of the candidate with the largest joint evidence; 0 if nothing is known.

    Of candidates with equally many elements it is the first that fits alike, as for one recording.
    """
    if all(len(selection.fits) == 1 for selection in found):
        return 0  # no recording asked for another circuit than the first
    known = [one for one in found if math.isfinite(bic(one.fits)[one.chosen])]
    # Recordings that no circuit explains count only if no circuit explains any.
    chosen = [(one, one.fits[one.chosen]) for one in known]
    explained = [one for one, fit in chosen if rank(fit) < 2 and fit.verdict != "changed"]
    total = [0.0] * len(candidates)
    for selection in explained or known:
        for number, lost in enumerate(_losses(selection, candidates)):
            total[number] -= min(lost, LIMIT)
    numbers = range(len(candidates))
    size = {number: len(candidates[number].names()) for number in numbers}
    lost = {number: -total[number] for number in numbers}
    return first_alike(min(numbers, key=lost.__getitem__), numbers, size, lost)


def _losses(selection: Selection, candidates: Sequence[AbstractCircuit]) -> list[float]:
    """2 log evidence that each candidate loses against the chosen one.

    A richer circuit that was not fitted is not likelier than the chosen one: it loses the penalty
    of its elements. A simpler one that was not fitted lacks an element that is surely there.
    """
    fits = selection.fits
    mine, criterion = fits[selection.chosen], bic(fits)
    least, own = criterion[selection.chosen], elements(mine)
    lost = []
    for number, circuit in enumerate(candidates):
        more = len(circuit.names()) - own
        if number in fits:
            contradicted = rank(fits[number]) > max(rank(mine), 1)
            lost.append(math.inf if contradicted else criterion[number] - least)
        elif more > 0 and mine.support is not None:
            lost.append(more * math.log(float(mine.support.terms)))
        else:
            lost.append(math.inf)
    return lost


def deserves(selection: Selection, chosen: int) -> str:
    """A sentence if a recording deserves another circuit than the common one; otherwise empty.

    The fits of the recording contain that of the common circuit, whose number is `chosen`.
    """
    criterion = bic(selection.fits)
    own = best(selection.fits, criterion)
    gained = criterion[chosen] - criterion[own]
    name = type(selection.fits[own].circuit).__name__
    if own == chosen or rank(selection.fits[own]) or gained < 10:  # less than "very strong"
        return ""
    return f"The recording supports {name} better: 2 log evidence +{gained:.0f}."
