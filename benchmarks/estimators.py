"""Our estimators, alone and in a batch, on the same draws, and what scores them and the rivals."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

import etid
from benchmarks import rivals
from benchmarks.ladder import CALIBRATION, START, TRIAL
from etid.estimators.registry import named, names
from etid.simulation.scenes import Scene

DEFAULT = "default"

OURS = (DEFAULT, *names())
BATCH = 32  # recordings of a timed batch
FAR = 5.0  # standard deviations of the bound, and own standard errors
OFF = 0.2
PATIENCE = 30  # budgets that a rival may take for all it has begun
FEWEST = 4  # draws, however long they take


class Draws(NamedTuple):
    """One scene, drawn several times, each with a calibration of its own.

    Attributes:
        name: Of the scene.
        studies: The draws.
        truth: Elements of the trial, SI.
        bound: Cramer-Rao bound of their relative standard errors.
    """

    name: str
    studies: list[etid.Study]
    truth: Float[np.ndarray, " element"]
    bound: Float[np.ndarray, " element"]


class Result(NamedTuple):
    """What an estimator made of all draws of a scene.

    Attributes:
        estimator: Its name.
        mode: `alone`, one recording a call; `batched`; or `rival`.
        elements: Estimates, NaN where there is none.
        successful: Whether the estimator called them so.
        stderr: Standard errors it reports; NaN where it has none.
        seconds: Of one skin, its driver known: median, compilation apart.
        first_seconds: Of the first call.
        driver_seconds: Of one driver, median.
        missing: Why there is nothing, if so.
    """

    estimator: str
    mode: str
    elements: Float[np.ndarray, "draw element"]
    successful: Bool[np.ndarray, " draw"]
    stderr: Float[np.ndarray, "draw element"]
    seconds: float
    first_seconds: float
    driver_seconds: float
    missing: str = ""


def draw(
    name: str, scene: Scene, repetitions: int, source: Callable[[Scene, int], etid.Study]
) -> Draws:
    """Record a scene with one seed after the other, from 0 on."""
    return Draws(
        name,
        [source(scene, seed) for seed in range(repetitions)],
        np.array(list(scene.truth()[TRIAL].values())),
        np.array(list(etid.bound(scene)[TRIAL].relative.values())),
    )


class Drivers:
    """Drivers of the draws; methods that use the same have it identified once."""

    def __init__(self, draws: Draws):
        self.draws = draws
        self.known: dict[tuple[str | None, int], etid.Driver | None] = {}
        self.times: dict[str | None, list[float]] = {}

    def of(self, method: str | None, number: int) -> etid.Driver | None:
        """The driver of one draw, if there is one."""
        kind = shared(method)
        if (kind, number) not in self.known:
            calibration = self.draws.studies[number][CALIBRATION]
            begin = time.perf_counter()
            self.known[kind, number] = driver_of(calibration, kind)
            self.times.setdefault(kind, []).append(time.perf_counter() - begin)
        return self.known[kind, number]

    def seconds(self, method: str | None) -> float:
        """Median time of one, but for the first."""
        times = self.times.get(shared(method), [])
        return float(np.median(times[1:])) if times[1:] else np.nan


def shared(method: str | None) -> str | None:
    """The method whose driver a method uses: all on the harmonics that of maximum likelihood."""
    periodic = method is not None and named(method).lane.periodic
    return "maximum_likelihood" if periodic else method


def driver_of(
    calibrations: etid.Recording | Sequence[etid.Recording],
    method: str | None,
    order: int = 5,
) -> etid.Driver | None:
    """The driver, whatever its verdict; None if pre-flight refuses a calibration."""
    try:
        return etid.identify_driver(calibrations, order=order, method=method, throw=False)
    except etid.IdentificationError:
        return None


def ours(draws: Draws, drivers: Drivers, name: str, budget: float) -> Iterable[Result]:
    """One of our estimators, alone and batched.

    Args:
        draws: The recordings.
        drivers: Their drivers.
        name: Of the estimator.
        budget: Time [s] after which the other draws are left out, but for `FEWEST`.
    """
    method: str | None = None if name == DEFAULT else name
    rows: list[tuple[np.ndarray, bool, np.ndarray]] = []
    usable, times = [], []
    nothing = np.full(draws.truth.size, np.nan)
    begin = np.inf
    for number, study in enumerate(draws.studies):
        if len(rows) >= FEWEST and time.perf_counter() - begin > budget:
            break
        driver = drivers.of(method, number)
        if driver is None:
            rows.append((nothing, False, nothing))
            continue
        usable.append((study[TRIAL], driver))

        def identify(record: etid.Recording = study[TRIAL], driver: etid.Driver = driver):
            return etid.identify_skin(record, driver, method=method, throw=False)

        if not times:
            times.append(_timed(identify)[0])  # it compiles
        seconds, fit = _timed(identify)
        times.append(seconds)
        rows.append((fit.circuit.values(), fit.verdict == "successful", fit.stderr.values()))
        begin = min(begin, time.perf_counter())
    elements, successful, stderr = (np.array(column) for column in zip(*rows, strict=True))
    first, seconds = (times[0], float(np.median(times[1:]))) if times else (np.nan, np.nan)
    driver_seconds = drivers.seconds(method)
    alone = Result(name, "alone", elements, successful, stderr, seconds, first, driver_seconds, "")
    yield alone
    if usable:
        # One driver for all: it is the time that is measured.
        known = usable[0][1]
        count = max(1, min(BATCH, round(budget / 3 / seconds)))
        batch = [usable[i % len(usable)][0] for i in range(count)]

        def identify_all():
            return etid.identify_skins(batch, known, method=method)

        several = [_timed(identify_all)[0] for _ in range(3)]
        each = float(np.median(several[1:])) / count
        yield alone._replace(mode="batched", seconds=each, first_seconds=several[0])


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    found = jax.block_until_ready(call())
    return time.perf_counter() - begin, found


class Score(NamedTuple):
    """How an estimator did in a scene.

    Attributes:
        each: Root mean square of the errors of the elements over their bounds, per draw; infinite
            without an answer.
        error: Its median; that of an efficient estimator of three elements is 0.89.
        error_of: Median error of each element over its bound.
        none: Part of the draws without an answer.
        said: Part with an answer that the estimator itself does not call successful.
        wrong: Part with an element that is off by more than five bounds or 20 %.
        silent: Part that is wrong, called successful, and not within five of the standard errors
            that the estimator reports.
    """

    each: Float[np.ndarray, " draw"]
    error: float
    error_of: tuple[float, ...]
    none: float
    said: float
    wrong: float
    silent: float


def is_off(
    relative: Float[np.ndarray, "*draw element"], bound: Float[np.ndarray, " element"]
) -> Bool[np.ndarray, "*draw element"]:
    """Whether relative errors, without sign, are wrong: far by the bound, or far in per cent."""
    return np.asarray((relative > FAR * bound) | (relative > OFF))


def score(draws: Draws, result: Result) -> Score:
    """Compare answers with the truth."""
    relative = np.abs(result.elements / draws.truth - 1)
    answered = np.asarray(np.isfinite(relative).all(1))
    in_bounds = relative / draws.bound
    each = np.where(answered, np.sqrt(np.mean(in_bounds**2, axis=1)), np.inf)
    off = is_off(relative, draws.bound)
    wrong = answered & np.any(off, axis=1)
    covered = relative <= FAR * np.nan_to_num(result.stderr / draws.truth)
    silent = answered & result.successful & np.any(off & ~covered, axis=1)
    with np.errstate(invalid="ignore"):
        error_of = np.median(np.where(answered[:, None], in_bounds, np.inf), axis=0)
    return Score(
        each,
        float(np.median(each)),
        tuple(map(float, error_of)),
        float(np.mean(~answered)),
        float(np.mean(answered & ~result.successful)),
        float(np.mean(wrong)),
        float(np.mean(silent)),
    )


def theirs(draws: Draws, budget: float) -> Iterable[Result]:
    """All rivals, each in its environment; what is missing is a result that says why."""
    pairs = [(study[TRIAL], study[CALIBRATION]) for study in draws.studies]
    given = rivals.problem(pairs, START)
    for name, rival in rivals.RIVALS.items():
        outcome = rivals.run(name, given, 1, PATIENCE * budget, budget)
        if outcome.missing:
            none, nan = np.full((1, draws.truth.size), np.nan), np.nan
            said = np.zeros(1, bool)
            yield Result(rival.name, "rival", none, said, none, nan, nan, nan, outcome.missing)
            continue
        times = outcome.seconds[np.isfinite(outcome.seconds)]
        yield Result(
            rival.name,
            "rival",
            outcome.elements,
            outcome.ok & np.isfinite(outcome.elements).all(1),
            np.full(outcome.elements.shape, np.nan),
            float(np.median(times)) if times.size else np.nan,
            outcome.first_seconds,
            float(np.nanmedian(outcome.driver_seconds)),
            "" if times.size else next(filter(None, outcome.errors), "no answer"),
        )
