"""The circuit that a recording supports, and the candidates that were compared."""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.printing import Overview, Overviewed, several
from etid.recordings.remarks import Remark
from etid.results.fit import Fit
from etid.results.verdicts import message
from etid.selection.evidence import bic, elements, rank, weights, with_close
from etid.selection.search import PATIENCE, asked
from etid.selection.unseen import hidden, unseen

HEADS = ("circuit", "2 log evidence", "weight", "chi2", "verdict", "elements")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Candidate(Overviewed):
    """A circuit that was fitted.

    Attributes:
        fit: Its fit.
        evidence: 2 log p(data | circuit), minus that of the chosen circuit.
        weight: Probability of the circuit, if all candidates are equally probable before the data
            are known. NaN if a candidate with as many elements as the chosen one was not fitted:
            there is no weight then, since the data did not ask for another circuit.
    """

    fit: Fit
    evidence: float
    weight: float

    @property
    def name(self) -> str:
        """Name of the circuit."""
        return type(self.fit.circuit).__name__

    @property
    def adequate(self) -> bool:
        """Whether the data do not contradict the circuit and determine all its elements."""
        return rank(self.fit) == 0

    @property
    def row(self) -> tuple[str, ...]:
        """Name, evidence, weight, χ², verdict and elements as text."""
        return (
            self.name,
            f"{self.evidence:.1f}",
            f"{100 * self.weight:.1f} %" if math.isfinite(self.weight) else "-",
            f"{float(self.fit.chi2):.3f}",
            str(self.fit.verdict),
            ", ".join(self.fit.elements),
        )

    def _overview(self) -> Overview:
        return Overview(f"Candidate {self.name}", [self.row], HEADS)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Selection(Overviewed):
    """The simplest circuit that the data support.

    Attributes:
        fit: The fit of the chosen circuit. Its covariance contains the differences to other likely
            circuits, and what changes of the circuit may do that the data cannot show.
        unasked: Names of the circuits that were not fitted, because the data did not ask for them.
        late: Names of those that the data ask for, and that were not fitted for lack of time.
        weighed: Whether all candidates were fitted, except simpler ones that lack an element which
            is surely there.
        chosen: Number of the chosen candidate.
        fits: The fits by number of the candidate.
    """

    fit: Fit
    unasked: tuple[str, ...]
    late: tuple[str, ...]
    weighed: bool
    chosen: int
    fits: Mapping[int, Fit]

    @classmethod
    def of(
        cls, fits: Mapping[int, Fit], chosen: int, circuits: Sequence[AbstractCircuit]
    ) -> "Selection":
        """The selection from fits of some of the circuits, by number."""
        left = [number for number in range(len(circuits)) if number not in fits]
        late = set(asked(fits, circuits)) if len(fits) > 1 else set()
        weighed = all(len(circuits[number].names()) < elements(fits[chosen]) for number in left)
        names = [type(one).__name__ for one in circuits]
        unasked = tuple(names[number] for number in left if number not in late)
        fit = _concluded(fits, chosen) if len(circuits) > 1 else fits[chosen]
        return cls(fit, unasked, tuple(names[one] for one in late), weighed, chosen, dict(fits))

    @functools.cached_property
    def candidates(self) -> tuple[Candidate, ...]:
        """The circuits that were fitted; the chosen one first, then by evidence."""
        criterion, share = bic(self.fits), weights(self.fits)
        order = sorted(self.fits, key=lambda number: (number != self.chosen, criterion[number]))
        return tuple(
            Candidate(
                self.fits[number],
                float(criterion[self.chosen] - criterion[number]),
                share[number] if self.weighed else math.nan,
            )
            for number in order
        )

    @property
    def residual(self) -> str:
        """What the residual looks like if no candidate is adequate; otherwise empty."""
        fit = self.candidates[0].fit
        if fit.verdict == "changed":
            return fit.changes
        if rank(fit) == 0:
            return ""
        if int(fit.remarks) & Remark.mains_hum:
            return "The residual looks like mains hum."
        return "" if fit.support is None else fit.support.looks_like()

    def _overview(self) -> Overview:
        total = len(self.candidates) + len(self.unasked) + len(self.late)
        notes = []
        if self.unasked:
            notes.append(f"not fitted, the data did not ask for it: {', '.join(self.unasked)}")
        if self.late:
            notes.append(f"not fitted, {PATIENCE:g} s had passed: {', '.join(self.late)}")
        if self.fit.verdict != "successful":
            notes.append(message(self.fit.verdict))
        if self.fit.leaves:
            notes.append(self.fit.leaves)
        if self.residual:
            notes.append(self.residual)
        title = f"{self.candidates[0].name} of {several(total, 'candidate')}: {self.fit.verdict}"
        return Overview(title, [one.row for one in self.candidates], HEADS, notes)


def _concluded(fits: Mapping[int, Fit], chosen: int) -> Fit:
    """The chosen fit; its covariance and a remark tell of other circuits."""
    fit, share = fits[chosen], weights(fits) | hidden(fits, chosen)
    cov = with_close(fits, chosen, share) + unseen(fit)
    others = sum(probable for number, probable in share.items() if number != chosen)
    close = Remark.circuits_close if others > 0.02 else 0
    return dataclasses.replace(fit, cov=cov, remarks=np.asarray(int(fit.remarks) | close))
