"""Ratios of speed against what one would use instead, in one run on one core, compilation apart.

Each line is a ratio of medians with its target; a missed target makes the command end with 1.
"""

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import jax
import numpy as np
import scipy.signal

import etid
from benchmarks import peers
from benchmarks.display import online
from benchmarks.machine import import_time, interpreter, median_time
from benchmarks.peers import LOAD, SAMPLES, A, B, Problem, harmonics, problem
from benchmarks.runner import QUICK, Target, report
from etid.estimators.steiglitz_mcbride.iteration import ITERATIONS

PINNED = True
PROCESSES = 3  # whose median counts
BATCH = 1024  # recordings of a batch that is compiled, also of 5 000 samples
OPTIONS = (QUICK,)


def _times(ours: float, theirs: float, ratio: float) -> str:
    return f"{1e3 * ours:10.2f} ms, theirs {1e3 * theirs:10.2f} ms, ratio {ratio:8.2f}"


def costs(name: str, ours: float, theirs: float, most: float) -> Target:
    """Our time in units of theirs, at most so much."""
    return Target(name, ours / theirs, most=most, text=_times(ours, theirs, ours / theirs))


def gains(name: str, ours: float, theirs: float, least: float) -> Target:
    """Their time in units of ours, at least so much."""
    return Target(name, theirs / ours, least, text=_times(ours, theirs, theirs / ours))


def filters(repeats: int) -> Iterator[Target]:
    """One pass, gradient and normal equations of a filter of order 6 over ten periods."""
    x = np.random.default_rng(0).normal(size=SAMPLES)
    reference = median_time(lambda: scipy.signal.lfilter(B, A, x), repeats)
    for (name, call), most in zip(peers.filter_calls(x).items(), (0.8, 2.0, 4.0), strict=True):
        yield costs(f"{name} / scipy lfilter", median_time(call, repeats), reference, most)


def solvers(of: Problem, repeats: int) -> Iterator[Target]:
    """The same residual, start and minimum: elements and delay with Z_th known."""
    by, every = peers.solvers(of), np.arange(len(of.records))
    ours = by["ours"](every)
    np.testing.assert_allclose(ours[0], by["scipy"](every[:1])[0], atol=1e-5)
    np.testing.assert_allclose(ours, by["optimistix"](every), atol=1e-4)
    each = median_time(lambda: by["ours"](every), repeats) / every.size
    stock = median_time(lambda: by["optimistix"](every), repeats) / every.size
    by_scipy = median_time(lambda: by["scipy"](every[:1]), repeats)
    compiled = peers.compiled_scipy_fit(of)
    first = jax.tree.map(lambda leaf: leaf[0], of.lanes)
    np.testing.assert_allclose(ours[0], compiled(first), atol=1e-5)
    with_ours = median_time(lambda: compiled(first), repeats)
    yield gains("scipy least_squares (lm), NumPy / LM", each, by_scipy, 6.0)
    yield gains("the same with our compiled terms / LM", each, with_ours, 10.0)
    yield gains(f"vmapped optimistix LM / LM, {every.size} lanes", each, stock, 8.0)


def from_samples(of: Problem, repeats: int) -> Iterator[Target]:
    """From ten periods to a judged joint fit, and to Steiglitz-McBride on their harmonics."""
    every, record = np.arange(len(of.records)), of.records[0]
    batch, v_th, v_out = np.resize(every, BATCH), record.v_th, record.v_out
    reference = median_time(lambda: scipy.signal.lfilter(B, A, v_th), 5 * repeats)
    ours = median_time(lambda: peers.judged(of)(batch), repeats) / BATCH
    yield costs(f"raw to judged fit / scipy lfilter, {BATCH} lanes", ours, reference, 1.5)

    iterate, truth = peers.harmonic_steiglitz_mcbride(of), dataclasses.astuple(LOAD)
    np.testing.assert_allclose(np.median(iterate(every), axis=0), truth, rtol=0.05)
    on_harmonics = median_time(lambda: iterate(every), repeats) / every.size
    whole = on_harmonics + median_time(lambda: harmonics(record), 5 * repeats)
    b, a = np.asarray(of.driver.b), np.asarray(of.driver.a)
    theirs = median_time(
        lambda: peers.numpy_steiglitz_mcbride(v_th, v_out, b, a, ITERATIONS), repeats
    )
    yield gains("lfilter, lstsq SM / SM on harmonics", on_harmonics, theirs, 15.0)
    yield gains("the same / SM from samples", whole, theirs, 15.0)


