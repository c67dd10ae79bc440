"""Noise by frequency, on-line: hum of the mains, and noise that is not white."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats

from etid.display import Tracker
from etid.display.noise import cleared, directions
from etid.results.verdicts import verdict_names
from tests.display.test_online import (
    NOISE,
    PERIOD,
    RATE,
    TEN,
    TRUTH,
    calibrated,
    scene,
    ten,
    tiled,
    with_noise,
)
from tests.skins import off

PULSES = 24


def hum(frequency, volts, seed, pulses=PULSES):
    """Hum at ten electrodes, of half to all of `volts` and any phase (pulse, electrode, sample)."""
    rng = np.random.default_rng(seed)
    size = volts * rng.uniform(0.5, 1.0, (TEN, 1))
    phase = rng.uniform(0, 2 * np.pi, (TEN, 1))
    begins = np.array([round(at * PERIOD) for at in range(pulses)])
    time = (begins[:, None, None] + np.arange(3333)) / RATE
    return size * np.sin(2 * np.pi * frequency * time + phase)


def tracked(tracker, pulses):
    """Verdicts after each pulse (pulse, electrode), and the last state."""
    state, found = tracker.start(), []
    for v_out in pulses:
        state = tracker.update(state, v_out)
        found.append(verdict_names(state.electrodes.result))
        assert not bool(state.driver_changed)
    return np.array(found), state


@pytest.mark.parametrize("frequency", [49.95, 50.0, 59.99, 60.0])
def test_hum_ten_times_the_noise_costs_the_first_pulse_and_no_element(frequency):
    """From 20 mV on, every pulse was a misfit."""
    tracker, _, clean = ten()
    clean = np.concatenate([clean] * 2)[:PULSES]
    runs = [
        tracked(tracker, with_noise(clean, seed) + hum(frequency, 0.1, seed)) for seed in (1, 2)
    ]
    for found, state in runs:
        assert set(found[2:].ravel()) == {"successful"}
        assert (np.abs(off(tracker.read(state), tiled(TRUTH))) < 4).all()
    # The difference of two runs has no error but that of noise and hum.
    own = [np.asarray(state.electrodes.own)[:, :-1] for _, state in runs]
    cov = sum(np.linalg.inv(np.asarray(state.electrodes.information)) for _, state in runs)
    d = own[1] - own[0]
    squares = np.einsum("li,lij,lj->l", d, np.linalg.inv(cov), d)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 3 * TEN)
    assert low < squares.sum() < high


def test_hum_that_begins_under_way_is_known_after_two_pulses():
    tracker, _, clean = ten()
    pulses, begin = with_noise(np.concatenate([clean] * 2)[:PULSES], seed=3), 12
    pulses[begin:] += hum(50.0, 0.1, seed=3)[begin:]
    found, _ = tracked(tracker, pulses)
    assert set(found[:begin].ravel()) == {"successful"}
    assert set(found[begin + 2 :].ravel()) == {"successful"}


def test_without_hum_no_information_is_lost():
    """A line that may be there takes what it might explain; here it might explain nothing."""
    tracker, state, _ = ten()
    assert (np.asarray(state.noise.line) < 0.2 * NOISE * np.sqrt(2 / PERIOD)).all()
    assert tracker.model.bands.lines.shape[0] == 2  # 50 Hz; 60 Hz is locked to the pulses


def test_noise_of_the_unloaded_record_is_known_by_frequency():
    """An amplifier before a filter of 35 kHz: the quiet tells its top, the bins tell the band."""
    driver, _ = calibrated()
    record = scene(24, snr_db=None, bits=None).simulate(seed=0)["cal/0"]
    sos = scipy.signal.butter(2, 35e3, fs=RATE, output="sos")
    white = 10 * NOISE * np.random.default_rng(4).standard_normal((2, record.v_th.size + 999))
    noise = np.asarray(scipy.signal.sosfilt(sos, white))[:, 999:]
    record = record.replace(v_th=record.v_th + noise[0], v_out=record.v_out + noise[1])
    tracker = Tracker.of(driver, record, electrodes=TEN)
    bands = tracker.model.bands
    _, response = scipy.signal.sosfreqz(sos, np.asarray(bands.frequency), fs=RATE)
    level = np.mean(tracker.projection.band_sums(noise[1:, :3333], tracker.adc_range).variance)
    expected = 3333 * (10 * NOISE) ** 2 * np.abs(response) ** 2 / level
    assert expected.max() > 2 * expected.min()
    # Means of seven bands, each of 22 squares: a standard error of 8 %, and the level's 5. At the
    # end of the slope a mean of neighbours is not that of its middle.
    used = ~np.asarray(bands.hum) & (expected > 0.1)
    np.testing.assert_allclose(np.asarray(bands.noise)[used], expected[used], rtol=0.3)


def test_residuals_are_cleared_by_a_root_of_the_inverse_covariance():
    patterns = np.random.default_rng(0).standard_normal((4, 9)) * [[0.0], [1e-3], [1.0], [1e4]]
    lines = directions(jnp.asarray(patterns))
    root = np.asarray(cleared(jnp.eye(9), lines))
    covariance = np.eye(9) + patterns.T @ patterns
    # Rounding, of the largest number in the covariance.
    np.testing.assert_allclose(root.T @ covariance @ root, np.eye(9), atol=1e-15 * covariance.max())
