"""Instruments as laboratories have them: coverage, efficiency, refusals, time of inspection.

Recordings of the four instruments of `etid.scenes.INSTRUMENTS`: dry and damp skin behind drivers
whose parts differ, six periods, noise of an amplifier before the filter with 1/f noise, hum, and a
stimulator whose quartz is off by up to the tolerance of the instrument's clock. The bound knows the
true spectrum of the noise.

Good recordings that may not be refused: noise that has passed a drawn filter of first to eighth
order at 30 to 90 kHz, or processed with the record: resampled, averaged over neighbours, filtered
forwards and backwards. Three or six periods, 40 and 50 dB, skin that differs.

Then 30 skins of five instruments from another simulator, and the processor time in which a
recording is inspected before a fit (30 records of three periods together).
"""

import argparse
import collections
import dataclasses
import pathlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import charts
from benchmarks.estimators import ELEMENTS, NOTHING, Answer
from benchmarks.instrument_draws import DATA_IS, FILTERED, answers, skins
from benchmarks.ladder import LOADS, recorded
from benchmarks.perturbations import KINDS, kind
from benchmarks.rates import COVERED, NORMAL_95, covered, rate
from benchmarks.runner import (
    FOLDER,
    QUICK,
    WORKERS,
    Target,
    at_least,
    at_most,
    option,
    report,
    tabled,
)
from benchmarks.spice import DATA
from etid.recordings.preflight import inspected, preflight
from etid.simulation.scenes import INSTRUMENTS

SKINS = 30  # of the other simulator
TARGETS = {
    "recordings of another simulator that are successful": at_least(SKINS),
    "largest error of them in standard errors": at_most(4),
    "good recordings refused": at_most(1 / 2000),
    "silent": at_most(0),
    "covered": COVERED,
    "rms error / bound": at_most(1.1),
    "inspection [ms of the processor for a recording]": at_most(0.55),
}
SNR_DB = (40.0, 50.0, 60.0, 70.0)
FIRST = 5000  # number of the first driver
BOOTSTRAP = 400  # draws of the drivers

OPTIONS = (
    QUICK,
    WORKERS,
    FOLDER,
    DATA,
    option("--drivers", default=20, help="of an instrument at one noise"),
    option("--filters", default=200, help="drivers with a filter of their own, ten skins each"),
)


def judged(of: Answer) -> str:
    """What an answer is, of `KINDS`, by its own standard errors only: 8 bits determine little."""
    return kind(dataclasses.replace(of, bound=NOTHING))


def inspection(records: int = 30, rounds: int = 15) -> float:
    """Median processor time of the inspection of a recording [ms]."""
    scene = recorded({f"{at}": LOADS["dry"] for at in range(records)}, {})
    every = list(scene.simulate(seed=0).recordings())
    times = []
    for _ in range(rounds + 1):
        begin = time.process_time()
        for seen in inspected(every):
            assert preflight(seen, periodic=True) is None
            assert seen.remarks is not None
        times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times[1:])) / records


def rows(every: Sequence[Answer]) -> list[dict[str, Any]]:
    """A row for each instrument or filter, noise and skin."""
    groups: dict[tuple[str, float | str, str], list[Answer]] = {}
    for one in every:
        skin = one.path.partition("/")[0] if one.snr_db > 0 else ""
        level = one.snr_db if skin else ""
        groups.setdefault((one.perturbation, level, skin), []).append(one)
    return [row(key, of) for key, of in sorted(groups.items())]


