import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import (
    LevenbergMarquardt,
)

TIME = np.linspace(0.0, 5.0, 60)
TRUTH = np.array([3.0, 1.7, 0.8])
START = jnp.array([1.0, 0.3, 0.0])
rng = np.random.default_rng(7)
DATA = TRUTH[0] * np.exp(-TRUTH[1] * TIME) + TRUTH[2] + 0.05 * rng.normal(size=TIME.size)

# Two minimisers stopped at a relative offset of 1e-7 differ by some 1e-7 √60 standard errors.
AGREE = 1e-5
TIGHT = LevenbergMarquardt(rtol=1e-7, ftol=0.0)


def decay(y, data=DATA, xp=jnp):
    """An exponential with an offset: one state of a circuit."""
    return y[0] * xp.exp(-y[1] * xp.asarray(TIME)) + y[2] - data


def rosenbrock(y, xp=jnp):
    return xp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])


def bend(y, step, args):
    """Jᵀ r″ of `rosenbrock`, whose r″ is (−20 s₀², 0)."""
    return step[0] ** 2 * jnp.stack([400 * y[0], -200.0])


def powell(y, xp=jnp):
    """Moré, Garbow & Hillstrom no. 13; singular at its zero."""
    return xp.stack(
        [
            y[0] + 10 * y[1],
            np.sqrt(5.0) * (y[2] - y[3]),
            (y[1] - 2 * y[2]) ** 2,
            np.sqrt(10.0) * (y[0] - y[3]) ** 2,
        ]
    )


@eqx.filter_jit
def solve(residual, start, args=None, solver=TIGHT, max_steps=200):
    def fn(y, args):
        return residual(y) if args is None else residual(y, args)

    return optx.least_squares(fn, solver, start, args, max_steps=max_steps, throw=False)


