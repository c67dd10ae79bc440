"""Ratios of speed against what one would use instead, in one run on one core, compilation apart.

Each line is a ratio of medians with its target; a missed target makes the command end with 1.
"""

import argparse
import dataclasses
import itertools
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
from benchmarks.ladder import recorded
from benchmarks.machine import import_time, interpreter, median_time
from benchmarks.peers import LOAD, SAMPLES, A, B, Problem, harmonics, problem
from benchmarks.runner import QUICK, Target, report
from etid.estimators.steiglitz_mcbride.iteration import ITERATIONS

PINNED = True
PROCESSES = 3  # whose median counts
BATCH = 1024  # recordings
MOST = {"driver": 250.0, "skin": 20.0, f"skin, batch of {BATCH}": 3.0}  # [ms], of three periods
MOST_OF_JOINT = 8.0  # [ms] of a trial of three periods
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


def fits(ten: Problem, repeats: int) -> Iterator[Target]:
    """A driver, a skin alone and in a batch, and a trial of a joint fit, by length of the records.

    They are those of [how fast](../docs/speed.md).
    """
    lanes = len(ten.records)
    three, one = problem(10_000, lanes), problem(3_334, lanes)
    batch = np.resize(np.arange(lanes), BATCH)
    in_batch = f"skin, batch of {BATCH}"
    for name, of in {"ten periods": ten, "three periods": three, "one period": one}.items():
        known, run = of.study["calibration/0"], peers.judged(of)
        calls = {
            "driver": (lambda known=known: etid.identify_driver(known, throw=False), 1),
            "skin": (lambda run=run: run(batch[:1]), 1),
            in_batch: (lambda run=run: run(batch), BATCH),
        }
        if of is not one:  # a joint fit needs several periods
            joint = f"trial, joint fit of {lanes}"
            calls[joint] = (lambda of=of: etid.identify_jointly(of.study), lanes)
        for what, (call, count) in calls.items():
            ms = 1e3 * median_time(call, repeats) / count
            most = MOST.get(what, MOST_OF_JOINT) if of is three else np.nan
            yield Target(f"{what}, {name} [ms]", ms, most=most)
    by_scipy = peers.from_samples_by_scipy(three)
    ours = median_time(lambda: peers.judged(three)(batch), repeats) / BATCH
    theirs = median_time(lambda: by_scipy(batch[:1]), repeats)
    yield gains("SciPy on harmonics / skin, 10 000 samples", ours, theirs, 12.0)
    scene = recorded({f"{at}": LOAD for at in range(lanes)}, {}, current_snr_db=60.0)
    records = list(scene.simulate(seed=3).recordings())
    currents = [records[at] for at in batch]
    ms = 1e3 * median_time(lambda: etid.identify_skins(currents, None), repeats) / BATCH
    yield Target("skin by a measured current, batch, three periods [ms]", ms)


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
        for joint in ((), ("--joint",)):
            fit = cpu("fit", "study.h5", "-o", "fits.h5", "--force", *joint)
            name = " ".join(("etid fit", *joint))
            yield Target(f"{name} of ten recordings [CPU s]", fit, most=4.0)
        report_of = cpu("report", "fits.h5", "--force")
        yield Target("etid report of them [CPU s]", report_of, most=4.0)


def main(arguments: argparse.Namespace) -> bool:
    quick = arguments.quick
    lanes, repeats = (8, 3) if quick else (98, 7)
    ten_periods = problem(SAMPLES, lanes)
    targets = itertools.chain(
        *(in_new_processes(), commands(), filters(5 * repeats)),
        *(of(ten_periods, repeats) for of in (solvers, from_samples, fits)),
        (tick(*of) for of in [(lanes, 20 * repeats if quick else 2000)]),
    )
    return report(targets)
