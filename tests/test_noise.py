import jax
import numpy as np
import pytest
import scipy.signal

from etid.signals.harmonics import WINDOW
from etid.signals.noise import noise
from etid.signals.quick_looks import shows_few
from etid.signals.rounding import _around
from etid.signals.white_noise import noise_std


def test_white_noise_on_a_pulse_is_unbiased():
    rng = np.random.default_rng(5)
    sigma, samples, trials = 0.03, 3000, 60
    b, a = np.asarray(scipy.signal.butter(4, 0.4))
    pulse = np.zeros(samples)
    pulse[1000:1130] = 50.0
    clean = scipy.signal.lfilter(b, a, pulse)
    estimate = jax.jit(noise_std)
    records = clean + sigma * rng.normal(size=(trials, samples))
    ratio = np.array([float(estimate(v)) for v in records]) / sigma
    scatter = ratio.std(ddof=1) / np.sqrt(trials)
    # Some 30 samples of each of two edges are no noise. Each moves the median by half a rank, and
    # the density of |x| there is 0.64 / 0.67 of the median: 1.2 times their share.
    edges = 1.2 * 2 * 30 / samples
    assert -3 * scatter < ratio.mean() - 1 < edges + 3 * scatter
    assert scatter < 0.01  # else the line above says nothing


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_noise_has_the_unit_of_the_record(unit):
    v = np.random.default_rng(6).normal(size=500)
    np.testing.assert_allclose(float(noise_std(unit * v)), unit * float(noise_std(v)), rtol=1e-12)


def test_converter_steps_are_a_floor():
    assert float(noise(np.zeros(100), np.asarray(0.012))) == pytest.approx(0.012 / np.sqrt(12))


def test_infinite_samples_are_one_value_of_a_converter():
    """Warnings are errors: the difference of two infinite samples would be one."""
    assert shows_few(np.full(4096, np.inf))
    assert not shows_few(np.append(np.arange(4094.0), [np.inf, np.inf]))


@pytest.mark.parametrize("size", [WINDOW // 2, 5 * WINDOW])
def test_sums_around_a_harmonic_are_those_of_its_neighbours(size):
    values = np.random.default_rng(3).normal(size=(2, size))
    near = abs(np.subtract.outer(np.arange(size), np.arange(size))) <= WINDOW // 2
    np.testing.assert_allclose(_around(values), values @ near, atol=1e-12 * size)