@pytest.mark.parametrize(
    ("residual", "start"),
    [
        (decay, [1.0, 0.3, 0.0]),
        (rosenbrock, [-1.2, 1.0]),
        (powell, [3.0, -1.0, 0.0, 1.0]),
    ],
)
def test_minimum_is_that_of_scipy(residual, start):
    expected = scipy.optimize.least_squares(
        lambda y: residual(y, xp=np), start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    solution = solve(residual, jnp.array(start))
    assert solution.result == optx.RESULTS.successful
    # At Powell's zero the Jacobian loses two ranks; there the fourth root of rounding is the limit.
    atol = 1e-3 if residual is powell else AGREE
    np.testing.assert_allclose(solution.value, expected.x, atol=atol)
    objective = float(solution.stats["normal_equations"].objective)
    assert objective <= expected.cost * (1 + 1e-10) + 1e-12
    if residual is rosenbrock:  # its valley is a parabola; straight steps leave it
        bending = LevenbergMarquardt(rtol=1e-7, ftol=0.0, bend=bend)
        bent = solve(residual, jnp.array(start), solver=bending)
        np.testing.assert_allclose(bent.value, 1.0, rtol=AGREE)
        assert int(bent.stats["num_steps"]) < 0.8 * int(solution.stats["num_steps"])


def test_statistics_are_the_normal_equations_at_the_solution():
    solution = solve(decay, START)
    equations = solution.stats["normal_equations"]
    r, jacobian = decay(solution.value), jax.jacfwd(decay)(solution.value)
    np.testing.assert_allclose(equations.objective, 0.5 * r @ r, rtol=1e-12)
    np.testing.assert_allclose(equations.matrix, jacobian.T @ jacobian, rtol=1e-12)
    # |Q₁ᵀ r| ≤ rtol |r|, computed independently
    q, _ = np.linalg.qr(jacobian)
    assert np.linalg.norm(q.T @ r) <= 1e-7 * np.linalg.norm(r) * (1 + 1e-6)


@pytest.mark.parametrize(
    ("residual", "unit", "units"),
    [
        # A solver with absolute tolerances calls residuals of 1e-6 converged and does not move.
        (lambda y, unit: unit * decay(y), 1e-6, 1.0),
        (lambda y, unit: unit * decay(y), 1e6, 1.0),
        (lambda y, unit: decay(y * unit), [1e-9, 1e5, 1e3], [1e-9, 1e5, 1e3]),  # farad and ohm
    ],
)
def test_units_of_residual_and_parameters_change_nothing(residual, unit, units):
    plain = solve(decay, START)
    scaled = solve(residual, START / jnp.asarray(units), jnp.asarray(unit))
    assert int(scaled.stats["num_steps"]) == int(plain.stats["num_steps"])
    np.testing.assert_allclose(scaled.value * jnp.asarray(units), plain.value, rtol=1e-9)
    assert np.abs(plain.value - START).max() > 0.5


def test_a_step_into_nan_is_rejected_and_the_fit_goes_on():
    """The Newton step leaves the domain of the square root."""

    def residual(y):
        return jnp.sqrt(y) * jnp.array([1.0, 1.0]) - jnp.array([0.01, 0.02])

    start = jnp.array([1.0])
    newton = start - jnp.linalg.lstsq(jax.jacfwd(residual)(start), residual(start))[0]
    assert bool(jnp.isnan(residual(newton)).any())  # else this tests nothing
    solution = solve(residual, start)
    assert solution.result == optx.RESULTS.successful
    np.testing.assert_allclose(solution.value, [0.015**2], rtol=1e-5)
    assert int(solution.stats["accepted_steps"]) < int(solution.stats["num_steps"])


def test_a_fit_that_cannot_succeed_has_a_verdict():
    for residual, start in (
        (lambda y: jnp.log(y) * jnp.ones(4), -1.0),  # no number
        (lambda y: jnp.sqrt(y) + jnp.arange(1.0, 5.0), 0.0),  # an infinite slope
    ):
        solution = solve(residual, jnp.array([start]))
        assert solution.result == optx.RESULTS.nonlinear_divergence
        assert int(solution.stats["num_steps"]) < 5

    def stuck(y):  # NaN away from one point, so that every trial step is rejected
        return jnp.where(jnp.all(y == START), decay(y), jnp.nan)

    solution = solve(stuck, START)
    assert solution.result != optx.RESULTS.successful
    np.testing.assert_array_equal(solution.value, START)
    assert solve(decay, START, max_steps=3).result == optx.RESULTS.nonlinear_max_steps_reached


def test_a_parameter_without_effect_stays_where_it_was():
    solution = solve(lambda y: decay(y[:3]), jnp.append(START, 4.0))
    assert solution.result == optx.RESULTS.successful
    assert float(solution.value[3]) == 4.0
    np.testing.assert_allclose(solution.value[:3], solve(decay, START).value, atol=AGREE)


@pytest.fixture(scope="module")
def lanes():
    generator = np.random.default_rng(11)
    amplitude, rate = generator.uniform(1, 5, 6), generator.uniform(0.5, 3, 6)
    clean = amplitude[:, None] * np.exp(-rate[:, None] * TIME) + 0.5
    data = jnp.asarray(clean + 0.05 * generator.normal(size=clean.shape))
    return jax.jit(jax.vmap(lambda d: solve(decay, START, d).value)), data


def test_lanes_do_not_see_each_other(lanes):
    run, data = lanes
    values = run(data)
    poisoned = run(data.at[2, 5].set(jnp.nan))
    others = np.array([0, 1, 3, 4, 5])
    np.testing.assert_array_equal(poisoned[others], values[others])
    np.testing.assert_array_equal(poisoned[2], START)  # left where it was, not sent anywhere
    order = np.array([4, 2, 0, 5, 1, 3])
    np.testing.assert_array_equal(run(data[order]), values[order])


def by_optimistix(*problem):
    return optx.least_squares(*problem, max_steps=100, throw=False)


def by_etid(*problem):
    return least_squares(*problem, max_steps=100)


@pytest.mark.parametrize("found", [by_optimistix, by_etid])
def test_the_solution_differentiates_with_respect_to_the_data(found):
    """By the implicit function theorem; the parameters react to each sample as differences say."""

    @jax.jit
    def rate(data):
        solver = LevenbergMarquardt(rtol=1e-8, ftol=0.0)
        return found(decay, solver, START, data).value[1]

    gradient = jax.jit(jax.grad(rate))(jnp.asarray(DATA))
    direction = np.random.default_rng(3).normal(size=TIME.size)
    step = 1e-4  # differences: step² of the third derivative; the fits' own 1e-8 over the step
    numeric = (rate(DATA + step * direction) - rate(DATA - step * direction)) / (2 * step)
    np.testing.assert_allclose(gradient @ direction, numeric, rtol=1e-3)
