"""Where each method fails, and whether it says so: maps over ten pairs of axes.

`benchmarks.estimators` defines wrong and silent, `benchmarks.rates` the intervals. Written are
`failures.csv`, one row for each cell and method; `silent_failures.csv`, each silent failure with
its seed; and one `failures_NUMBER.svg` for each map.

The targets are of the default method, and of the trials that have an element which is determined to
10 %. In a single cell the lower end of the interval counts. What takes longer (output error, a
higher sample rate, more periods) gets fewer draws.
"""

import argparse
import itertools
import operator
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import charts
from benchmarks.estimators import DEFAULT, ELEMENTS, OURS, Answer, rate_of, verdicts
from benchmarks.failure_axes import MOST, Cell, cells
from benchmarks.failure_draws import Effort, answers
from benchmarks.machine import write_csv
from benchmarks.runner import FOLDER, QUICK, WORKERS, Target, at_most, option, report, show, tabled

RATES, SILENT = "failures.csv", "silent_failures.csv"
MAPS = list(dict.fromkeys(cell.chart for cell in cells()))
TARGETS = {
    "silent where determined, all cells": at_most(1e-3),
    "silent in a cell, at least": at_most(1e-3),
}
ALL = 2 * MOST  # trials of a driver
DRIVERS = 3  # an hour on two cores
USUAL = 10_000.0  # samples of three periods at 200 kHz
# Of the quick run: two where all is well for the default method and not for the others, and one
# where another skin has to be noticed.
FEW = {
    ("SNR and trigger delay, rms", "60 dB", "500 ns"),
    ("SNR and trigger delay, rms", "40 dB", "50 ns"),
    ("SNR and skin that is not one RC", "60 dB", "Cole, 0.9"),
}
RANKING = (DEFAULT, "steiglitz_mcbride")  # what is right at least as often as what follows it

Rows = Sequence[Mapping[str, Any]]

OPTIONS = (QUICK, WORKERS, FOLDER, option("--drivers", default=DRIVERS, help="of a cell, at most"))


def effort(cell: Cell, quick: bool, drivers: int) -> dict[str, Effort]:
    """What a run draws of a cell, by method; fewer drivers where a period has more samples."""
    usual = dict.fromkeys(OURS, Effort(1 if quick else drivers, ALL))
    if quick:
        return {**usual, "output_error": Effort(1, 2)}
    usual["output_error"] = Effort(1, 3)
    cost = max(1.0, cell.scene.sample_rate / 200e3, cell.scene.samples / USUAL / 3)
    return {name: Effort(max(1, round(of.drivers / cost)), of.trials) for name, of in usual.items()}


# Columns of the table, and what they count.
EVENTS = {name: name for name in ("wrong", "refused", "silent", "unstable")}
EVENTS["not_converged"] = "unsettled"


def rates(every: Sequence[Answer]) -> dict[str, Any]:
    """Numbers of drivers and trials, and the rate of each event with its interval.

    `missed` is that of silent failures of determined elements, of the trials that have any.
    """
    asked = [a for a in every if a.target]
    of = {name: rate_of(every, operator.attrgetter(event)) for name, event in EVENTS.items()}
    of["missed"] = rate_of(asked, operator.attrgetter("missed"))
    found: dict[str, Any] = {"drivers": len({a.seed for a in every}), "trials": len(every)}
    found["determined"] = len(asked)
    for name, one in of.items():
        found |= {name: one.rate, f"{name}_low": one.low, f"{name}_high": one.high}
    return found


def table(cell: Cell, every: Sequence[Answer]) -> list[dict[str, Any]]:
    """One row for each method in a cell."""
    largest = float(np.nanmax([answer.bound for answer in every]))
    by_method = {name: [a for a in every if a.method == name] for name in OURS}
    return [
        {**cell.place, "method": name, **rates(of), "largest_bound": largest}
        for name, of in by_method.items()
        if of
    ]


def silent(cell: Cell, every: Sequence[Answer]) -> list[dict[str, Any]]:
    """Every silent failure in a cell: by whom, of which seed, and by how much."""
    return [
        {**cell.place, "method": of.method, "seed": of.seed, "path": of.path, "missed": of.missed}
        | {"chi2": of.chi2}
        | {
            f"{name}_{what}": getattr(of, what)[i]
            for i, name in enumerate(ELEMENTS)
            for what in ("error", "stderr", "bound")
        }
        for of in every
        if of.silent
    ]


