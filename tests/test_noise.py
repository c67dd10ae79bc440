import jax
import numpy as np
import pytest
import scipy.signal

from etid.signals.noise import noise_std, shows_few
from etid.simulation import scenes


@pytest.mark.parametrize("snr_db", [40.0, 60.0])
def test_noise_of_a_pulse_record_is_found(snr_db):
    scene = scenes.paper_dry(snr_db=snr_db, bits=None)
    clean = scenes.paper_dry(snr_db=None, bits=None).simulate(seed=0)
    for path, recording in scene.simulate(seed=0).items():
        true = np.std(recording.v_out - clean[path].v_out)
        found = float(noise_std(recording.v_out))
        # The median of 10 000 correlated differences scatters by 2 %; the edges add a little.
        assert abs(found / true - 1) < 0.08


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


def test_noise_without_steps_is_not_lifted():
    v = np.random.default_rng(7).normal(size=500)
    assert float(noise_std(v, 0.1)) == float(noise_std(v))


def test_converter_steps_are_a_floor():
    assert float(noise_std(np.zeros(100), 0.012)) == pytest.approx(0.012 / np.sqrt(12))


def test_a_smooth_curve_has_no_noise():
    assert float(noise_std(np.sin(np.arange(500) / 50.0))) < 1e-8


def test_infinite_samples_are_one_value_of_a_converter():
    """Warnings are errors: the difference of two infinite samples would be one."""
    assert shows_few(np.full(4096, np.inf))
    assert not shows_few(np.append(np.arange(4094.0), [np.inf, np.inf]))
