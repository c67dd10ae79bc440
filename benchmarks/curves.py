"""Cost against the number of samples and of lanes; a table and a figure. `scale` has the workers.

All runs on one core, as in `speed`. A slope is that of the straight line
between two neighbours on logarithmic axes: 1 where cost is in proportion, 0 where it is constant.
"""

import argparse
import itertools
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.signal

import etid
from benchmarks import charts, peers
from benchmarks.machine import median_time, write_csv
from benchmarks.peers import START, Problem, harmonics, problem, problem_of
from benchmarks.runner import QUICK, option, show
from etid.likelihood.load import Near

PINNED = True
OPTIONS = (QUICK, option("--folder", default=pathlib.Path()))
SAMPLES = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
LANES = (1, 4, 16, 64, 256, 1_024, 10_000, 100_000)
LIMIT = 20.0  # [s] of one call; longer ones end their curve
ENOUGH = 0.5  # [s] of calls of which the median is taken
PERIODS = 3
PULSE_RATE = 60.0  # [Hz]
NOISE = 1e-3  # of the effective value
AXES = {
    "samples": ("samples of a record", "seconds per record"),
    "lanes": ("recordings in a batch", "seconds per recording"),
}

Row = dict[str, Any]


def seconds(call: Callable[[], Any]) -> float:
    """Median time of a call after a first one, of as many as need not take long."""
    once = median_time(call, 1)
    repeats = int(min(20, ENOUGH / max(once, 1e-9)))
    return median_time(call, repeats) if repeats > 1 else once


def calls(one: Problem) -> dict[str, Callable[[], Any]]:
    """What is measured against the number of samples, of a single record."""
    load, refine = one.load(one.lanes), peers.ours(one)
    knots, start = load.gains.at(load.knots.index), np.tile(START, (len(one.records), 1))
    return peers.filter_calls(one.records[0].v_th) | {
        "harmonics and noise": lambda: harmonics(one.records[0]),
        "likelihood and its slopes": lambda: Near.of(load, knots, start),
        "LM fit on the harmonics": lambda: refine(np.arange(1)),
    }


def stretched(one: Problem, size: int) -> Problem:
    """The first trial with its three periods sampled `size` times, and with new noise.

    Interpolated, because simulating a million samples takes minutes.
    """
    rate = (size - 0.5) * PULSE_RATE / PERIODS  # half a sample short of a whole number
    draws, first = np.random.default_rng(size), one.records[0]
    v_th, v_out = (
        np.asarray(scipy.signal.resample(v, size)) + NOISE * np.std(v) * draws.standard_normal(size)
        for v in (first.v_th, first.v_out)
    )
    record = etid.Recording(v_th, v_out, sample_rate=rate, pulse_rate=PULSE_RATE, path="stretched")
    return problem_of(etid.Study.from_recordings([record]), one.driver)


def against_samples(sizes: Sequence[int]) -> Iterator[Row]:
    """Seconds per record; the records hold three pulse periods, at ever higher rates."""
    base = problem(10_000, 1)
    for size in sizes:
        for name, call in calls(stretched(base, size)).items():
            yield {"against": "samples", "what": name, "number": size, "seconds": seconds(call)}


def against_lanes(counts: Sequence[int]) -> Iterator[Row]:
    """Seconds per lane of a batch, from recordings in memory to fits; then solvers alone."""
    of, method = problem(5_000, 16, 100e3), "steiglitz_mcbride(iterations=1)"
    quick = etid.identify_driver(of.study["calibration/0"], method=method, throw=False)

    def fits(name: str, driver: etid.Driver) -> Callable[[np.ndarray], Any]:
        def run(index: np.ndarray) -> Any:
            many = [of.records[i] for i in index]
            return etid.identify_skins(many, driver, method=name).chi2

        return run

    runs = {
        "maximum_likelihood": fits("maximum_likelihood", of.driver),
        method: fits(method, quick),
    }
    runs |= {f"LM fit, {name}": run for name, run in peers.solvers(of).items()}
    for name, run in runs.items():
        each = 0.0
        for count in counts:
            done = min(count, peers.BY_SCIPY) if name.endswith("scipy") else count
            if each * done > LIMIT:
                break
            index = np.arange(count) % len(of.records)
            each = seconds(lambda run=run, index=index: run(index)) / done
            yield {"against": "lanes", "what": name, "number": count, "seconds": each}


def with_slopes(rows: Iterable[Row]) -> Iterator[Row]:
    """The same with the slope from the row before of the same curve, NaN at its begin."""
    before: dict[tuple[str, str], Row] = {}
    for row in rows:
        last, slope = before.get((row["against"], row["what"])), np.nan
        if last is not None:
            run = np.log(row["number"] / last["number"])
            slope = float(np.log(row["seconds"] / last["seconds"]) / run)
        before[row["against"], row["what"]] = row
        yield {**row, "slope": slope}


def draw(rows: Sequence[Row], path: pathlib.Path) -> None:
    figure, panels = charts.new_figure(1, len(AXES), (9.0, 4.2))
    for axes, (against, (across, up)) in zip(panels[0], AXES.items(), strict=True):
        of = [row for row in rows if row["against"] == against]
        for style, name in enumerate(dict.fromkeys(row["what"] for row in of)):
            curve = [(row["number"], row["seconds"]) for row in of if row["what"] == name]
            axes.loglog(
                *zip(*curve, strict=True), color=charts.INK, linestyle=charts.DASHES[style],
                marker=charts.MARKS[style], markersize=4, linewidth=1, label=name,
            )  # fmt: skip
        axes.set(xlabel=across, ylabel=up)
        axes.legend(fontsize=7, frameon=False)
    charts.save(figure, path)


def main(arguments: argparse.Namespace) -> bool:
    table, few = [], slice(3 if arguments.quick else None)
    for row in with_slopes(
        itertools.chain(against_samples(SAMPLES[few]), against_lanes(LANES[few]))
    ):
        table.append(row)
        show(row)
    write_csv(arguments.folder / "curves.csv", table)
    draw(table, arguments.folder / "curves.svg")
    return True
