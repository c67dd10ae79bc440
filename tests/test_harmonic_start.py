"""Steiglitz-McBride on harmonics, the start of a skin: near the truth, whatever noise and delay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.circuits.circuit import SkinRC
from etid.estimators.harmonic_start import start_of_skin
from etid.estimators.starts import START_STEPS
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import delayed
from tests.test_driver import SOURCE

SKINS = {
    "dry": SkinRC(*map(jnp.asarray, (33.4e3, 186e3, 0.12e-9))),
    "damp": SkinRC(*map(jnp.asarray, (6.1e3, 17.4e3, 0.66e-9))),
}
SETTLED = 20  # iterations
SUMS = 1e-2  # straight lines between the knots; one step of a fit corrects a hundredth
FREQUENCY = 60.0 * jnp.arange(1.0, 1667.0)
Z_TH = jnp.asarray(SOURCE.response(FREQUENCY))
RATE = jnp.asarray(200e3)
start = jax.jit(lambda of, steps: start_of_skin(of, Z_TH, RATE, steps), static_argnums=1)


def harmonics(z, sigma=0.0, delay=0.0, key=None):
    """A pulse of 4 % duty whose spectrum falls as 1/f, behind `SOURCE`, with noise on both."""
    k = jnp.arange(1.0, FREQUENCY.size + 1)
    x = jax.lax.complex(50 * jnp.sin(0.04 * jnp.pi * k) / (jnp.pi * k), 0.01 / k)
    y = delayed(x * z / (z + Z_TH), FREQUENCY, jnp.asarray(delay), RATE)
    variance = jnp.full(k.shape, sigma**2)
    if key is not None:
        parts = sigma / np.sqrt(2) * jax.random.normal(key, (4, k.size))
        x = x + jax.lax.complex(parts[0], parts[1])
        y = y + jax.lax.complex(parts[2], parts[3])
    return Spectrum(FREQUENCY, x, y, variance, variance, jnp.full(k.shape, True))


def errors(found, name):
    return np.log(np.asarray(found.values()) / np.asarray(SKINS[name].values()))


@pytest.mark.parametrize("name", SKINS)
@pytest.mark.parametrize("delay", [0.0, 0.08, -0.3])
def test_exact_harmonics_give_the_skin_and_the_delay(name, delay):
    of = harmonics(SKINS[name].response(FREQUENCY), delay=delay)
    skin, found = start(of, SETTLED)
    assert np.abs(errors(skin, name)).max() < SUMS
    assert float(found) == pytest.approx(delay, abs=SUMS)


@pytest.mark.parametrize("name", SKINS)
def test_noise_leaves_no_bias(name):
    """Errors of 64 draws; without the compensation they are all one way, by tens of per cent."""
    keys = jax.random.split(jax.random.key(5), 64)
    z = SKINS[name].response(FREQUENCY)
    # A hundredth of a volt in each coefficient: 40 dB and three periods have half of that.
    draws = jax.jit(
        jax.vmap(lambda key: start_of_skin(harmonics(z, 2e-3, 0.0, key), Z_TH, RATE, START_STEPS))
    )
    error = errors(draws(keys)[0], name)
    mean, scatter = error.mean(0), error.std(0, ddof=1)
    # Of second order in the noise some is left, as of every non-linear estimate.
    assert (np.abs(mean) < 5 * scatter / np.sqrt(len(keys)) + scatter**2 + SUMS).all()
