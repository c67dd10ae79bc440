"""Inverses of matrices whose parameters have very different sizes."""

import jax.numpy as jnp
import numpy as np
import pytest

from etid.solvers.matrices import (
    inverse,
    inverse_of_few,
    inverse_root,
    is_definite,
    root,
    root_of_few,
)

# Rounding of an inverse: machine epsilon times the condition of the scaled matrix, below 1e3 here.
EXACT = 1e-12


def covariance(seed=0, size=4):
    """A covariance whose parameters have sizes from 1e-9 to 1e6, as farads beside ohms."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(size, 3 * size))
    scale = np.logspace(-9, 6, size)
    return factor @ factor.T * scale[:, None] * scale, scale


@pytest.mark.parametrize("function", [inverse, inverse_of_few, lambda m: square(inverse_root(m))])
def test_an_inverse_is_exact_whatever_the_units_are(function):
    matrix, scale = covariance()
    product = np.asarray(function(jnp.asarray(matrix))) @ matrix
    np.testing.assert_allclose(product * scale[:, None] / scale, np.eye(4), atol=EXACT)


@pytest.mark.parametrize("function", [root, root_of_few])
def test_a_root_gives_the_matrix(function):
    matrix, scale = covariance()
    factor = np.asarray(function(jnp.asarray(matrix)))
    np.testing.assert_array_equal(factor, np.tril(factor))
    found = square(factor)
    np.testing.assert_allclose(found / scale[:, None] / scale, matrix / scale[:, None] / scale,
                               rtol=1e-10)  # fmt: skip  # the ridge of 1e-12 times the condition


def square(factor):
    return factor @ factor.T


def test_a_direction_without_information_has_an_enormous_variance_or_none():
    matrix = jnp.diag(jnp.array([4.0, 0.0]))
    np.testing.assert_allclose(np.diagonal(inverse(matrix)), [0.25, 1e12])
    np.testing.assert_allclose(np.diagonal(inverse(matrix, drop=True)), [0.25, 0.0])


def test_a_combination_without_variance_is_found_whatever_the_units_are():
    matrix, scale = covariance()
    assert is_definite(matrix)
    same = matrix.copy()
    same[0], same[:, 0] = matrix[1] * scale[0] / scale[1], matrix[:, 1] * scale[0] / scale[1]
    same[0, 0] = matrix[1, 1] * (scale[0] / scale[1]) ** 2
    assert not is_definite(same)
    assert not is_definite(np.diag([1.0, 0.0]))
    assert not is_definite(np.diag([1.0, np.nan]))
