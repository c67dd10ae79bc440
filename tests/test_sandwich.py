"""The sandwich covariance, against least squares by NumPy and the scatter of its minima."""

import jax.numpy as jnp
import numpy as np
import pytest

from etid.likelihood.sandwich import Linear

RNG = np.random.default_rng(0)
J = RNG.normal(size=(4, 60))
PRIORS = np.diag([0.0, 3.0, 0.0, 5.0])
NOISE = np.where(np.arange(60) < 20, 4.0, 1.0)  # variance beyond what the weights expect


def linear(noise=NOISE, priors=PRIORS):
    weighted = jnp.asarray(J), jnp.ones(60), jnp.asarray(noise)
    return Linear(*weighted, None if priors is None else jnp.asarray(priors))


@pytest.mark.parametrize("priors", [PRIORS, None])
def test_with_the_expected_noise_it_is_the_inverse_of_the_information(priors):
    of = linear(np.ones(60), priors)
    information = J @ J.T + (0.0 if priors is None else priors @ priors.T)
    np.testing.assert_allclose(of.covariance(), np.linalg.inv(information), rtol=1e-9)
    np.testing.assert_allclose(of.bread(), np.linalg.inv(information), rtol=1e-9)
    np.testing.assert_allclose(of.curvature().covariance(), of.covariance(), rtol=1e-9)


def test_with_other_noise_it_is_the_scatter_of_the_minima():
    """The truth is drawn from the priors, and each term has the noise that it really has."""
    of, draws = linear(), 20_000
    priors = PRIORS[np.diagonal(PRIORS) > 0]
    terms = np.sqrt(NOISE)[:, None] * RNG.normal(size=(60, draws))
    rows = np.concatenate([J.T, priors])
    right = np.concatenate([terms, RNG.normal(size=(len(priors), draws))])
    minima = np.linalg.lstsq(rows, right)[0]
    # The standard error of a variance from 20 000 draws is 1 %.
    np.testing.assert_allclose(np.diagonal(of.covariance()), minima.var(1), rtol=0.05)


def test_what_is_eliminated_leaves_the_covariance_of_the_others():
    whole = linear().curvature()
    part = whole.eliminate(2)
    np.testing.assert_allclose(part.covariance(), whole.covariance()[:2, :2], rtol=1e-9)