def row(key: tuple[str, float | str, str], of: Sequence[Answer]) -> dict[str, Any]:
    """What the answers of a group show together."""
    counts = collections.Counter(map(judged, of))
    good = [one for one in of if one.usable]
    found: dict[str, Any] = dict(zip(("instrument", "snr_db", "skin"), key, strict=True))
    found |= {"answers": len(of)} | {one: counts[one] for one in KINDS}
    found["median_chi2"] = float(np.nanmedian([one.chi2 for one in of]))
    for at, element in enumerate(ELEMENTS):
        z = np.array([one.error[at] / one.stderr[at] for one in good])
        in_bounds = np.array([one.error[at] / one.bound[at] for one in good])
        found[f"{element}_covered"] = float(np.mean(np.abs(z) < NORMAL_95)) if good else np.nan
        found[f"{element}_largest_z"] = float(np.abs(z).max(initial=0.0))
        found[f"{element}_error_in_bounds"] = rms(in_bounds) if good else np.nan
    verdicts = collections.Counter(one.verdict for one in of)
    return {**found, "verdicts": ", ".join(f"{n} {what}" for what, n in verdicts.most_common())}


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def targets(every: Sequence[Answer]) -> Iterator[Target]:
    """Whether instruments are served as they are to be."""
    data, (refused, still, inside, efficient) = list(TARGETS)[:2], list(TARGETS)[2:6]
    others = [one for one in every if one.perturbation.startswith(DATA_IS)]
    if others:
        good = [one for one in others if one.usable]
        yield Target.of(TARGETS, data[0], len(good), text=f"{len(good)} of {len(others)}")
        largest = max((float(np.abs(one.error / one.stderr).max()) for one in good), default=0.0)
        yield Target.of(TARGETS, data[1], largest)
        chi2 = float(np.nanmedian([one.chi2 for one in others]))
        yield Target.of(TARGETS, "median chi2 of them", chi2)
    for name in (FILTERED, *INSTRUMENTS):
        of = [one for one in every if one.perturbation.startswith(name)]
        if not of:
            continue
        share = rate([not one.usable for one in of], [one.seed for one in of])
        yield Target.of(TARGETS, refused, share, f"{name}: ")
        silent = sum(judged(one) == "silent" for one in of)
        yield Target.of(TARGETS, still, silent, f"{name}: ")
        good = [one for one in of if one.usable]
        if not good:
            continue
        z = np.stack([one.error / one.stderr for one in good])
        for at, element in enumerate(ELEMENTS):
            part = covered(z[:, [at]], [one.seed for one in good])
            yield Target.of(TARGETS, inside, part, f"{name}, {element}: ")
        if name != FILTERED:
            yield in_bounds(efficient, name, good)


def in_bounds(quantity: str, name: str, good: Sequence[Answer]) -> Target:
    """Error over bound, with the interval of a bootstrap of the drivers."""
    seeds = sorted({one.seed for one in good})
    by_driver = [
        np.concatenate([one.error / one.bound for one in good if one.seed == seed])
        for seed in seeds
    ]
    rng = np.random.default_rng(0)
    drawn = [
        rms(np.concatenate([by_driver[i] for i in rng.integers(len(seeds), size=len(seeds))]))
        for _ in range(BOOTSTRAP)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975])
    value = rms(np.concatenate(by_driver))
    text = f"{value:.2f} ({low:.2f} to {high:.2f})"
    return Target.of(
        TARGETS, quantity, value, f"{name}: ", text=text, interval=(float(low), float(high))
    )


def draw(table: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Shares of answers: a bar for each instrument and noise, a panel for each skin."""
    panels: dict[str, dict[str, dict[str, int]]] = {}
    for one in table:
        if one["skin"]:
            label = f"{one['instrument'].replace('_', ' ')}, {one['snr_db']:g} dB"
            panels.setdefault(one["skin"], {})[label] = {name: one[name] for name in KINDS}
    if panels:
        charts.shares(panels, charts.ANSWERS, path)


def main(arguments: argparse.Namespace) -> bool:
    quick = arguments.quick
    levels = SNR_DB[1::2] if quick else SNR_DB
    drivers, filters = (1, 6) if quick else (arguments.drivers, arguments.filters)
    tasks = [
        (name, snr_db, FIRST + place * drivers + number)
        for place, snr_db in enumerate(levels)
        for name in INSTRUMENTS
        for number in range(drivers)
    ]
    tasks += [(FILTERED, 0.0, FIRST + number) for number in range(filters)]
    of_data = skins(arguments.data / "instruments")

    def table(done: Mapping[int, Sequence[Answer]]) -> list[dict[str, Any]]:
        return rows([*of_data, *(one for found in done.values() for one in found)])

    settings = {"workers": 1 if quick else arguments.workers, "unit": "driver"}
    found = tabled(
        arguments.folder / "instruments.csv", table, answers, tasks, keep="instruments", **settings
    )
    draw(table(dict(enumerate(found))), arguments.folder / "instruments.svg")
    every = [*of_data, *(one for of in found for one in of)]
    asked = [*targets(every), Target.of(TARGETS, list(TARGETS)[-1], inspection())]
    return report(asked)