def fits(of: Problem, repeats: int) -> Iterator[Target]:
    """All trials and their driver in one fit, the driver alone, and batches of three periods."""
    lanes, calibration = len(of.records), of.study["calibration/0"]
    batch = np.resize(np.arange(lanes), BATCH)
    alone = median_time(lambda: peers.judged(of)(batch), repeats) / BATCH
    found = median_time(lambda: etid.identify_jointly(of.study), repeats) / lanes
    text = f"{1e3 * found:.2f}, alone {1e3 * alone:.2f}"
    yield Target("joint fit of a trial [ms]", 1e3 * found, most=3.0, text=text)
    method = "maximum_likelihood"
    found = median_time(
        lambda: etid.identify_driver(calibration, method=method, throw=False), repeats
    )
    yield Target("driver, warm [ms]", 1e3 * found, most=250.0)  # by NumPy: nothing is compiled
    three, of_file = problem(10_000, lanes), problem(5_000, lanes, sample_rate=100e3)
    ours = median_time(lambda: peers.judged(three)(batch), repeats) / BATCH
    by_scipy = peers.from_samples_by_scipy(three)
    theirs = median_time(lambda: by_scipy(batch[:1]), repeats)
    yield gains("SciPy on harmonics / skin, 10 000 samples", ours, theirs, 12.0)
    stored = median_time(lambda: peers.judged(of_file)(batch), repeats) / BATCH
    yield Target("10^5 recordings of 5 000 samples [s]", 1e5 * stored, most=20.0)


def tick(electrodes: int, ticks: int) -> Target:
    """A tick on-line with its tests and the next command, against the time between two pulses."""
    tracker, pulses = online.problem(electrodes)
    period = tracker.period / tracker.model.bands.sample_rate
    ratio = float(np.percentile(online.timed(tracker, pulses, ticks)[1], 99))
    name = f"tick of {electrodes} electrodes, p99 / period"
    return costs(name, ratio * period, period, online.TICK)


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


def in_new_processes() -> Iterator[Target]:
    """Import; CPU time of a process that identifies a driver and a skin, and of the skin in it."""
    theirs = "import jax, optimistix"
    yield costs(f"import etid / {theirs}", import_time("import etid"), import_time(theirs), 1.3)
    command = [sys.executable, "-c", _FIRST]
    runs = [
        subprocess.run(command, env=interpreter(), capture_output=True, check=True).stdout.split()
        for _ in range(PROCESSES)
    ]
    skin, both = np.median(np.array(runs, float), axis=0)
    yield Target("first driver and skin, with imports [CPU s]", both, most=2.2)
    yield Target("of these, the skin [CPU s]", skin, most=0.75)


def commands() -> Iterator[Target]:
    """CPU time of whole commands, with empty caches, on a file of ten recordings."""
    with tempfile.TemporaryDirectory() as folder:
        etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0).write(f"{folder}/study.h5")
        empty = {**interpreter(), "XDG_CACHE_HOME": f"{folder}/cache"}

        def cpu(*words: str) -> float:
            took = []
            for _ in range(PROCESSES):
                shutil.rmtree(empty["XDG_CACHE_HOME"], ignore_errors=True)
                command = [sys.executable, "-m", "etid", *words]
                before = os.times()
                subprocess.run(command, cwd=folder, env=empty, capture_output=True, check=True)
                after = os.times()
                took.append(sum(after[2:4]) - sum(before[2:4]))
            return float(np.median(took))

        yield Target("etid --help [CPU s]", cpu("--help"), most=0.4)
        fit = cpu("fit", "study.h5", "-o", "fits.h5", "--force")
        yield Target("etid fit of ten recordings [CPU s]", fit, most=4.0)
        report_of = cpu("report", "fits.h5", "--force")
        yield Target("etid report of them [CPU s]", report_of, most=4.0)


def main(arguments: argparse.Namespace) -> bool:
    quick = arguments.quick
    lanes, repeats = (8, 3) if quick else (98, 7)
    targets = [*in_new_processes(), *commands(), *filters(5 * repeats)]
    ten_periods = problem(SAMPLES, lanes)
    for of in (solvers, from_samples, fits):
        targets += of(ten_periods, repeats)
    targets.append(tick(lanes, 20 * repeats if quick else 2000))
    return report(targets)
