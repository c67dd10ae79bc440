"""The paper's tables as tidy rows: one per laboratory, method and element, beside what it prints.

Errors, spreads and scatters are in per cent, elements in SI units. A fit without a circuit (an
estimate that is negative or complex) enters no statistics; `circuits` of `fits` do.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

import etid
from etid.circuits.display import DISPLAY
from etid.paper import tables as experiments
from etid.paper.tables import ORDER, Outcome, Truth
from etid.report.html import Table, number
from etid.simulation import published

Row = dict[str, Any]
_IN_SI = ("typical", "lowest", "highest", "paper_typical", "paper_lowest", "paper_highest")
Groups = Mapping[tuple[str, str], Sequence[Outcome]]
"""The studies of each laboratory and method."""


def with_circuit(fits: etid.Fits) -> etid.Fits:
    """The fits that found a circuit."""
    values = np.array([getattr(fits.circuit, name) for name in fits.circuit.names()])
    return fits.take(np.asarray(np.isfinite(values).all(axis=0)))


def _sd(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1)) if values.size > 1 else np.nan


def _mean(values: Iterable[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.nan


def _counts(every: Sequence[etid.Fits]) -> Row:
    return {
        "successful": sum(len(fits.successful()) for fits in every),
        "circuits": sum(len(with_circuit(fits)) for fits in every),
        "fits": sum(map(len, every)),
    }


def table_1(groups: Groups) -> list[Row]:
    """Errors of five known resistors, over the studies."""
    rows = []
    for (laboratory, method), outcomes in groups.items():
        found = [experiments.resistor_errors(outcome) for outcome in outcomes]
        for r, paper in published.TABLE_1.items():
            every = np.array([of[r] for of in found])
            some = every[np.isfinite(every)]
            row = {"laboratory": laboratory, "method": method, "r": r, "paper_error": paper}
            row |= {"error": _mean(some), "spread": _sd(some)}
            row |= {"rms": float(np.sqrt(_mean(some**2)))}
            rows.append({**row, "circuits": some.size, "fits": every.size})
    return rows


def table_fingertips(groups: Groups, truth: Truth, condition: str) -> list[Row]:
    """Table II (dry) or III (damp); means over the studies of `experiments.Fingertips`."""
    rows = []
    for (laboratory, method), outcomes in groups.items():
        every = [outcome.skins.where(condition=condition) for outcome in outcomes]
        some = [fits for fits in map(with_circuit, every) if _is_complete(fits, every[0])]
        for name in ORDER:
            paper = published.FINGERTIPS[condition][name]
            found = [vars(experiments.fingertips(fits, truth, name)) for fits in some]
            row = {"laboratory": laboratory, "method": method, "element": name}
            ends = zip(("typical", "lowest", "highest"), paper, strict=True)
            row |= {f"paper_{end}": value for end, value in ends}
            for field in experiments.Fingertips.__dataclass_fields__:
                row[field] = _mean(of[field] for of in found)
            rows.append(row | _counts(every))
    return rows


def _is_complete(fits: etid.Fits, every: etid.Fits) -> bool:
    """Whether every subject has a circuit left, and the typical fingertip a spread."""
    counts = dict(zip(*np.unique(fits.labels["subject"], return_counts=True), strict=True))
    return counts.keys() == set(every.labels["subject"]) and counts["typical"] > 1


def table_4(groups: Groups, truth: Truth) -> list[Row]:
    """The built circuit: mean error and scatter of the trials of a study.

    `error` is the mean over all studies, `between` the standard deviation of the studies' means,
    which is the error of their calibrations; `scatter` that of the trials within a study.
    `stderr` is the standard error of a study's mean as the fits tell it: what they share, and the
    mean of what they do not.
    """
    rows = []
    for (laboratory, method), outcomes in groups.items():
        every = [outcome.skins.where(condition="built") for outcome in outcomes]
        some = [fits for fits in map(with_circuit, every) if len(fits) > 1]
        for i, name in enumerate(etid.SkinRC.names()):
            found = [experiments.errors(fits, truth)[name] for fits in some]
            means = np.array([errors.mean() for errors in found])
            row: Row = {"laboratory": laboratory, "method": method, "element": name}
            row["paper_error"], row["paper_scatter"] = published.TABLE_4[name]
            row |= {"error": _mean(means), "between": _sd(means)}
            row["scatter"] = float(np.sqrt(_mean(errors.var(ddof=1) for errors in found)))
            row["stderr"] = _mean(_stderr_of_mean(fits, truth, i) for fits in some)
            row["rrse"] = 100 * float(np.median([np.median(fits.rrse) for fits in every]))
            rows.append({**row, **_counts(every), "studies": len(some)})
    return sorted(rows, key=lambda row: ORDER.index(row["element"]))


def _stderr_of_mean(fits: etid.Fits, truth: Truth, i: int) -> float:
    """Standard error of the mean of element i over trials with one driver [%]."""
    known = truth[str(fits.labels["path"][0])][etid.SkinRC.names()[i]]
    total, shared = (np.asarray(cov)[:, i, i].mean() for cov in (fits.cov, fits.fit.shared_cov))
    return float(100 / known * np.sqrt(shared + (total - shared) / len(fits)))


def show(rows: Sequence[Row], columns: Sequence[str]) -> Table:
    """A table for the terminal: the laboratory, the method, and these columns of the rows."""
    heads = ("laboratory", "method", *columns)
    return Table(heads, tuple(tuple(_cell(name, row) for name in heads) for row in rows))


def _cell(name: str, row: Row) -> str:
    """One cell; resistances and elements in the units in which circuits are printed."""
    value = row[name]
    if not isinstance(value, float):
        return str(value)
    if name in ("r", *_IN_SI):
        scale, symbol = DISPLAY[etid.SkinRC.units().get(row.get("element", ""), "ohm")]
        return f"{value / scale:.4g} {symbol}"
    return number(value)
