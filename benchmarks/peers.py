"""What others take for a fit: SciPy, stock optimistix, jaxopt.

All get the same residual and the same start. The two solvers in JAX, which have no filters, run as
their users run them, `vmap` over lanes, `SIDE_BY_SIDE` at a time. SciPy goes from lane to lane with
residual and Jacobian in NumPy, and is measured on a few of them.
"""

import importlib
import warnings
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize
import scipy.signal

import etid
from benchmarks.problem import START, ByNumPy, Problem, harmonics, terms
from etid.estimators.estimate import MAX_STEPS
from etid.estimators.harmonic_start import start_of_skin
from etid.estimators.maximum_likelihood.search import WELL
from etid.identify.fitting import each

SIDE_BY_SIDE = 98
BY_SCIPY = 8  # lanes
B, A = cast(tuple[np.ndarray, np.ndarray], scipy.signal.butter(6, 0.3))

Run = Callable[[np.ndarray], Any]  # lanes by their numbers


def _each(one: Callable[[Any], Any], data: Any) -> Run:
    """Lanes one after the other on a processor, as etid does."""

    @jax.jit
    def run(data, index):
        return each(lambda i: one(jax.tree.map(lambda leaf: leaf[i], data)), index, index.size)

    return lambda index: run(data, jnp.asarray(index))


def _vmapped(one: Callable[[Any], Any], data: Any) -> Run:
    """Lanes side by side."""

    @jax.jit
    def run(data, index):
        lanes = jax.tree.map(lambda leaf: leaf[index], data)
        if index.shape[0] <= SIDE_BY_SIDE:
            return jax.vmap(one)(lanes)
        return jax.lax.map(one, lanes, batch_size=SIDE_BY_SIDE)

    return lambda index: run(data, jnp.asarray(index))


def _looped(one: Callable[[Any], Any], data: Any) -> Run:
    """Lanes in a Python loop, those few that SciPy is measured on."""
    return lambda index: [
        one(jax.tree.map(lambda leaf, i=i: leaf[i], data)) for i in index[:BY_SCIPY]
    ]


def numpy_steiglitz_mcbride(
    v_th: np.ndarray, v_out: np.ndarray, b: np.ndarray, a: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """N and D of the skin (paper, eqs. 1, 8, 9), as one would write it with NumPy and SciPy."""
    x, w = v_th - v_out, scipy.signal.lfilter(b, a, v_out)
    den = np.array([1.0])
    num = den
    for _ in range(iterations):
        xf, wf = scipy.signal.lfilter([1.0], den, x), scipy.signal.lfilter([1.0], den, w)
        columns = np.stack([xf, np.r_[0.0, xf[:-1]], -np.r_[0.0, wf[:-1]]], axis=1)
        found = np.linalg.lstsq(columns, wf)[0]
        num, den = found[:2], np.array([1.0, found[2]])
    return num, den


def harmonic_steiglitz_mcbride(of: Problem, iterations: int) -> Run:
    """Our Steiglitz-McBride on the harmonics, a start of fits."""
    z_th = of.known.z_th(jnp.zeros_like(of.known.loaded))

    def ours(one):
        return start_of_skin(one.spectrum, z_th, one.sample_rate, iterations)[0].values()

    return _each(ours, of.lanes)


def one_fit(of: Problem) -> dict[str, Callable[[Any], Any]]:
    """Elements and delay of one lane, by each solver in JAX."""
    start = jnp.asarray(START)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is no longer maintained, and says so when imported
        jaxopt = importlib.import_module("jaxopt")

    def by(solver):
        settings = {"max_steps": MAX_STEPS, "throw": False}
        return lambda one: (
            optx.least_squares(terms, solver, start, args=of.load(one), **settings).value
        )

    rival = jaxopt.LevenbergMarquardt(
        terms,
        maxiter=MAX_STEPS,
        stop_criterion="madsen-nielsen",
        xtol=1e-8,
        gtol=1e-8,
        solver="cholesky",
        materialize_jac=True,
    )
    return {
        "ours": by(WELL),
        "optimistix": by(optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)),
        "jaxopt": lambda one: rival.run(start, of.load(one)).params,
    }


def _minpack(value: Callable, slope: Any) -> np.ndarray:
    return scipy.optimize.least_squares(value, START, jac=slope, method="lm", x_scale="jac").x


def _scipy_fit(of: Problem) -> Callable[[Any], np.ndarray]:
    def fit(one):
        by = ByNumPy(of.load(one))
        return _minpack(by.terms, by.jacobian)

    return fit


def compiled_scipy_fit(of: Problem) -> Callable[[Any], np.ndarray]:
    """By MINPACK with our compiled terms, and a Jacobian by forward differentiation."""
    value, slope = jax.jit(terms), jax.jit(jax.jacfwd(terms))

    def fit(one):
        load = of.load(one)
        return _minpack(lambda q: np.asarray(value(q, load)), lambda q: np.asarray(slope(q, load)))

    return fit


def solvers(of: Problem) -> dict[str, Run]:
    """One fit per lane, Z_th known, by every solver."""
    by, lanes = one_fit(of), of.lanes
    return {
        "ours": _each(by["ours"], lanes),
        "scipy": _looped(_scipy_fit(of), lanes),
        "optimistix": _vmapped(by["optimistix"], lanes),
        "jaxopt": _vmapped(by["jaxopt"], lanes),
    }


def from_samples_by_scipy(of: Problem) -> Run:
    """SciPy's fits from the samples on, with our harmonics."""
    fit = _scipy_fit(of)

    def one(i: int) -> np.ndarray:
        harmonics(of.records[i])
        return fit(jax.tree.map(lambda leaf: leaf[i], of.lanes))

    return lambda index: [one(i) for i in index[:BY_SCIPY]]


def judged(of: Problem) -> Run:
    """What etid does by default: jointly with the calibration, with errors and a verdict."""
    return lambda index: etid.identify_skins([of.records[i] for i in index], of.driver).fit.chi2
