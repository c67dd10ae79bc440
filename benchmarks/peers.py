"""Every stage of a fit, and what others take for it: SciPy, stock optimistix, jaxopt.

All get the same residual and the same start. The two solvers in JAX, which have no filters, run as
their users run them, `vmap` over lanes, `SIDE_BY_SIDE` at a time. SciPy goes from lane to lane with
residual and Jacobian in NumPy, and is measured on a few of them.
"""

import importlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.optimize
import scipy.signal

import etid
from benchmarks.problem import SAMPLES, START, ByNumPy, Problem, harmonics, problem, terms
from benchmarks.timing import median_time
from etid.estimators.estimate import MAX_STEPS
from etid.estimators.harmonic_start import start_of_skin
from etid.estimators.maximum_likelihood.search import WELL
from etid.estimators.steiglitz_mcbride.iteration import in_time, iterate
from etid.identify.batches import each
from etid.signals.filtering import lfilter
from etid.signals.transfer import Rational
from etid.solvers.levenberg_marquardt import normal_equations

LANES = (1, 98, 1024, 10_000)
SIDE_BY_SIDE = 98
BY_SCIPY = 8  # lanes
LIMIT = 20.0  # [s] of one call; what will take longer is left out unless asked for
NAMES = ("ours", "scipy", "optimistix", "jaxopt")
B, A = cast(tuple[np.ndarray, np.ndarray], scipy.signal.butter(6, 0.3))

Run = Callable[[np.ndarray], Any]  # lanes by their numbers


class Stage(NamedTuple):
    """One stage, by whom it can be done."""

    name: str
    by: Mapping[str, Run]


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


def stages(of: Problem) -> list[Stage]:
    """All stages of a problem."""
    return [
        *_on_samples(of),
        Stage("SM iteration on harmonics", {"ours": harmonic_steiglitz_mcbride(of, 1)}),
        Stage("LM fit", solvers(of)),
        samples_to_fit(of),
        Stage("samples to judged joint fit", {"ours": judged(of)}),
    ]


def _on_samples(of: Problem) -> Iterator[Stage]:
    """Filter of order 6, its normal equations, and the first iteration of Steiglitz-McBride.

    That is without what ours does to judge it.
    """
    v_th, v_out = of.samples()
    x, b, a = map(jnp.asarray, (v_th, B, A))
    yield Stage(
        "filter of order 6",
        {
            "ours": _each(lambda v: lfilter(b, a, v)[0][-1], x),
            "scipy": _looped(lambda v: scipy.signal.lfilter(B, A, v), v_th),
        },
    )

    def equations(v):
        three = normal_equations(lambda q, _: lfilter(b, a.at[1:4].add(q), v)[0], jnp.zeros(3))
        return three.matrix

    def equations_by_scipy(v):
        y = scipy.signal.lfilter(B, A, v)
        slope = -np.asarray(scipy.signal.lfilter([1.0], A, y))  # dy/da_k = −z⁻ᵏ y / A
        columns = np.stack([np.r_[np.zeros(k), slope[:-k]] for k in (1, 2, 3)], axis=1)
        return columns.T @ columns

    by = {"ours": _each(equations, x), "scipy": _looped(equations_by_scipy, v_th)}
    yield Stage("normal equations of 3", by)
    z_th = Rational(of.driver.b, of.driver.a)
    num, den = np.asarray(of.driver.b), np.asarray(of.driver.a)

    def iteration(records):
        w = lfilter(z_th.num, z_th.den, records[1])[0]
        x = records[0] - records[1]

        def unjudged(_):
            return jnp.zeros(()), jnp.array(True)

        return iterate(in_time(x[None], w[None], 1, 1), 1, 1, unjudged, 1).filter.num

    def iteration_by_scipy(records):
        return numpy_steiglitz_mcbride(records[0], records[1], num, den, 1)[0]

    both = x, jnp.asarray(v_out)
    by = {"ours": _each(iteration, both), "scipy": _looped(iteration_by_scipy, (v_th, v_out))}
    yield Stage("Steiglitz-McBride iteration", by)


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


def samples_to_fit(of: Problem) -> Stage:
    """The same from the samples on, whose harmonics are made alike for all."""
    found = solvers(of)

    def after_harmonics(name: str) -> Run:
        def run(index):
            for i in index[:BY_SCIPY] if name == "scipy" else index:
                harmonics(of.records[i])
            return found[name](index)

        return run

    return Stage("samples to fit", {name: after_harmonics(name) for name in found})


def judged(of: Problem) -> Run:
    """What etid does by default: jointly with the calibration, with errors and a verdict."""
    return lambda index: etid.identify_skins([of.records[i] for i in index], of.driver).fit.chi2


def rows(
    distinct: int, lanes: Sequence[int], repeats: int, limit: float
) -> Iterator[dict[str, Any]]:
    """Milliseconds per lane, one row per stage and number of lanes; more lanes repeat the distinct.

    No call is made that will take longer than `limit` [s].
    """
    for stage in stages(problem(SAMPLES, distinct)):
        known: dict[str, float] = {}
        for count in lanes:
            index = np.arange(count) % distinct
            row: dict[str, Any] = {"stage": stage.name, "lanes": count}
            for name in NAMES:
                run, done = stage.by.get(name), min(count, BY_SCIPY) if name == "scipy" else count
                if run is None or known.get(name, 0.0) * done > limit:
                    row[name] = None
                    continue
                time = median_time(lambda run=run, index=index: run(index), repeats)
                known[name] = time / done
                row[name] = 1e3 * known[name]
            yield row


def show(table: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Print rows as they come."""
    print(f"{'ms per lane':<30}{'lanes':>7}" + "".join(f"{name:>12}" for name in NAMES))
    shown = []
    for row in table:
        cells = (f"{row[name]:12.3f}" if row[name] is not None else f"{'-':>12}" for name in NAMES)
        print(f"{row['stage']:<30}{row['lanes']:>7}" + "".join(cells), flush=True)
        shown.append(row)
    return shown
