"""Tables of a study: verdicts, drivers, elements by group, and the sources of their variance.

The tables stay readable for any number of fits: a long table is cut to `ROWS` rows, and the page
says so.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from etid.printing import as_symbol, between, first_of, heading, plus_minus, scaled, significant
from etid.recordings.fields import LABELS
from etid.report.html import Table
from etid.report.methods import words
from etid.results.columns import named
from etid.results.driver import ContinuousDriver, Driver
from etid.results.fits import Fits
from etid.results.verdicts import message, own_part

ROWS = 100  # largest number of rows of a table
CONDITIONS = 30  # largest number of conditions in a table
SINGLE = 3000  # largest number of rows of the table of recordings


def element(value: float, error: float, scale: float) -> str:
    """An element with its standard error, both divided by `scale`; empty if it is NaN.

    An element whose standard error is not below its value is not determined.
    """
    if not math.isfinite(value):
        return ""
    if error >= abs(value):
        size = significant(error / scale)
        return f"not determined (± {size})" if size else "not determined"
    return " ".join(plus_minus(value / scale, error / scale).split())


def verdicts(fits: Fits) -> Table:
    """Frequency and meaning of each verdict."""
    rows = tuple(
        (name, str(count), f"{100 * count / len(fits):.1f}", message(name))
        for name, count in fits.counts().items()
    )
    return Table(("verdict", "recordings", "share [%]", "what it means, what to do"), rows)


def drivers(
    found: Mapping[tuple[str, ...], Driver], failures: Mapping[tuple[str, ...], str]
) -> Table:
    """The drivers, failed ones first; at most `ROWS`."""
    heads = (
        "calibrations", "R_L [kΩ]", "order", "estimator", "verdict", "RRSE [%]", "χ²",
        "|Z_th| at 1 kHz [kΩ]", "remark",
    )  # fmt: skip
    rows = [
        (first_of(paths, 4), "", "", "", "failed", "", "", "", text)
        for paths, text in failures.items()
    ]
    frequency = jax.device_put(np.array([1e3]))
    chosen = sorted(found.items(), key=lambda item: (item[1].usable, item[0]))
    for paths, driver in chosen[: max(0, ROWS - len(rows))]:
        # As NumPy's, for JAX compiles each part that is taken of its arrays.
        z, error = map(np.asarray, (driver.response(frequency), driver.response_stderr(frequency)))
        own = driver.calibration.r_load if isinstance(driver, ContinuousDriver) else ()
        resistors = np.asarray(own).tolist()
        rows.append(
            (
                first_of(paths, 4),
                ", ".join(f"{r / 1e3:.6g}" for r in resistors),
                str(driver.order),
                words(driver.method),
                driver.verdict,
                significant(100 * float(driver.rrse)),
                significant(float(driver.chi2), 3),
                element(abs(complex(z[0])), float(error[0]), 1e3),
                driver.note,
            )
        )
    return Table(*_without_empty(heads, rows[:ROWS]))


def _without_empty(
    heads: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Headings and rows, without the last column if it is empty."""
    end = None if any(row[-1] for row in rows) else -1
    return tuple(heads[:end]), tuple(tuple(row[:end]) for row in rows)


@dataclasses.dataclass(frozen=True)
class Components:
    """Variations and errors of one element in one condition, relative to the median.

    Attributes:
        condition: The condition.
        name: The element.
        subjects: Number of subjects with a usable fit.
        usable: Number of usable fits.
        median: Median of the usable fits [SI].
        low: 5 % quantile of the usable fits [SI].
        high: 95 % quantile of the usable fits [SI].
        parts: Standard deviation of the medians of the subjects relative to the median, and,
            relative to the median of each subject, variation between the recordings of one subject
            without noise, standard error from the noise of a recording, and that from the driver;
            NaN if the study cannot determine it.
    """

    condition: str
    name: str
    subjects: int
    usable: int
    median: float
    low: float
    high: float
    parts: dict[str, float]


def frequent(fits: Fits, count: int) -> list[str]:
    """The most frequent conditions, in alphabetical order."""
    names, counts = np.unique(fits.labels["condition"].astype(str), return_counts=True)
    return sorted(names[np.argsort(-counts, kind="stable")[:count]].tolist())


@np.errstate(over="ignore", invalid="ignore")  # of a damaged file
def components(fits: Fits, groups: Sequence[Mapping[str, Any]]) -> list[Components]:
    """Variations and errors of each element, for the `CONDITIONS` most frequent conditions.

    Args:
        fits: All fits.
        groups: Their `summary("subject", "condition")`.
    """
    good = fits.usable()
    found = []
    for condition in frequent(fits, CONDITIONS):
        rows = [g for g in groups if g["condition"] == condition and g["usable"]]
        if not rows:
            continue
        chosen = good.where(condition=condition)
        for name in fits.circuit.names():
            medians = np.array([group[name] for group in rows])
            values = np.asarray(getattr(chosen.circuit, name))
            low, high = np.quantile(values, [0.05, 0.95]).tolist()
            spread = float(np.std(medians, ddof=1)) if medians.size > 1 else math.nan
            median = float(np.median(values))
            parts = {"between subjects": spread / median}
            for label, part in (
                ("between recordings", "between"), ("own error", "own"), ("shared error", "shared")
            ):  # fmt: skip
                parts[label] = _typical([row[f"{name}_{part}"] for row in rows] / medians)
            found.append(
                Components(
                    condition=condition,
                    name=name,
                    subjects=len(rows),
                    usable=values.size,
                    median=median,
                    low=low,
                    high=high,
                    parts=parts,
                )
            )
    return found


