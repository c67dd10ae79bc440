"""Every estimator, ours and the rivals, on a ladder of scenes: error against time, and the front.

An error is that of the elements over their Cramer-Rao bounds, the median over draws with a
calibration of their own and its 95 % interval; a time is that of one skin from its samples, the
driver known, compilation apart, on one core. Methods with the driver of the default or of maximum
likelihood have all draws, others as many as a budget allows. Rivals have environments of their own
(`python -m benchmarks rivals`); one that has none is in the table with the reason, without draws.
Those that fit the same residuals as etid have `OF_STRONG` draws, and a second row with the Z_th
that etid finds: it tells their driver from their fit of the skin. All scenes take some six hours.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from tqdm import tqdm

import etid
from benchmarks import rivals
from benchmarks.estimators import DEFAULT, ELEMENTS, NOTHING, OURS, Answer, Drivers, method_of
from benchmarks.ladder import CALIBRATION, SOURCES, START, TRIAL, ladder
from benchmarks.machine import make_room, read_csv, timed, write_csv
from benchmarks.rates import FEWEST, LEVEL, median_interval
from benchmarks.rivals.records import harmonics
from benchmarks.runner import FOLDER, QUICK, Target, at_most, option, report, show
from benchmarks.speed_accuracy_chart import KNOWN, chart
from etid.simulation.scenes import Scene

PINNED = True
FILE = "speed_accuracy.csv"
BUDGET = 60.0  # [s] for the draws of a method with a driver of its own in one scene
TIMED = 6.0  # [s] for a timed batch that NumPy runs, and for a rival in one scene
BATCH = 512  # recordings of a timed batch; so many are compiled
PATIENCE = 30  # budgets that a rival may take for all it has begun
OF_RIVALS, OF_STRONG = 24, 100  # draws, at most; of those on etid's residuals, however long
MEASURED = (
    *("error", "error_low", "error_high", *(f"error_{name}" for name in ELEMENTS)),
    *("none", "said", "wrong", "silent"),
)
PRINTED = (
    *("scene", "estimator", "mode", "draws", "error", "error_low", "error_high"),
    *("none", "said", "wrong", "silent", "ms", "first_s", "driver_ms", "on_front", "missing"),
)
SHOWN = ("dry, 80 dB", "dry, 60 dB", "dry, 30 dB", "damp, 60 dB", "damp, 40 dB", "dry, 1 MHz")
FEW, FEW_REPETITIONS = ("dry, 60 dB", "damp, 40 dB"), 5
TARGETS = {
    "estimators that beat the default": at_most(0),
    "part of the draws in which the default is wrong silently": at_most(0),
    "error of the default, in bounds": at_most(np.nextafter(2.0, 0)),
}
WORSE = "steiglitz_mcbride"  # its error must be larger than the default's

OPTIONS = (
    QUICK,
    FOLDER,
    option(
        "--scene",
        action="append",
        choices=list(ladder()),
        help="repeatable; the table keeps its others",
    ),
    option("--source", default="simulated", choices=SOURCES),
    option("--repetitions", default=200),
)


class Draws(NamedTuple):
    """One scene, drawn several times, each with a calibration of its own; elements in SI."""

    studies: list[etid.Study]
    truth: np.ndarray
    bound: np.ndarray

    @classmethod
    def of(cls, scene: Scene, repetitions: int, source: Callable[[Scene, int], etid.Study]):
        """Record a scene with one seed after the other, from 0 on."""
        truth, bound = scene.truth()[TRIAL], etid.bound(scene)[TRIAL].relative
        studies = [source(scene, seed) for seed in range(repetitions)]
        return cls(studies, *(np.array(list(of.values())) for of in (truth, bound)))

    def answer(self, name: str, seed: int, verdict: str, value: Any, stderr: Any) -> Answer:
        """What an estimator says of a draw."""
        error, own = (np.asarray(of, float) / self.truth for of in (value, stderr))
        return Answer(name, seed, TRIAL, verdict, error - 1, own, self.bound)


class Result(NamedTuple):
    """What an estimator made of all draws of a scene."""

    estimator: str  # its name
    mode: str  # `alone`, one recording a call; `batched`; or `rival`
    answers: Sequence[Answer]  # one for each draw; none if it could not be run
    seconds: float = np.nan  # of one skin, its driver known: median, compilation apart
    first_seconds: float = np.nan  # of the first call
    driver_seconds: float = np.nan  # of one driver, median
    missing: str = ""  # why there is nothing, if so

    @property
    def each(self) -> np.ndarray:
        """Root mean square over the elements of the errors in bounds; infinite without an answer.

        Its median for an efficient estimator of three elements is 0.89.
        """
        return np.sqrt(np.mean(self._in_bounds() ** 2, axis=1))

    def _in_bounds(self) -> np.ndarray:
        sizes = np.array([np.abs(of.error / of.bound) for of in self.answers])
        return np.where(np.isfinite(sizes).all(1, keepdims=True), sizes, np.inf)

    def row(self) -> dict[str, Any]:
        """Medians of the errors, and parts of the draws, as a table has them; NaN without draws."""
        if not self.answers:
            return dict.fromkeys(MEASURED, np.nan)
        answered, low, high = np.isfinite(self.each), *median_interval(self.each)
        good = np.array([of.usable for of in self.answers])
        with np.errstate(invalid="ignore"):
            medians = np.median(self._in_bounds(), axis=0)
        return {
            "error": float(np.median(self.each)),
            "error_low": low,
            "error_high": high,
            **{f"error_{name}": float(of) for name, of in zip(ELEMENTS, medians, strict=True)},
            "none": float(np.mean(~answered)),
            "said": float(np.mean(answered & ~good)),
            "wrong": float(np.mean(answered & [of.wrong for of in self.answers])),
            "silent": float(np.mean(answered & [of.silent for of in self.answers])),
        }


def ours(draws: Draws, drivers: Drivers, name: str) -> Iterator[Result]:
    """One of our estimators, alone and batched; after its budget other draws are left out."""
    method, begin = method_of(name), np.inf
    kind, default = map(drivers.kind, (name, DEFAULT))
    on_harmonics = kind == "maximum_likelihood"
    budget = np.inf if on_harmonics or kind == default else BUDGET
    answers, usable, times = [], [], []
    for seed, study in enumerate(draws.studies):
        if len(answers) >= FEWEST and time.perf_counter() - begin > budget:
            break
        driver = drivers.of([study[CALIBRATION]], name)
        if driver is None:
            answers.append(draws.answer(name, seed, "driver_failed", NOTHING, NOTHING))
            continue
        usable.append((study[TRIAL], driver))

        def identify(record: etid.Recording = study[TRIAL], driver: etid.Driver = driver):
            return etid.identify_skin(record, driver, method=method, throw=False)

        if not times:
            times.append(timed(identify)[1])  # it compiles
        fit, seconds = timed(identify)
        times.append(seconds)
        said = fit.circuit.values(), fit.stderr.values()
        answers.append(draws.answer(name, seed, fit.verdict, *said))
        begin = min(begin, time.perf_counter())
    first, seconds = (times[0], float(np.median(times[1:]))) if times else (np.nan, np.nan)
    own = drivers.times.get(kind, [])[1:]
    driver_seconds = float(np.median(own)) if own else np.nan
    alone = Result(name, "alone", answers, seconds, first, driver_seconds)
    yield alone
    if usable:
        # One driver for all: it is the time that is measured.
        known = usable[0][1]
        count = BATCH if on_harmonics else max(1, round(TIMED / 3 / seconds))
        batch = [usable[i % len(usable)][0] for i in range(count)]
        several = [
            timed(lambda: etid.identify_skins(batch, known, method=method))[1] for _ in range(3)
        ]
        each = float(np.median(several[1:])) / count
        yield alone._replace(mode="batched", seconds=each, first_seconds=several[0])


def theirs(draws: Draws, drivers: Drivers) -> Iterator[Result]:
    """All rivals, each in its environment; strong ones once more with the Z_th of etid."""
    for module, rival in rivals.RIVALS.items():
        studies = draws.studies[: OF_STRONG if rival.strong else OF_RIVALS]
        given = rivals.problem([(study[TRIAL], study[CALIBRATION]) for study in studies], START)
        limits = (None, np.inf) if rival.strong else (PATIENCE * TIMED, TIMED)
        yield outcome(draws, rival.name, rivals.run(module, given, 1, *limits))
        if rival.strong:
            given["z_th"] = np.stack([z_th(study, drivers) for study in studies])
            yield outcome(draws, rival.name + KNOWN, rivals.run(module, given, 1, *limits))


def z_th(study: etid.Study, drivers: Drivers) -> np.ndarray:
    """What etid finds at the harmonics of a trial [ohm]; NaN without a driver."""
    trial, driver = study[TRIAL], drivers.of([study[CALIBRATION]], DEFAULT)
    f = harmonics(trial.v_th, trial.v_out, trial.sample_rate, trial.pulse_rate).f
    return np.full(f.size, np.nan) if driver is None else np.asarray(driver.response(f))


def outcome(draws: Draws, name: str, of: rivals.Outcome) -> Result:
    """What a rival made of the first draws; what could not be run says why."""
    if of.missing:
        return Result(name, "rival", (), missing=of.missing)
    answers = [
        draws.answer(name, i, "successful" if ok else "refused", value, NOTHING)
        for i, (value, ok) in enumerate(zip(of.elements, of.ok, strict=True))
    ]
    seconds, of_driver = (
        float(np.median(times)) if (times := every[np.isfinite(every)]).size else np.nan
        for every in (of.seconds, of.driver_seconds)
    )
    why = "" if np.isfinite(seconds) else next(filter(None, of.errors), "no answer")
    return Result(name, "rival", answers, seconds, of.first_seconds, of_driver, why)


def rows_of(name: str, source: str, repetitions: int, quick: bool) -> list[dict[str, Any]]:
    """One row for each estimator and mode in one scene; `quick` leaves out batches and rivals."""
    draws, drivers = Draws.of(ladder()[name], repetitions, SOURCES[source]), Drivers()
    modes = 1 if quick else None
    results = [
        result for of in OURS for result in itertools.islice(ours(draws, drivers, of), modes)
    ]
    results += [] if quick else theirs(draws, drivers)
    scored = [result.row() for result in results]
    on_front = front([of.seconds for of in results], [of["error"] for of in scored])
    beaten_by = "; ".join(dominators(results))
    return [
        {
            "scene": name,
            "source": source,
            "estimator": of.estimator,
            "mode": of.mode,
            "draws": len(of.answers),
            **numbers,
            "ms": 1e3 * of.seconds,
            "first_s": of.first_seconds,
            "driver_ms": 1e3 * of.driver_seconds,
            "on_front": first,
            "beaten_by": beaten_by if of.estimator == DEFAULT else "",
            "missing": of.missing,
        }
        for of, numbers, first in zip(results, scored, on_front, strict=True)
    ]


def front(times: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which of several are on the Pareto front: nothing is both faster and more accurate."""
    pairs = list(zip(times, errors, strict=True))
    return [
        bool(np.isfinite(t) and np.isfinite(e))
        and not any(s <= t and f <= e and (s, f) != (t, e) for s, f in pairs)
        for t, e in pairs
    ]


