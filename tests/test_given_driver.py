"""What calibrations tell of a driver: its covariance is that of the noise, by sums written down."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import etid
from etid.likelihood.source_prior import DELAY_WIDTH, SourcePrior
from etid.signals.harmonics import filled, harmonics
from etid.signals.noise import noise
from etid.signals.transfer import delayed
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

R_LOAD = 98.8e3
KNOWN = (Trial("c", ResistorLoad(R_LOAD)),)


@pytest.fixture(scope="module")
def driver():
    return etid.identify_driver(Scene((), KNOWN).simulate(seed=3)["c"])


def information(driver):
    """Fisher's, of Z_th and the delay, by the true voltage and the noise alone."""
    record = Scene((), KNOWN, snr_db=None, bits=None).simulate(seed=3)["c"]
    noisy = Scene((), KNOWN).simulate(seed=3)["c"]
    rate, size = record.sample_rate, record.v_th.size
    both = harmonics(np.stack([record.v_th, record.v_out]), 3, size)
    f, x, *_, selected = map(np.asarray, filled(both, 0 * abs(both), rate, 3, size))
    sigma_th, sigma_out = (float(noise(v, np.asarray(0.0))) for v in (noisy.v_th, noisy.v_out))
    parameters, unflatten = ravel_pytree(driver.source)
    at = jnp.append(parameters, driver.calibration.delay_samples[0])

    def gain(p):
        z = jnp.asarray(unflatten(p[:-1]).response(f))
        return delayed(R_LOAD / (R_LOAD + z), jnp.asarray(f), p[-1], jnp.asarray(rate))

    slopes = np.asarray(jax.jit(jax.jacfwd(gain))(at)).T
    variance = (sigma_out**2 + np.abs(np.asarray(gain(at))) ** 2 * sigma_th**2) / size
    weight = np.where(selected, 2 * np.abs(x) ** 2 / variance, 0.0)
    told = np.real((slopes * weight) @ slopes.conj().T)
    prior = SourcePrior.of(driver.source, jnp.asarray(rate), jnp.asarray(R_LOAD))
    weak = jax.jit(jax.jacfwd(prior))(parameters)
    told[:-1, :-1] += np.asarray(weak.T @ weak)
    told[-1, -1] += 1 / DELAY_WIDTH**2
    return told


def test_the_covariance_of_a_driver_is_the_inverse_of_its_information(driver):
    """Noise is estimated to 5 %, and what exceeds it widens the errors: no more than a quarter."""
    told = information(driver)
    scale = np.sqrt(np.diagonal(told))
    expected = np.linalg.inv(told / np.outer(scale, scale)) / np.outer(scale, scale)
    ratio = np.diagonal(driver.cov) / np.diagonal(expected)[:-1]
    assert (ratio > 0.8).all(), ratio
    assert (ratio < 1.5).all(), ratio
