"""Ratios of speed against what one would use instead, in one run on one core, compilation apart.

Each line is a ratio of medians with its target; a missed target makes the command end with 1.
"""

import argparse
import dataclasses
import math
import pathlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

import etid
from benchmarks import online, peers
from benchmarks.peers import A, B
from benchmarks.problem import LOAD, SAMPLES, Problem, harmonics, problem
from benchmarks.provenance import write_csv
from benchmarks.runner import QUICK, option
from benchmarks.timing import first_and_warm, import_time, interpreter
from etid.estimators.steiglitz_mcbride.iteration import ITERATIONS
from etid.signals.filtering import lfilter
from etid.signals.noise import noise_std
from etid.solvers.levenberg_marquardt import normal_equations

TRUTH = dataclasses.astuple(LOAD)
PROCESSES = 3  # whose median counts


class Line(NamedTuple):
    """One ratio.

    Attributes:
        name: What is compared with what.
        ours: Time [s].
        theirs: Time [s].
        ratio: The one that has the target.
        target: Its limit.
        at_least: Whether the ratio must exceed the limit, or stay below it.
    """

    name: str
    ours: float
    theirs: float
    ratio: float
    target: float
    at_least: bool

    @property
    def met(self) -> bool:
        """Whether the target is reached."""
        return self.ratio >= self.target if self.at_least else self.ratio <= self.target


