"""The worst fits of a study, and the reasons why they are chosen."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from etid.results.fits import Fits

FAILED, STRAINED, UNCERTAIN = 6, 3, 3  # largest number of fits of each kind


@dataclasses.dataclass(frozen=True)
class Worst:
    """One of the worst fits.

    Attributes:
        row: Row of the fit.
        reason: Why the fit is chosen.
    """

    row: int
    reason: str


def relative_stderr(fits: Fits) -> np.ndarray:
    """Largest relative standard error of the elements of each fit; NaN if one is NaN or both 0."""
    with np.errstate(all="ignore"):  # an element without effect may be 0, a failed fit anything
        stacked = np.stack(
            [
                np.asarray(getattr(fits.stderr, name))
                / np.abs(np.asarray(getattr(fits.circuit, name)))
                for name in fits.circuit.names()
            ]
        )
    return np.where(np.isnan(stacked).any(axis=0), np.nan, stacked.max(axis=0))


def choose(fits: Fits) -> list[Worst]:
    """The worst fits: without success, then the largest χ², then the largest standard error.

    The fits without success have different verdicts if possible, frequent verdicts first. One cause
    with many recordings therefore does not hide another. Among the fits with one verdict, the
    largest χ² comes first.
    """
    names = fits.verdicts
    chi2 = np.where(np.isfinite(fits.chi2), fits.chi2, -np.inf)
    failing = [
        _largest(np.flatnonzero(names == name), chi2)
        for name in fits.counts()
        if name != "successful"
    ]
    taken = [Worst(row, "without success") for row in _in_turn(failing, FAILED)]
    good = np.flatnonzero(names == "successful")
    for size, count, reason in (
        (chi2, STRAINED, "largest χ² among the successful"),
        (relative_stderr(fits), UNCERTAIN, "largest standard error among the successful"),
    ):
        seen = {one.row for one in taken}
        known = good[np.isfinite(size[good])]
        left = [row for row in _largest(known, size) if row not in seen]
        taken += [Worst(row, reason) for row in left[:count]]
    return taken


def _largest(rows: np.ndarray, size: np.ndarray) -> list[int]:
    """The first rows in descending order of size; rows of equal size keep their order."""
    order = np.argsort(-size[rows], kind="stable")[: FAILED + STRAINED + UNCERTAIN]
    return rows[order].tolist()


def _in_turn(queues: Iterable[list[int]], count: int) -> list[int]:
    """The first row of each queue, then the second of each, and so on; at most `count`."""
    ranked = [(place, i, row) for i, queue in enumerate(queues) for place, row in enumerate(queue)]
    return [row for _, _, row in sorted(ranked)][:count]
