"""An arrowhead is the matrix it stands for."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from etid.arrowhead import Arrowhead, ArrowheadEquations, EliminationDescent, join, split
from etid.levenberg_marquardt import LevenbergMarquardt, NormalEquations, normal_equations

PROBLEMS, OWN, COMMON = 5, 2, 3
AGREE = 1e-10  # of numbers of order 1 after a solution with condition numbers below 1e4


def terms(own, common, seed):
    """Those of one problem: nonlinear in both, 7 of them."""
    key = jax.random.fold_in(jax.random.key(11), seed)
    design = jax.random.normal(key, (7, OWN + COMMON))
    target = 0.1 * jax.random.normal(jax.random.fold_in(key, 1), (7,))
    return jnp.sin(design @ jnp.concatenate([own, common])) + design[:, 0] * own[1] - target


def everything(y, _):
    common, own = split(y, PROBLEMS, OWN)
    return jnp.concatenate([terms(own[i], common, i) for i in range(PROBLEMS)])


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


@pytest.fixture
def start():
    return 0.3 * jax.random.normal(jax.random.key(4), (COMMON + PROBLEMS * OWN,))


def test_equations_are_those_of_one_matrix(start):
    dense, arrow = normal_equations(everything, start), structured(None, start, None)
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
    dense, arrow = normal_equations(everything, start), structured(None, start, None)
    expected = np.linalg.solve(
        dense.matrix + damping * np.eye(start.size), np.asarray(dense.gradient)
    )
    found = arrow.matrix.solve(arrow.gradient, jnp.asarray(damping))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=AGREE)


def test_a_problem_that_says_nothing_stays_where_it_is(start):
    arrow = structured(None, start, None)
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
    parts = LevenbergMarquardt(
        rtol=1e-9,
        descent=EliminationDescent(),
        equations=structured,
        empty=lambda y, _: jax.tree.map(jnp.zeros_like, structured(None, y, None)),
    )
    expected = optx.least_squares(everything, whole, start, throw=False)
    found = optx.least_squares(everything, parts, start, throw=False)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, expected.value, atol=1e-7)
