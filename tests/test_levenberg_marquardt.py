"""The search that all fits share: its minima, its steps, and what must not stop it."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from etid.likelihood.linear import LevenbergMarquardt, NormalEquations
from etid.precision import array_function

TIME = np.linspace(0.0, 5.0, 60)
TRUTH = np.array([3.0, 1.7, 0.8])
START = np.array([1.0, 0.3, 0.0])
DATA = TRUTH[0] * np.exp(-TRUTH[1] * TIME) + TRUTH[2]
DATA = DATA + 0.05 * np.random.default_rng(7).normal(size=TIME.size)
SEARCH = LevenbergMarquardt(damping=1e-2, steps=200, patience=3, relative=1e-12)
# Where ½ Σ r² no longer falls by 1e-12 of itself, a parameter is 1e-6 standard errors from its
# minimum, times the root of the number of data.
AGREE = 1e-5


def decay(y, data=DATA):
    """An exponential with an offset: one state of a circuit."""
    return y[0] * jnp.exp(-y[1] * TIME) + y[2] - data


def rosenbrock(y):
    return jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])


def powell(y):
    """Moré, Garbow & Hillstrom no. 13; singular at its zero."""
    first = y[0] + 10 * y[1], np.sqrt(5.0) * (y[2] - y[3])
    return jnp.stack([*first, (y[1] - 2 * y[2]) ** 2, np.sqrt(10.0) * (y[0] - y[3]) ** 2])


@functools.cache
def with_slopes(residual):
    """Of rows, compiled as a whole."""
    return jax.jit(jax.vmap(lambda *row: (residual(*row), jax.jacfwd(residual)(*row))))


@dataclasses.dataclass(frozen=True)
class Terms:
    """Residuals of rows, each with its own data if there are any."""

    residual: Callable[..., Any]
    data: np.ndarray | None = None
    in_numpy: bool = True

    def equations(self, q):
        """The normal equations."""
        rows = (q,) if self.data is None else (q, self.data)
        found = with_slopes(self.residual)(*rows)
        terms, slopes = map(np.asarray, found) if self.in_numpy else found
        return NormalEquations.of(terms, slopes.swapaxes(-1, -2))

    def of(self, rows):
        """Some of the rows."""
        data = None if self.data is None else self.data[rows]
        return dataclasses.replace(self, data=data)


@array_function
def solve(residual, start, data=None, search=SEARCH):
    """The search from a start, or from one for each row."""
    start = np.atleast_2d(np.asarray(start, float))
    terms = Terms(residual, data)
    return search(terms, start, terms.equations(start), 0.0)


@pytest.mark.parametrize(
    ("residual", "start"),
    [(decay, START), (rosenbrock, [-1.2, 1.0]), (powell, [3.0, -1.0, 0.0, 1.0])],
)
def test_a_minimum_is_that_of_scipy(residual, start):
    of = {"method": "lm", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    expected = scipy.optimize.least_squares(lambda y: np.asarray(residual(y)), start, **of)
    # At a zero no part of ½ Σ r² is small; there 1e-20 is.
    found = solve(residual, start)
    # At Powell's zero the Jacobian loses two ranks; there the fourth root of rounding is the limit.
    np.testing.assert_allclose(found.q[0], expected.x, atol=1e-3 if residual is powell else AGREE)
    assert found.equations.objective[0] <= expected.cost * (1 + 1e-10) + 1e-12
    if residual is decay:
        assert not found.moves[0]
        slopes = np.asarray(jax.jacfwd(decay)(found.q[0]))
        np.testing.assert_allclose(found.equations.matrix[0], slopes.T @ slopes, rtol=1e-12)


@pytest.mark.parametrize(
    ("residual", "unit", "units"),
    [
        # A solver with absolute tolerances calls residuals of 1e-6 converged and does not move.
        (lambda y: 1e-6 * decay(y), 1e-6, np.ones(3)),
        (lambda y: 1e6 * decay(y), 1e6, np.ones(3)),
        (lambda y: decay(y * UNITS), 1.0, np.array([1e-9, 1e5, 1e3])),  # farad and ohm
    ],
)
def test_units_of_residual_and_parameters_change_nothing(residual, unit, units):
    # At the minimum rounding decides which step is the last.
    search = dataclasses.replace(SEARCH, steps=6)
    plain, scaled = (
        solve(of, start, search=search) for of, start in ((decay, START), (residual, START / units))
    )
    np.testing.assert_allclose(scaled.damping, plain.damping, rtol=1e-9)
    np.testing.assert_allclose(scaled.q * units, plain.q, rtol=1e-9)
    np.testing.assert_allclose(scaled.equations.objective, unit**2 * plain.equations.objective)
    assert np.abs(plain.q - START).max() > 0.5


UNITS = np.array([1e-9, 1e5, 1e3])


def test_numpy_and_jax_take_the_same_steps():
    """Twenty lines of Python loop over the rows that move, and a loop of JAX over all."""
    starts = START + np.random.default_rng(1).uniform(-0.2, 0.2, (4, 3))
    for steps in (1, 3, 200):
        search = dataclasses.replace(SEARCH, steps=steps)
        found = solve(decay, starts, search=search)
        terms = Terms(decay, in_numpy=False)

        @jax.jit
        @array_function
        def traced(start, search=search, terms=terms):
            return search(terms, start, terms.equations(start), 0.0)

        other = traced(jnp.asarray(starts))
        np.testing.assert_allclose(other.q, found.q, rtol=1e-9)
        if steps < 200:  # the end is where rounding decides
            np.testing.assert_array_equal(other.steps, found.steps)


def test_a_step_into_nan_is_rejected_and_the_fit_goes_on():
    """The Newton step leaves the domain of the square root."""

    def residual(y):
        return jnp.sqrt(y) * jnp.ones(2) - jnp.array([0.01, 0.02])

    start = jnp.array([1.0])
    newton = start - jnp.linalg.lstsq(jax.jacfwd(residual)(start), residual(start))[0]
    assert bool(jnp.isnan(residual(newton)).any())  # else this tests nothing
    found = solve(residual, start)
    assert not found.moves[0]
    np.testing.assert_allclose(found.q[0], [0.015**2], rtol=1e-5)


def test_a_fit_that_cannot_succeed_says_so():
    for residual, start in (
        (lambda y: jnp.log(y) * jnp.ones(4), -1.0),  # no number
        (lambda y: jnp.sqrt(y) + jnp.arange(1.0, 5.0), 0.0),  # an infinite slope
    ):
        found = solve(residual, [start])
        assert np.isinf(found.equations.objective[0])
        assert found.steps[0] == 0

    def stuck(y):  # NaN away from one point, so that every trial step is rejected
        return jnp.where(jnp.all(y == START), decay(y), jnp.nan)

    search = dataclasses.replace(SEARCH, steps=20)
    found = solve(stuck, START, search=search)
    assert found.moves[0]
    np.testing.assert_array_equal(found.q[0], START)


def test_a_parameter_without_effect_stays_where_it_was():
    found = solve(lambda y: decay(y[:3]), np.append(START, 4.0))
    assert found.q[0, 3] == 4.0
    np.testing.assert_allclose(found.q[0, :3], solve(decay, START).q[0], atol=AGREE)


def test_rows_do_not_see_each_other():
    generator = np.random.default_rng(11)
    amplitude, rate = generator.uniform(1, 5, 6), generator.uniform(0.5, 3, 6)
    clean = amplitude[:, None] * np.exp(-rate[:, None] * TIME) + 0.5
    data = clean + 0.05 * generator.normal(size=clean.shape)
    starts, poisoned = np.tile(START, (6, 1)), data.copy()
    poisoned[2, 5] = np.nan
    values, others = solve(decay, starts, data).q, np.array([0, 1, 3, 4, 5])
    found = solve(decay, starts, poisoned).q
    np.testing.assert_array_equal(found[others], values[others])
    np.testing.assert_array_equal(found[2], START)  # left where it was, not sent anywhere
    order = np.array([4, 2, 0, 5, 1, 3])
    np.testing.assert_array_equal(solve(decay, starts, data[order]).q, values[order])