def dominators(results: Sequence[Result]) -> list[str]:
    """What is faster than our default and more accurate, beyond chance, on the same draws.

    Its batch is what counts, the last of its rows: a lab has many recordings. Errors are compared
    by the mean difference of their logarithms, draw by draw.
    """
    mine = [of for of in results if of.estimator == DEFAULT]
    if not mine:
        return ["anything: the default has no answer"]
    own, found = mine[-1], []
    for of in results:
        size = min(len(of.answers), len(own.answers))
        if not of.seconds < own.seconds or not np.isfinite(of.each).all():
            continue
        a, b = of.each[:size], own.each[:size]
        gain = np.log(b) - np.log(a)
        far = scipy.stats.t.isf((1 - LEVEL) / 2, size - 1) * np.std(gain, ddof=1) / np.sqrt(size)
        if np.mean(gain) > far:  # of two draws it has to be far
            found.append(of.estimator)
    return found


def ranked(rows: Sequence[dict[str, Any]]) -> Iterator[Target]:
    """What does not hold of the ranking of methods, scene by scene."""
    for scene in dict.fromkeys(row["scene"] for row in rows):
        of = {row["estimator"]: row for row in rows if row["scene"] == scene}
        default = of[DEFAULT]
        values = (len(default["beaten_by"]), default["silent"], default["error"])
        found = [
            Target(f"{scene}: {name}", value, *limits)
            for (name, limits), value in zip(TARGETS.items(), values, strict=True)
        ]
        found[0] = found[0]._replace(text=default["beaten_by"])
        least, error = np.nextafter(default["error"], np.inf), of[WORSE]["error"]
        found.append(Target(f"{scene}: error of {WORSE}", error, least))
        yield from (target for target in found if not target.met)


def main(arguments: argparse.Namespace) -> bool:
    """Print and write the table and the charts; whether the ranking of methods holds."""
    quick, folder = arguments.quick, arguments.folder
    repetitions = FEW_REPETITIONS if quick else arguments.repetitions
    scenes, order = arguments.scene or list(FEW if quick else ladder()), list(ladder())
    before = read_csv(folder / FILE) if arguments.scene else []
    table = [row for row in before if row["scene"] not in scenes]
    for name in tqdm(scenes, unit="scene"):
        rows = rows_of(name, arguments.source, repetitions, quick)
        for row in rows:
            show(row, *PRINTED)
        table = sorted([*table, *rows], key=lambda row: order.index(row["scene"]))
        write_csv(folder / FILE, table)  # each scene is kept as it comes
        make_room()
    chart(table, folder / "speed_accuracy_all.svg")
    shown = [row for row in table if row["scene"] in SHOWN]
    if shown:
        chart(shown, folder / "speed_accuracy.svg")
    return report(ranked(table))