def targets(rows: Sequence[Mapping[str, Any]], every: Sequence[Answer]) -> Iterator[Target]:
    """Whether the default method fails silently as seldom as it is to."""
    overall, single = TARGETS
    for row in rows:
        if row["method"] == DEFAULT and row["missed_low"] > TARGETS[single][1]:
            place = ", ".join(row[name] for name in ("map", "row", "column"))
            yield Target.of(TARGETS, single, row["missed_low"], after=f": {place}")
    asked = [a for a in every if a.method == DEFAULT and a.target]
    if asked:
        yield Target.of(TARGETS, overall, rate_of(asked, operator.attrgetter("missed")))


def ranking(every: Sequence[Answer]) -> Iterator[Target]:
    """Whether each method of `RANKING` is right at least as often as the next."""
    right = {
        name: sum(not (a.wrong or a.refused) for a in every if a.method == name) for name in RANKING
    }
    for better, worse in itertools.pairwise(RANKING):
        yield Target(f"right answers, {better}; of {worse} at most", right[better], right[worse])


def shares_of(row: Mapping[str, Any]) -> dict[str, float]:
    """The share of each kind of answer in a cell; they add up to 1."""
    wrong, refused, silent = (float(row[name]) for name in ("wrong", "refused", "silent"))
    return {
        "right": max(1 - wrong - refused, 0.0),
        "refused": refused,
        "said": max(wrong - silent, 0.0),
        "silent": silent,
    }


def draw(rows: Rows, path: pathlib.Path) -> None:
    """Draw one map from its rows of the table: a bar for each cell, a panel for equal methods."""
    panels: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        method = row["method"].replace("_", " ")
        cell = f"{row['row']}, {row['column']} ({100 * float(row['largest_bound']):.2g} %)"
        panels.setdefault(method, {})[cell] = shares_of(row)
    equal = {str(of): [name for name in panels if panels[name] == of] for of in panels.values()}
    panels = {", ".join(names): panels[names[0]] for names in equal.values()}
    texts = {
        (name, cell): f"{100 * shares['silent']:.1f} % silent"
        for name, of in panels.items()
        for cell, shares in of.items()
        if shares["silent"] > 0
    }
    title = f"{rows[0]['map']} (largest bound of an element): share of the answers"
    charts.shares(panels, charts.ANSWERS, path, title=title, texts=texts)


def main(arguments: argparse.Namespace) -> bool:
    quick, folder = arguments.quick, arguments.folder
    chosen = [of for of in cells() if not quick or tuple(of.place.values()) in FEW]
    tasks = [(cell, effort(cell, quick, arguments.drivers)) for cell in chosen]

    def counted(done: Mapping[int, list[Answer]]) -> list[dict[str, Any]]:
        return [row for number, of in done.items() for row in table(chosen[number], of)]

    found = tabled(
        folder / RATES, counted, answers, tasks,
        workers=arguments.workers, unit="cell", keep="failure_map",
        # The longest first, and one shape after the other: a process compiles for each.
        first=lambda cell, _: (-cell.scene.samples, cell.shape),
    )  # fmt: skip
    rows = counted(dict(enumerate(found)))
    failures = [row for cell, of in zip(chosen, found, strict=True) for row in silent(cell, of)]
    write_csv(folder / SILENT, failures)
    for name in dict.fromkeys(row["map"] for row in rows):
        of = [row for row in rows if row["map"] == name]
        draw(of, folder / f"failures_{MAPS.index(name) + 1}.svg")
    every = [answer for answered in found for answer in answered]
    for name in dict.fromkeys(answer.method for answer in every):
        of = [answer for answer in every if answer.method == name]
        show({"method": name, **rates(of), "verdicts": verdicts(of)})
    for row in failures:
        if row["method"] == DEFAULT:
            place = f"{row['map']}, {row['row']}, {row['column']}"
            print(f"silent: {place}, seed {row['seed']}, {row['path']}")
    return report([*targets(rows, every), *(ranking(every) if quick else ())])