def show_components(found: Sequence[Components], units: Mapping[str, str]) -> Table:
    """The components as a table."""
    rows = []
    for one in found:
        scale = scaled(units[one.name], one.median)[0]
        rows.append(
            (
                one.condition or "all",
                heading(as_symbol(one.name), units[one.name], one.median),
                str(one.subjects),
                str(one.usable),
                significant(one.median / scale, 4),
                between(one.low / scale, one.high / scale, "1"),
                *(significant(100 * value) for value in one.parts.values()),
            )
        )
    heads = ("condition", "element", "subjects", "usable", "median", "5 % to 95 %")
    return Table(
        (*heads, "subjects", "recordings", "own", "shared"),
        tuple(rows),
        (("", len(heads)), ("between [%]", 2), ("standard error [%]", 2)),
    )


def groups(rows: Sequence[Mapping[str, Any]], by: Sequence[str], units: Mapping[str, str]) -> Table:
    """Medians, spread and errors of each group of a summary.

    Args:
        rows: Rows of `Fits.summary`. If there are more than `ROWS`, the table shows those with the
            largest share of failures.
        by: Labels of the groups.
        units: Units of the elements.
    """
    shown = list(rows)
    if len(shown) > ROWS:
        worst = np.argsort([row["usable"] / row["fits"] for row in shown], kind="stable")
        shown = [shown[i] for i in sorted(worst[:ROWS])]
    usual = {name: _typical(np.array([row[name] for row in shown], float)) for name in units}
    parts = ("between", "own", "shared")  # keys of `Fits.summary`
    cells = []
    for row in shown:
        line = [str(row[name]) or "-" for name in by]
        line.append(f"{row['usable']}/{row['fits']}")
        for name, unit in units.items():
            median = row[name]
            scale = scaled(unit, usual[name])[0]
            line.append(element(median, row[f"{name}_stderr"], scale).partition(" ±")[0])
            line += [significant(100 * row[f"{name}_{part}"] / median) for part in parts]
        cells.append(tuple(line))
    heads = [*by, "usable"]
    for name, unit in units.items():
        heads += [heading("median", unit, usual[name]), *(f"{part} [%]" for part in parts)]
    over = [(as_symbol(name), 1 + len(parts)) for name in units]
    return Table(tuple(heads), tuple(cells), (("", len(by) + 1), *over))


def _typical(values: np.ndarray) -> float:
    """Median of the values that are finite; NaN without one."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def recordings(fits: Fits, links: Mapping[str, str]) -> Table:
    """One row for each recording: labels, verdict, elements, quality, note; at most `SINGLE`.

    Of more fits it shows the unusable ones, and every few of the others.

    Args:
        fits: All fits.
        links: Anchors of the waveforms, by path of the recording.
    """
    some = fits
    if len(fits) > SINGLE:
        bad = np.flatnonzero(~fits.fit.usable)[:SINGLE]
        good = np.flatnonzero(fits.fit.usable)
        every = np.linspace(0, good.size - 1, SINGLE - bad.size).round().astype(int)
        some = fits.take(np.union1d(bad, good[every]))
    table, units = some.table(), some.circuit.units()
    labels = [name for name in LABELS if len(set(map(str, fits.labels[name]))) > 1]
    heads = {"path": "recording"} | {name: name for name in labels}
    shown = {head: [str(one) or "-" for one in table[name]] for name, head in heads.items()}
    shown["verdict"] = table["verdict"].tolist()
    for name, unit in units.items():
        usual = _typical(table[name])
        scale = scaled(unit, usual)[0]
        pairs = zip(table[name], table[f"{name}_stderr"], strict=True)
        shown[heading(as_symbol(name), unit, usual)] = [element(*pair, scale) for pair in pairs]
    for name, (column, *_) in named(units).items():
        if column.heading and name in table:
            shown[column.heading] = [column.text(float(one)) for one in table[name]]
    shown["note"] = list(map(own_part, shown["verdict"], map(str, table["note"])))
    found = _without_empty(list(shown), list(zip(*shown.values(), strict=True)))
    return Table(*found, searchable=True, folded=len(some) > 30, links=links)


def single(fits: Fits) -> Table:
    """The elements of one fit, with the parts of their standard errors."""
    rows = []
    shared = np.sqrt(np.maximum(np.diagonal(fits.fit.shared_cov[0]), 0.0))
    own = np.sqrt(np.maximum(np.diagonal(fits.cov[0] - fits.fit.shared_cov[0]), 0.0))
    for i, (name, unit) in enumerate(fits.circuit.units().items()):
        value = float(np.asarray(getattr(fits.circuit, name))[0])
        error = float(np.asarray(getattr(fits.stderr, name))[0])
        scale = scaled(unit, value)[0]
        parts = (significant(float(part[i]) / scale) for part in (own, shared))
        rows.append((heading(as_symbol(name), unit, value), element(value, error, scale), *parts))
    return Table(("element", "value ± standard error", "own error", "shared error"), tuple(rows))
