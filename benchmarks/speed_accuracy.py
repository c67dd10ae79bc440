"""Every estimator, ours and the rivals, on a ladder of scenes: error against time, and the front.

An error is that of the elements over their Cramer-Rao bounds, the median over draws with a
calibration of their own; a time is that of one skin from its samples, the driver known, compilation
apart, on one core. Before everything else rivals have their own environments
(`python -m benchmarks rivals`); one that has none is in the table with the reason.
"""

import argparse
import itertools
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.estimators import DEFAULT, OURS, Drivers, Result, Score, draw, ours, score, theirs
from benchmarks.ladder import SOURCES, ladder
from benchmarks.mappings import make_room
from benchmarks.provenance import RESULTS, write_csv
from benchmarks.speed_accuracy_chart import chart
from benchmarks.timing import pin
from etid.circuits.circuit import SkinRC

FILE = "speed_accuracy.csv"
REPETITIONS = 24
BUDGET = 6.0  # [s] for one estimator in one scene
SHOWN = ("dry, 80 dB", "dry, 60 dB", "dry, 30 dB", "damp, 60 dB", "damp, 40 dB", "dry, 1 MHz")
QUICK = ("dry, 60 dB", "damp, 40 dB")
QUICK_REPETITIONS = 5
SIGNIFICANT = 2.0  # standard errors of a paired difference
NEAR = 2.0  # bounds, within which the default is to stay


def rows_of(name: str, source: str, repetitions: int, quick: bool) -> list[dict[str, Any]]:
    """One row for each estimator and mode in one scene; `quick` leaves out batches and rivals."""
    draws = draw(name, ladder()[name], repetitions, SOURCES[source])
    drivers = Drivers(draws)
    each = 1 if quick else None
    results = [
        result for of in OURS for result in itertools.islice(ours(draws, drivers, of, BUDGET), each)
    ]
    results += [] if quick else theirs(draws, BUDGET)
    scores = [score(draws, result) for result in results]
    on_front = front([r.seconds for r in results], [s.error for s in scores])
    beaten_by = dominators(results, scores)
    return [
        {
            "scene": name,
            "source": source,
            "estimator": result.estimator,
            "mode": result.mode,
            "draws": len(result.elements),
            "error": scored.error,
            **{f"error_{e}": v for e, v in zip(SkinRC.names(), scored.error_of, strict=True)},
            "none": scored.none,
            "said": scored.said,
            "wrong": scored.wrong,
            "silent": scored.silent,
            "ms": 1e3 * result.seconds,
            "first_s": result.first_seconds,
            "driver_ms": 1e3 * result.driver_seconds,
            "on_front": first,
            "beaten_by": "; ".join(beaten_by) if result.estimator == DEFAULT else "",
            "missing": result.missing,
        }
        for result, scored, first in zip(results, scores, on_front, strict=True)
    ]


def front(times: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of several are on the Pareto front: nothing is both faster and more accurate."""
    pairs = list(zip(times, errors, strict=True))
    return [
        bool(np.isfinite(t) and np.isfinite(e))
        and not any(s <= t and f <= e and (s, f) != (t, e) for s, f in pairs)
        for t, e in pairs
    ]


def dominators(results: Sequence[Result], scores: Sequence[Score]) -> list[str]:
    """What is faster than our default and more accurate, beyond chance, on the same draws.

    Its batch is what counts, the last of its rows: a lab has many recordings. Errors are compared
    by the mean difference of their logarithms, draw by draw.
    """
    mine = [i for i, result in enumerate(results) if result.estimator == DEFAULT]
    if not mine:
        return ["anything: the default has no answer"]
    own, found = mine[-1], []
    for result, scored in zip(results, scores, strict=True):
        size = min(len(scored.each), len(scores[own].each))
        a, b = scored.each[:size], scores[own].each[:size]
        if not result.seconds < results[own].seconds or not np.isfinite(a).all():
            continue
        gain = np.log(b) - np.log(a)
        if np.mean(gain) > SIGNIFICANT * np.std(gain, ddof=1) / np.sqrt(size):
            found.append(result.estimator)
    return found


def ranked(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What does not hold of the ranking of methods, in words."""
    wrong = []
    for name in dict.fromkeys(row["scene"] for row in rows):
        of = {row["estimator"]: row for row in rows if row["scene"] == name}
        default = of[DEFAULT]
        if default["beaten_by"]:
            wrong.append(
                f"{name}: {default['beaten_by']}: faster and more accurate than the default"
            )
        if default["silent"] > 0:
            wrong.append(f"{name}: the default is wrong silently in {100 * default['silent']:g} %")
        if not default["error"] < NEAR:
            wrong.append(f"{name}: the default is off by {default['error']:.3g} bounds")
        for worse in ("steiglitz_mcbride", "equation_error"):
            if not of[worse]["error"] > default["error"]:
                wrong.append(f"{name}: {worse} is more accurate than the default")
    return wrong


def _print(rows: Iterable[Mapping[str, Any]]) -> None:
    for row in rows:
        head = f"{row['scene']:<22}{row['estimator']:<32}{row['mode']:<9}"
        if row["missing"]:
            tqdm.write(f"{head}{row['missing']}")
            continue
        tqdm.write(
            f"{head}{row['draws']:>5}{row['error']:10.2f}"
            + "".join(f"{100 * row[of]:8.0f}" for of in ("none", "said", "wrong", "silent"))
            + f"{row['ms']:10.2f}{row['first_s']:9.2f}{row['driver_ms']:10.0f}"
            + ("  front" if row["on_front"] else "")
        )


def run(
    names: Sequence[str], source: str, repetitions: int, folder: pathlib.Path, quick: bool
) -> bool:
    """Print and write the table and the charts; whether the ranking holds."""
    heads = ("none %", "said %", "wrong %", "silent %")
    print(
        f"{'scene':<22}{'estimator':<32}{'mode':<9}draws  x bound"
        + "".join(f"{head:>8}" for head in heads)
        + f"{'ms':>10}{'first s':>9}{'driver ms':>10}"
    )
    table: list[dict[str, Any]] = []
    for name in tqdm(names, unit="scene"):
        rows = rows_of(name, source, repetitions, quick)
        _print(rows)
        table += rows
        write_csv(folder / FILE, table)  # each scene is kept as it comes
        make_room()
    chart(table, folder / "speed_accuracy_all.svg")
    shown = [row for row in table if row["scene"] in SHOWN]
    if shown:
        chart(shown, folder / "speed_accuracy.svg")
    complaints = ranked(table)
    print("\n".join(complaints) or "the default is on the front of every scene")
    return not complaints


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Size of the run."""
    parser.add_argument("--quick", action="store_true", help="two scenes, few draws, no rivals")
    parser.add_argument("--scene", action="append", choices=list(ladder()), help="repeatable")
    parser.add_argument("--source", choices=SOURCES, default="simulated")
    parser.add_argument("--repetitions", type=int, default=REPETITIONS)
    parser.add_argument("--folder", type=pathlib.Path, default=RESULTS, help="of table and charts")


def main(arguments: argparse.Namespace) -> bool:
    """Run the command; whether the ranking of methods holds."""
    pin()
    names = arguments.scene or list(QUICK if arguments.quick else ladder())
    repetitions = QUICK_REPETITIONS if arguments.quick else arguments.repetitions
    return run(names, arguments.source, repetitions, arguments.folder, arguments.quick)