def median_time(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time [s] after a first call."""
    return first_and_warm(call, repeats)[1]


def _costs(name: str, ours: float, theirs: float, target: float) -> Line:
    return Line(name, ours, theirs, ours / theirs, target, False)


def _gains(name: str, ours: float, theirs: float, target: float) -> Line:
    return Line(name, ours, theirs, theirs / ours, target, True)


def _filters(repeats: int) -> list[Line]:
    """One pass, gradient and normal equations of a filter of order 6 over ten periods."""
    generator = np.random.default_rng(0)
    x = generator.normal(size=SAMPLES)
    reference = median_time(lambda: scipy.signal.lfilter(B, A, x), repeats)
    data, b, a = map(jnp.asarray, (x, B, A))
    forward = jax.jit(lambda b: lfilter(b, a, data)[0])
    gradient = jax.jit(jax.grad(lambda b: jnp.sum(lfilter(b, a, data)[0] ** 2)))

    def three(q, _):
        return lfilter(b, a.at[1:4].add(q), data)[0]

    equations = jax.jit(lambda q: normal_equations(three, q))
    return [
        _costs(name, median_time(call, repeats), reference, target)
        for name, call, target in (
            ("filter / scipy lfilter", lambda: forward(b), 0.8),
            ("gradient / scipy lfilter", lambda: gradient(b), 2.0),
            ("normal equations of 3 / scipy lfilter", lambda: equations(jnp.zeros(3)), 4.0),
        )
    ]


def _solvers(ten_periods: Problem, repeats: int) -> list[Line]:
    """The same residual, start and minimum: elements and delay with Z_th known."""
    by, every = peers.solvers(ten_periods), np.arange(len(ten_periods.records))
    lanes = every.size
    ours = by["ours"](every)
    np.testing.assert_allclose(ours[0], by["scipy"](every[:1])[0], atol=1e-5)
    np.testing.assert_allclose(ours, by["optimistix"](every), atol=1e-4)
    each_of_ours = median_time(lambda: by["ours"](every), repeats) / lanes
    each_of_stock = median_time(lambda: by["optimistix"](every), repeats) / lanes
    by_scipy = median_time(lambda: by["scipy"](every[:1]), repeats)
    compiled = peers.compiled_scipy_fit(ten_periods)
    first = jax.tree.map(lambda leaf: leaf[0], ten_periods.lanes)
    np.testing.assert_allclose(ours[0], compiled(first), atol=1e-5)
    with_ours = median_time(lambda: compiled(first), repeats)
    return [
        _gains("scipy least_squares (lm), NumPy / LM", each_of_ours, by_scipy, 6.0),
        _gains("the same with our compiled terms / LM", each_of_ours, with_ours, 10.0),
        _gains(f"vmapped optimistix LM / LM, {lanes} lanes", each_of_ours, each_of_stock, 8.0),
    ]


def _from_samples(ten_periods: Problem, repeats: int) -> list[Line]:
    """From ten periods to a judged joint fit, and to Steiglitz-McBride on their harmonics."""
    every = np.arange(len(ten_periods.records))
    lanes, record = every.size, ten_periods.records[0]
    v_th, v_out = record.v_th, record.v_out
    reference = median_time(lambda: scipy.signal.lfilter(B, A, v_th), 5 * repeats)
    ours = median_time(lambda: peers.judged(ten_periods)(every), repeats) / lanes

    iterate = peers.harmonic_steiglitz_mcbride(ten_periods, ITERATIONS)
    np.testing.assert_allclose(np.median(iterate(every), axis=0), TRUTH, rtol=0.05)
    on_harmonics = median_time(lambda: iterate(every), repeats) / lanes
    of_samples = median_time(lambda: harmonics(record), 5 * repeats)
    driver = ten_periods.driver
    b, a = np.asarray(driver.b), np.asarray(driver.a)
    theirs = median_time(
        lambda: peers.numpy_steiglitz_mcbride(v_th, v_out, b, a, ITERATIONS), repeats
    )
    return [
        _costs(f"raw to judged fit / scipy lfilter, {lanes} lanes", ours, reference, 1.5),
        _gains("lfilter, lstsq SM / SM on harmonics", on_harmonics, theirs, 15.0),
        _gains("the same / SM from samples", on_harmonics + of_samples, theirs, 15.0),
    ]


def _joint(ten_periods: Problem, repeats: int) -> Line:
    """All trials and their driver in one fit, beside the fits of single trials."""
    every = np.arange(len(ten_periods.records))
    alone = median_time(lambda: peers.judged(ten_periods)(every), repeats) / every.size
    found = median_time(lambda: etid.identify_jointly(ten_periods.study), repeats) / every.size
    return Line("joint fit of a trial [ms] / alone", found, alone, 1e3 * found, 3.0, False)


def _driver(ten_periods: Problem, repeats: int) -> Line:
    """A driver whose programs are compiled."""
    calibration = ten_periods.study["calibration/0"]

    def identify() -> etid.Driver:
        return etid.identify_driver(calibration, method="maximum_likelihood", throw=False)

    found = median_time(identify, repeats)
    return Line("driver, warm [ms]", found, math.nan, 1e3 * found, 50.0, False)


def _tick(electrodes: int, ticks: int) -> Line:
    """A tick on-line with its tests and the next command, against the time between two pulses."""
    tracker, pulses = online.problem(electrodes, 0)
    period = tracker.period / tracker.model.bands.sample_rate
    ratio = float(np.percentile(online.timed(tracker, pulses, ticks)[1], 99))
    name = f"tick of {electrodes} electrodes, p99 / period"
    return _costs(name, ratio * period, period, online.TARGET)


def _batches(lanes: int, repeats: int) -> list[Line]:
    """Three periods: the batch of the chart against SciPy, and the recordings of a large file."""
    three, of_file = problem(10_000, lanes), problem(5_000, lanes, sample_rate=100e3)
    every = np.arange(lanes)
    ours = median_time(lambda: peers.judged(three)(every), repeats) / lanes
    by_scipy = peers.samples_to_fit(three).by["scipy"]
    theirs = median_time(lambda: by_scipy(every[:1]), repeats)
    stored = median_time(lambda: peers.judged(of_file)(every), repeats) / lanes
    return [
        _gains("SciPy on harmonics / skin, 10 000 samples", ours, theirs, 12.0),
        Line("10^5 recordings of 5 000 samples [s]", stored, math.nan, 1e5 * stored, 20.0, False),
    ]


def _limits(ten_periods: Problem, repeats: int) -> str:
    """What no fit can be faster than on this machine."""
    record = ten_periods.records[0]
    stored = [record.samples[name] for name in ("v_th", "v_out")]
    reading = median_time(lambda: [of.values for of in stored], 5 * repeats)
    v_out = record.v_out
    transform = median_time(lambda: np.fft.rfft(v_out), 5 * repeats)
    noise = median_time(lambda: noise_std(v_out), 5 * repeats)
    one_pass = median_time(lambda: scipy.signal.lfilter(B, A, v_out), 5 * repeats)
    times = {
        "reading both records": reading,
        "one rfft": transform,
        "one lfilter": one_pass,
        "the noise of one record": noise,
    }
    return ", ".join(f"{name} {1e3 * time:.2f} ms" for name, time in times.items())


_FIRST = """
import time
import jax
jax.config.update("jax_enable_x64", True)
import etid
study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
driver = etid.identify_driver(study["calibration/98k8"])
begin = time.process_time()
etid.identify_skin(study["typical/dry/01"], driver)
print(time.process_time() - begin, time.process_time())
"""


def _imports() -> Line:
    return _costs(
        "import etid / import jax, optimistix",
        import_time("import etid"),
        import_time("import jax, optimistix"),
        1.3,
    )


def _first_fits() -> list[Line]:
    """CPU time of a process that identifies a driver and a skin, and of the skin in it."""
    runs = [
        subprocess.run(
            [sys.executable, "-c", _FIRST], env=interpreter(), capture_output=True, check=True
        )
        for _ in range(PROCESSES)
    ]
    several = (tuple(map(float, run.stdout.split())) for run in runs)
    skin, both = (float(np.median(times)) for times in zip(*several, strict=True))
    return [
        Line("first driver and skin, with imports [CPU s]", both, math.nan, both, 2.2, False),
        Line("of these, the skin [CPU s]", skin, math.nan, skin, 0.75, False),
    ]


def run(quick: bool, asked: Sequence[int], output: pathlib.Path | None) -> bool:
    """Print all lines and the table of peers; whether every target is met.

    Args:
        quick: Few lanes, few repetitions.
        asked: Numbers of lanes in the table of peers, however long they take; some if empty.
        output: CSV of that table.
    """
    lanes, repeats = (8, 3) if quick else (98, 7)
    ten_periods = problem(SAMPLES, lanes)
    lines = [
        _imports(),
        *_first_fits(),
        *_filters(5 * repeats),
        *_solvers(ten_periods, repeats),
        *_from_samples(ten_periods, repeats),
        _joint(ten_periods, repeats),
        _driver(ten_periods, repeats),
        *_batches(lanes, repeats),
        _tick(lanes, 20 * repeats if quick else 2000),
    ]
    print(f"{'':<46}{'ours ms':>10}{'theirs ms':>11}{'ratio':>8}   target")
    for line in lines:
        sign = ">=" if line.at_least else "<="
        mark = "" if line.met else "   missed"
        print(
            f"{line.name:<46}{1e3 * line.ours:10.2f}{1e3 * line.theirs:11.2f}"
            f"{line.ratio:8.2f}   {sign} {line.target:g}{mark}"
        )
    print(f"limits: {_limits(ten_periods, repeats)}\n")
    several = asked or ((1, lanes) if quick else peers.LANES)
    limit = math.inf if asked else peers.LIMIT
    table = peers.show(peers.rows(lanes, several, 1 if quick else 3, limit))
    if output is not None:
        write_csv(output, table)
    return all(line.met for line in lines)


PINNED = True
OPTIONS = (
    QUICK,
    option(
        "--lanes",
        nargs="+",
        type=int,
        default=[],
        help="of the table of peers",
    ),
    option("-o", "--output", type=pathlib.Path, help="CSV of that table"),
)


def main(arguments: argparse.Namespace) -> bool:
    """Run the command; whether every target is met."""
    return run(arguments.quick, arguments.lanes, arguments.output)
