"""Ratios of speed against what one would use instead, in one run on one core, compilation apart.

Each line is a ratio of medians with its target; a missed target makes the command end with 1.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize
import scipy.signal

import etid
from benchmarks.timing import first_and_warm, import_time
from etid import estimation
from etid.batch import each
from etid.circuits import SkinRC
from etid.filtering import lfilter
from etid.harmonic_steiglitz_mcbride import fit_skin
from etid.identify import arrays, skin_lane, window
from etid.levenberg_marquardt import normal_equations
from etid.likelihood import residual
from etid.maximum_likelihood import MAX_STEPS, SOLVER, Joint
from etid.measurement import measure
from etid.scenes import Scene, Trial
from etid.steiglitz_mcbride import ITERATIONS
from etid.transformer import ResistorLoad, SkinLoad

SAMPLES = 33_330  # ten pulse periods at 200 kHz
LOAD = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
B, A = cast(tuple[np.ndarray, np.ndarray], scipy.signal.butter(6, 0.3))
WARM = 3  # processes that find what another one has compiled
TRUTH = dataclasses.astuple(LOAD)
START = np.log([20e3, 100e3, 0.3e-9])  # typical values, a factor of two from the truth


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


class _Problem(NamedTuple):
    study: etid.Study
    driver: etid.Driver
    lanes: Any
    window: estimation.Window
    model: Joint


def _problem(samples: int, lanes: int) -> _Problem:
    scene = Scene(
        tuple(Trial(f"loaded/{i}", LOAD) for i in range(lanes)),
        (Trial("calibration/0", ResistorLoad(98.8e3)),),
        samples=samples,
        trigger_jitter_rms=50e-9,
    )
    study = scene.simulate(seed=3)
    driver = etid.identify_driver(study["calibration/0"])
    records = list(study.loaded.recordings())
    part = window(records[0], "maximum_likelihood", driver)
    assert part is not None
    assert driver.source is not None
    assert driver.calibration is not None
    samples_of = tuple(
        jnp.asarray(np.stack(column)) for column in zip(*map(arrays, records), strict=True)
    )
    rate = jnp.asarray(driver.sample_rate)
    model = Joint(SkinRC(), driver.source, driver.calibration, rate, part.shared)
    return _Problem(study, driver, samples_of, part, model)


def _solvers(lanes: int, repeats: int) -> list[Line]:
    """The same residual, start and minimum: elements and delay with Z_th known."""
    problem = _problem(10_000, lanes)
    model, common = problem.model, problem.model.start()
    start = jnp.append(jnp.asarray(START), 0.0)

    @jax.jit
    def spectra(samples):
        return each(lambda s: estimation.spectrum_of(measure(*s), problem.window), samples)

    several = spectra(problem.lanes)
    rate = jnp.asarray(problem.driver.sample_rate)

    def terms(own, spectrum):
        return residual(spectrum, model.gain(own, common, spectrum, rate))

    def fit(solver):
        def one(spectrum):
            return optx.least_squares(
                terms, solver, start, args=spectrum, max_steps=MAX_STEPS, throw=False
            ).value

        return one

    ours = jax.jit(lambda spectra: each(fit(SOLVER), spectra))
    stock = jax.jit(jax.vmap(fit(optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8))))
    first = jax.tree.map(lambda leaf: leaf[0], several)
    value = jax.jit(lambda own: terms(own, first))
    slope = jax.jit(jax.jacfwd(lambda own: terms(own, first)))

    by_slope: Any = lambda q: np.asarray(slope(q))  # noqa: E731 - SciPy's stubs want a name

    def by_scipy():
        return scipy.optimize.least_squares(
            lambda q: np.asarray(value(q)),
            np.asarray(start),
            jac=by_slope,
            method="lm",
            x_scale="jac",
        )

    np.testing.assert_allclose(ours(several)[0], by_scipy().x, atol=1e-5)
    np.testing.assert_allclose(ours(several), stock(several), atol=1e-4)
    each_of_ours = median_time(lambda: ours(several), repeats) / lanes
    each_of_stock = median_time(lambda: stock(several), repeats) / lanes
    return [
        _gains("scipy least_squares (lm) / LM", each_of_ours, median_time(by_scipy, repeats), 6.0),
        _gains(f"vmapped optimistix LM / LM, {lanes} lanes", each_of_ours, each_of_stock, 8.0),
    ]


def _raw_to_fit(lanes: int, repeats: int) -> list[Line]:
    """From the samples of ten periods to a judged fit, jointly with the calibration."""
    problem = _problem(SAMPLES, lanes)
    circuit = SkinRC()

    @eqx.filter_jit
    def fit(samples):
        def one(lane):
            return skin_lane(lane, problem.driver, circuit, "maximum_likelihood", problem.window)

        return each(one, samples)

    record = np.asarray(problem.lanes[0][0])
    reference = median_time(lambda: scipy.signal.lfilter(B, A, record), repeats)
    ours = median_time(lambda: fit(problem.lanes).circuit.values(), repeats) / lanes
    return [_costs(f"raw to fit / scipy lfilter, {lanes} lanes", ours, reference, 0.5)]


def _by_lfilter(x: np.ndarray, w: np.ndarray, iterations: int) -> np.ndarray:
    """Eqs. (1), (2) for a filter of order 1, with SciPy and NumPy: b₀, b₁, a₁."""
    found, prefilter = np.zeros(3), np.array([1.0, 0.0])
    for _ in range(iterations):
        xf, wf = (np.asarray(scipy.signal.lfilter([1.0], prefilter, v)) for v in (x, w))
        columns = np.stack([xf[1:], xf[:-1], -wf[:-1]], axis=1)
        found = np.linalg.lstsq(columns, wf[1:])[0]
        prefilter[1] = found[2] if abs(found[2]) < 1 else 1 / found[2]  # reflected if unstable
    return found


def _steiglitz_mcbride(lanes: int, repeats: int) -> list[Line]:
    """Twenty iterations on the harmonics against as many on the samples of a recording.

    The second line adds what makes harmonics and their noise of the samples.
    """
    problem = _problem(SAMPLES, lanes)
    source = problem.driver.source
    assert source is not None

    def project(lane):
        return estimation.spectrum_of(measure(*lane), problem.window)

    def fit(spectrum):
        return fit_skin(spectrum, source.response(spectrum.frequency), ITERATIONS).circuit.values()

    iterate = jax.jit(lambda spectra: each(fit, spectra))
    whole = jax.jit(lambda samples: each(lambda lane: fit(project(lane)), samples))
    spectra = jax.jit(lambda samples: each(project, samples))(problem.lanes)
    np.testing.assert_allclose(np.median(iterate(spectra), axis=0), TRUTH, rtol=0.05)

    v_th, v_out = (np.asarray(column[0]) for column in problem.lanes[:2])
    b, a = np.asarray(problem.driver.b), np.asarray(problem.driver.a)

    def by_lfilter():
        w = np.asarray(scipy.signal.lfilter(b, a, v_out))
        return _by_lfilter(v_th - v_out, w, ITERATIONS)

    theirs = median_time(by_lfilter, repeats)
    return [
        _gains(name, median_time(ours, repeats) / lanes, theirs, 15.0)
        for name, ours in (
            (f"lfilter, lstsq SM / harmonic SM, {lanes} lanes", lambda: iterate(spectra)),
            ("lfilter, lstsq SM / the same from samples", lambda: whole(problem.lanes)),
        )
    ]


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
    """First fit of a process that finds all its programs on disk, traced and compiled."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        runs = [
            subprocess.run(
                [sys.executable, "-c", _WARM], env=environment, capture_output=True, check=True
            )
            for _ in range(1 + WARM)
        ]
    cold, *several = (float(run.stdout) for run in runs)
    warm = float(np.median(several))
    return Line("first fit with a warm cache [s]", warm, cold, warm, 0.3, False)


def run(quick: bool) -> bool:
    """Print all lines; whether every target is met."""
    lanes, repeats = (8, 3) if quick else (98, 7)
    lines = [
        _imports(),
        _first_fit(),
        *_filters(5 * repeats),
        *_solvers(lanes, repeats),
        *_raw_to_fit(lanes, 1 if quick else 3),
        *_steiglitz_mcbride(lanes, repeats),
    ]
    print(f"{'':<44}{'ours ms':>10}{'theirs ms':>11}{'ratio':>8}   target")
    for line in lines:
        sign = ">=" if line.at_least else "<="
        mark = "" if line.met else "   missed"
        print(
            f"{line.name:<44}{1e3 * line.ours:10.2f}{1e3 * line.theirs:11.2f}"
            f"{line.ratio:8.2f}   {sign} {line.target:g}{mark}"
        )
    return all(line.met for line in lines)
