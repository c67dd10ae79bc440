"""Harmonics summed over bands: the same gain from fewer numbers, and no band from noise alone."""

import jax.numpy as jnp
import numpy as np
import pytest

from etid.signals.harmonics import Spectrum
from etid.signals.knots import banded

COUNT, RATE = 1700, 60.0
NOISE = 1e-4  # [V] of a coefficient


def gain(frequency):
    """Of a resonance as sharp as that of a transformer, with a delay of a sample of 5 µs."""
    x = 1j * frequency / 20e3
    return (1 + 0.2 * x) / (1 + 0.4 * x + x * x) * np.exp(-2j * np.pi * frequency * 5e-6)


@pytest.fixture(scope="module")
def spectrum():
    """Two recordings; the second has no signal above 60 kHz."""
    rng = np.random.default_rng(0)
    frequency = RATE * np.arange(1.0, COUNT + 1)
    x = np.exp(2j * np.pi * rng.random((2, COUNT))) / np.arange(1.0, COUNT + 1)
    x[1, frequency > 60e3] = 0.0
    noise = NOISE * np.sqrt(0.5) * (rng.standard_normal((2, 2, 2, COUNT)) @ np.eye(COUNT))
    noise_x, noise_y = noise[0] + 1j * noise[1]
    every = np.broadcast_to(frequency, x.shape)
    variance = np.full(x.shape, NOISE**2)
    selected = every > 100.0
    parts = (every, x + noise_x, gain(frequency) * x + noise_y, variance, variance, selected)
    return Spectrum(*map(jnp.asarray, parts))


def test_bands_have_the_gain_of_their_harmonics(spectrum):
    bands = banded(spectrum)
    assert 5 * bands.x.shape[1] < COUNT
    f, g = np.asarray(bands.frequency), gain(np.asarray(bands.frequency))
    assert (np.diff(f, axis=1) > 0).all()
    error = np.abs(bands.y - g * bands.x) ** 2 / (
        bands.variance_y + np.abs(g) ** 2 * bands.variance_x
    )
    used = np.asarray(bands.selected)
    # The mean over a hundred bands is known to a tenth; curvature within a band adds a little.
    assert 0.7 < error[used].mean() < 1.5
    assert not used[1, f[1] > 62e3].any()
    assert used[0].mean() > 0.9
