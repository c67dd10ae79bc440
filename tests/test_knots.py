"""Knots: sums of products with smooth functions, from a few values of these functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.signals.knots import knots


@pytest.mark.parametrize("harmonics", [1, 2, 31, 1728])
def test_products_with_straight_lines_are_summed_exactly(harmonics):
    """Also for a line that bends at a knot: the sum of each knot is what its hat function sees."""
    values = np.random.default_rng(0).normal(size=(2, harmonics))
    of, number = knots(harmonics), np.arange(1.0, harmonics + 1)
    bent = 2 + 3 * number + np.maximum(number - number[of.index[of.index.size // 2]], 0)
    at = np.asarray(of.at(jnp.asarray(bent)))
    between, summed = jax.jit(lambda at, values: (of.between(at), of.summed(values)))(at, values)
    np.testing.assert_array_equal(at, bent[of.index])
    np.testing.assert_allclose(between, bent)
    np.testing.assert_allclose(np.asarray(summed) @ at, values @ bent)


def test_a_relaxation_is_known_from_a_tenth_of_its_harmonics():
    """The error is (f/16)² g″ / 8 at most, and a relaxation has f² |g″| < 2 |g|."""
    of, number = knots(1728), np.arange(1.0, 1729)
    relaxation = 1 / (1 + 1j * number / 100)
    found = np.asarray(jax.jit(lambda g: of.between(of.at(g)))(relaxation))
    assert of.index.size < number.size / 10
    assert np.abs(found / relaxation - 1).max() < 2 / 16**2 / 8
