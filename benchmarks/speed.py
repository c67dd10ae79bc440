"""Ratios of speed against what one would use instead, in one run on one core, compilation apart.

Each line is a ratio of medians with its target; a missed target makes the command end with 1.
"""

import math
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal

from benchmarks import peers
from benchmarks.peers import A, B
from benchmarks.problem import SAMPLES, problem
from benchmarks.provenance import write_csv
from benchmarks.timing import first_and_warm, import_time
from etid.batch import each
from etid.circuits import SkinRC
from etid.filtering import lfilter
from etid.identify import skin_lane
from etid.levenberg_marquardt import normal_equations


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


def pin() -> None:
    """One core for this process, before JAX counts them."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


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


def _solvers(lanes: int, repeats: int) -> list[Line]:
    """The same residual, start and minimum: elements and delay with Z_th known."""
    several = problem(10_000, lanes)
    by, every = peers.solvers(several, peers.spectra(several)), np.arange(lanes)
    ours = by["ours"](every)
    np.testing.assert_allclose(ours[0], by["scipy"](every[:1])[0], atol=1e-5)
    np.testing.assert_allclose(ours, by["optimistix"](every), atol=1e-4)
    each_of_ours = median_time(lambda: by["ours"](every), repeats) / lanes
    each_of_stock = median_time(lambda: by["optimistix"](every), repeats) / lanes
    by_scipy = median_time(lambda: by["scipy"](every[:1]), repeats)
    return [
        _gains("scipy least_squares (lm) / LM", each_of_ours, by_scipy, 6.0),
        _gains(f"vmapped optimistix LM / LM, {lanes} lanes", each_of_ours, each_of_stock, 8.0),
    ]


def _raw_to_fit(lanes: int, repeats: int) -> list[Line]:
    """From the samples of ten periods to a judged fit, jointly with the calibration."""
    several = problem(SAMPLES, lanes)
    circuit = SkinRC()

    @eqx.filter_jit
    def fit(samples):
        def one(lane):
            return skin_lane(lane, several.driver, circuit, "maximum_likelihood", several.window)

        return each(one, samples)

    record = np.asarray(several.lanes[0][0])
    reference = median_time(lambda: scipy.signal.lfilter(B, A, record), repeats)
    ours = median_time(lambda: fit(several.lanes).circuit.values(), repeats) / lanes
    return [_costs(f"raw to fit / scipy lfilter, {lanes} lanes", ours, reference, 0.5)]


_WARM = """
import time, jax
jax.config.update("jax_enable_x64", True)
import etid
study = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
driver = etid.identify_driver(study["calibration/98k8"])
begin = time.perf_counter()
etid.identify_skin(study["typical/dry/01"], driver)
print(time.perf_counter() - begin)
"""


def _imports() -> Line:
    return _costs(
        "import etid / import jax, optimistix",
        import_time("import etid"),
        import_time("import jax, optimistix"),
        1.3,
    )


def _first_fit() -> Line:
    """First fit of a fresh process whose compilations are all in the persistent cache."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        runs = [
            subprocess.run(
                [sys.executable, "-c", _WARM], env=environment, capture_output=True, check=True
            )
            for _ in range(2)
        ]
    cold, warm = (float(run.stdout) for run in runs)
    return Line("first fit with a warm cache [s]", warm, cold, warm, 0.3, False)


def run(quick: bool, asked: Sequence[int], output: pathlib.Path | None) -> bool:
    """Print all lines and the table of peers; whether every target is met.

    Args:
        quick: Few lanes, few repetitions.
        asked: Numbers of lanes in the table of peers, however long they take; some if empty.
        output: CSV of that table.
    """
    lanes, repeats = (8, 3) if quick else (98, 7)
    lines = [
        _imports(),
        _first_fit(),
        *_filters(5 * repeats),
        *_solvers(lanes, repeats),
        *_raw_to_fit(lanes, 1 if quick else 3),
    ]
    print(f"{'':<44}{'ours ms':>10}{'theirs ms':>11}{'ratio':>8}   target")
    for line in lines:
        sign = ">=" if line.at_least else "<="
        mark = "" if line.met else "   missed"
        print(
            f"{line.name:<44}{1e3 * line.ours:10.2f}{1e3 * line.theirs:11.2f}"
            f"{line.ratio:8.2f}   {sign} {line.target:g}{mark}"
        )
    print()
    several = asked or ((1, lanes) if quick else peers.LANES)
    limit = math.inf if asked else peers.LIMIT
    table = peers.show(peers.rows(lanes, several, 1 if quick else 3, limit))
    if output is not None:
        write_csv(output, table)
    return all(line.met for line in lines)
