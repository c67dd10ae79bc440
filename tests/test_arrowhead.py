"""An arrowhead is the matrix it stands for."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from etid.solvers.arrowhead import Arrowhead, ArrowheadEquations, join, split
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations, normal_equations

PROBLEMS, OWN, COMMON = 5, 2, 3
AGREE = 1e-10  # of numbers of order 1 after a solution with condition numbers below 1e4


RNG = np.random.default_rng(11)
DESIGNS = jnp.asarray(RNG.normal(size=(PROBLEMS, 7, OWN + COMMON)))
TARGETS = jnp.asarray(0.1 * RNG.normal(size=(PROBLEMS, 7)))


def terms(own, common, number):
    """Those of one problem: nonlinear in both, 7 of them."""
    design = DESIGNS[number]
    both = jnp.concatenate([own, common])
    return jnp.sin(design @ both) + design[:, 0] * own[1] - TARGETS[number]


def everything(y, _):
    common, own = split(y, PROBLEMS, OWN)
    return jax.vmap(lambda own, i: terms(own, common, i))(own, jnp.arange(PROBLEMS)).ravel()


def structured(_, y, __):
    common, own = split(y, PROBLEMS, OWN)

    def one(own, seed):
        return normal_equations(
            lambda q, _: terms(q[COMMON:], q[:COMMON], seed), jnp.concatenate([common, own])
        )

    found = jax.vmap(one)(own, jnp.arange(PROBLEMS))
    matrix = found.matrix
    return ArrowheadEquations(
        found.objective.sum(),
        join(found.gradient[:, :COMMON].sum(0), found.gradient[:, COMMON:]),
        Arrowhead(
            matrix[:, :COMMON, :COMMON].sum(0),
            matrix[:, COMMON:, :COMMON],
            matrix[:, COMMON:, COMMON:],
        ),
    )


# One program each: line by line, every operation of these would be compiled by itself.
dense_of = jax.jit(lambda y: normal_equations(everything, y))
arrow_of = jax.jit(lambda y: structured(None, y, None))


@pytest.fixture(scope="module")
def start():
    return jnp.asarray(0.3 * np.random.default_rng(4).normal(size=COMMON + PROBLEMS * OWN))


def test_equations_are_those_of_one_matrix(start):
    dense, arrow = dense_of(start), arrow_of(start)
    by = jnp.arange(1.0, start.size + 1)
    for expected, found in ((dense, arrow), (dense.scaled(by), arrow.scaled(by))):
        assert isinstance(found, ArrowheadEquations)
        assert isinstance(expected, NormalEquations)
        np.testing.assert_allclose(found.matrix.as_matrix(), expected.matrix, atol=AGREE)
        np.testing.assert_allclose(found.gradient, expected.gradient, atol=AGREE)
        np.testing.assert_allclose(found.diagonal(), expected.diagonal(), atol=AGREE)
        np.testing.assert_allclose(found.matrix.mv(by), expected.matrix @ by, atol=1e-8)


@pytest.mark.parametrize("damping", [1e-3, 1.0, 1e3])
def test_elimination_solves_the_damped_step(start, damping):
    dense, arrow = dense_of(start), arrow_of(start)
    expected = np.linalg.solve(
        dense.matrix + damping * np.eye(start.size), np.asarray(dense.gradient)
    )
    found = arrow.matrix.solve(arrow.gradient, jnp.asarray(damping))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=AGREE)


def test_a_problem_that_says_nothing_stays_where_it_is(start):
    arrow = arrow_of(start)
    silent = jnp.arange(PROBLEMS) == 2
    own = jnp.where(silent[:, None, None], 0.0, arrow.matrix.own)
    coupling = jnp.where(silent[:, None, None], 0.0, arrow.matrix.coupling)
    common, below = arrow.matrix.split(arrow.gradient)
    step = Arrowhead(arrow.matrix.common, coupling, own).solve(
        join(common, jnp.where(silent[:, None], 0.0, below)), jnp.asarray(1e-3)
    )
    np.testing.assert_array_equal(split(step, PROBLEMS, OWN)[1][2], 0.0)
    assert jnp.isfinite(step).all()


def test_the_minimum_is_that_of_the_whole_problem(start):
    whole = LevenbergMarquardt(rtol=1e-9)
    parts = LevenbergMarquardt(rtol=1e-9, equations=structured)
    expected = optx.least_squares(everything, whole, start, throw=False)
    found = least_squares(everything, parts, start, None, max_steps=256)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, expected.value, atol=1e-7)
