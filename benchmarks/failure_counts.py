"""From answers to rates, with intervals that know which trials share a driver.

Trials behind one driver share its error: ten of them are not ten draws. The interval is that of
Clopper and Pearson for an effective number n* of trials (Korn and Graubard, Survey Methodology 24,
1998, 193-201),

    n* = p (1 − p) / V,      V = m / (m − 1) Σ_d (events_d − p trials_d)² / trials²,

p the rate, and V its variance between m drivers d; but not more than there are trials. Where all
drivers have the same rate, as where nothing failed, V says nothing, and n* = m: as if the trials
behind a driver were one.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

from benchmarks.failure_axes import Cell
from benchmarks.failure_draws import ELEMENTS, Answer

LEVEL = 0.95


class Rate(NamedTuple):
    """A rate with its interval."""

    rate: float
    low: float
    high: float


def clopper_pearson(events: float, trials: float) -> tuple[float, float]:
    """Interval of a binomial rate; the numbers need not be whole ones."""
    tail = (1 - LEVEL) / 2
    low = scipy.stats.beta.ppf(tail, events, trials - events + 1) if events > 0 else 0.0
    high = scipy.stats.beta.isf(tail, events + 1, trials - events) if events < trials else 1.0
    return float(low), float(high)


def rate(events: Sequence[bool], drivers: Iterable[int]) -> Rate:
    """Rate of events in trials, given the driver of each; NaN without trials."""
    if not events:
        return Rate(np.nan, np.nan, np.nan)
    happened = np.asarray(events, float)
    _, of = np.unique(np.asarray(list(drivers)), return_inverse=True)
    p, trials, clusters = float(happened.mean()), happened.size, int(of.max()) + 1
    rest = np.bincount(of, happened - p)
    variance = np.sum(rest**2) / trials**2 * clusters / max(clusters - 1, 1)
    effective = min(trials, p * (1 - p) / variance) if variance > 0 else clusters
    return Rate(p, *clopper_pearson(p * effective, effective))


EVENTS: Mapping[str, Callable[[Answer], bool]] = {
    "wrong": lambda answer: answer.wrong,
    "refused": lambda answer: answer.refused,
    "silent": lambda answer: answer.silent,
    "unstable": lambda answer: answer.unstable,
    "not_converged": lambda answer: answer.unsettled,
}


def rates(answers: Iterable[Answer]) -> dict[str, Any]:
    """Numbers of drivers and trials, and the rate of each event with its interval.

    `missed` is the rate of silent failures of elements that are determined to 10 %, among the
    trials that have any.
    """
    every = list(answers)
    found: dict[str, Any] = {"drivers": len({a.seed for a in every}), "trials": len(every)}
    of = {
        name: rate([event(a) for a in every], [a.seed for a in every])
        for name, event in EVENTS.items()
    }
    asked = [a for a in every if a.target]
    of["missed"] = rate([a.missed for a in asked], [a.seed for a in asked])
    found["determined"] = len(asked)
    for name, one in of.items():
        found |= {name: one.rate, f"{name}_low": one.low, f"{name}_high": one.high}
    return found


def table(cells: Sequence[Cell], answers: Sequence[Sequence[Answer]]) -> list[dict[str, Any]]:
    """One row for each cell and method."""
    rows = []
    for cell, every in zip(cells, answers, strict=True):
        largest = np.nanmax([answer.bound for answer in every])
        for method in dict.fromkeys(answer.method for answer in every):
            by = rates(answer for answer in every if answer.method == method)
            place = {"map": cell.chart, "row": cell.row, "column": cell.column, "method": method}
            rows.append({**place, **by, "largest_bound": float(largest)})
    return rows


def silent(cells: Sequence[Cell], answers: Sequence[Sequence[Answer]]) -> list[dict[str, Any]]:
    """Every silent failure: where, by whom, of which seed, and by how much."""
    rows = []
    for cell, every in zip(cells, answers, strict=True):
        for of in every:
            if not of.silent:
                continue
            row = {"map": cell.chart, "row": cell.row, "column": cell.column, "method": of.method}
            row |= {"seed": of.seed, "path": of.path, "missed": of.missed, "chi2": of.chi2}
            for i, name in enumerate(ELEMENTS):
                row[f"{name}_error"] = of.error[i]
                row[f"{name}_stderr"] = of.stderr[i]
                row[f"{name}_bound"] = of.bound[i]
            rows.append(row)
    return rows
