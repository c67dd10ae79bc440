"""Harmonics: exact for periodic records, whatever the number of samples in a period."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.signals.harmonics import filled, harmonics, signal_share, whole_periods
from etid.signals.pulse_train import find_pulses
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

RATE, PULSE = 200e3, 60.0
SLOW = 50e3


def spectrum(both, sigma, periods, samples):
    """Fields of a spectrum."""
    found = harmonics(both, periods, samples)
    power = sigma[:, None] ** 2 / samples + 0 * abs(found)
    return filled(found, power, RATE, periods, samples)


@pytest.mark.parametrize(
    ("samples", "rate", "pulse_rate", "expected"),
    [
        (10_000, RATE, PULSE, (3, 10_000)),
        (3333, RATE, PULSE, (1, 3333)),  # 0.9999 of a period: a third of a sample is missing
        (12_333, RATE, PULSE, (3, 10_000)),  # 3.7 periods
        (3332, RATE, PULSE, (0, 0)),
        (4, 5.0, 2.0, (1, 2)),  # 2.5 samples to a period: half a sample may be missing
        (5, 5.0, 2.0, (2, 5)),
        (6, 5.0, 2.0, (2, 5)),
    ],
)
def test_whole_periods(samples, rate, pulse_rate, expected):
    assert whole_periods(samples, rate, pulse_rate) == expected


def test_harmonics_are_those_of_the_signal_and_a_drift_is_not_in_them():
    periods, samples = 3, 10_000
    time = np.arange(samples) / RATE
    order, level, phase = np.array([1, 7, 300, 1600]), np.array([5.0, 2.0, 0.3, 0.01]), 0.4
    waves = level[:, None] * np.cos(2 * np.pi * PULSE * order[:, None] * time + phase)
    ramp = np.linspace(-1, 1, samples)
    found = harmonics(waves.sum(0) + 3.0 + 0.2 * ramp**2, periods, samples)
    expected = np.zeros(found.shape, complex)
    expected[order - 1] = level / 2 * np.exp(1j * phase)
    # The means of the periods fix a parabola; where a period ends between two samples they are off
    # by what the signal bends there.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("periods", [1, 3])
def test_the_variance_of_a_coefficient_is_that_of_its_noise(periods):
    samples, sigma = round(periods * RATE / PULSE), 0.3
    rng = np.random.default_rng(5)
    draws = np.stack(
        [harmonics(rng.normal(0, sigma, samples), periods, samples) for _ in range(40)]
    )
    # 40 · 1666 coefficients: their mean square is known to 1/sqrt(66 640), of which this is 4.
    np.testing.assert_allclose(np.mean(np.abs(draws) ** 2) * samples / sigma**2, 1, rtol=0.016)


def test_the_share_of_signal_is_one_above_the_noise_half_at_it_and_nearly_zero_below():
    rng = np.random.default_rng(1)
    variance = 2.0
    noise = rng.normal(0, 1.0, 3000) + 1j * rng.normal(0, 1.0, 3000)  # E|noise|² = 2
    amplitude = np.repeat([1e4, np.sqrt(variance), 0.0], 1000)
    share = np.asarray(signal_share(jnp.asarray(amplitude + noise), jnp.full(3000, variance)))
    # Away from the seams; a mean over 25 powers is known to 20 %.
    assert (share[:900] > 0.999).all()
    assert abs(share[1050:1950].mean() - 0.5) < 0.05
    assert share[2050:].mean() < 0.1


def test_harmonics_of_a_long_record_survive_a_clock_that_is_off():
    """By the nominal rate, 30 periods at 200 ppm would leave nothing of the 375th."""
    scene = Scene(
        (Trial("a", ResistorLoad(1e5)),), sample_rate=SLOW, samples=25_200, pulse_rate_ppm=200.0
    )
    record, near = scene.simulate(seed=4)["a"], slice(370, 380)
    exact = np.mean(np.abs(scene.waveform().v_th[near]) ** 2)

    def part_left(pulse_rate):
        periods, samples = whole_periods(record.v_th.size, SLOW, pulse_rate)
        found = np.asarray(harmonics(record.v_th, periods, samples))[near]
        return np.sqrt(np.mean(np.abs(found) ** 2) / exact)

    # Half a sample at most, 21 ppm: 0.23 periods of the 375th, of which sinc leaves 0.91.
    assert part_left(find_pulses(record.v_th, SLOW, PULSE).counted) > 0.9
    assert part_left(PULSE) < 0.3


@pytest.mark.parametrize(("periods", "samples"), [(1, 3333), (3, 10_000), (2, 6667)])
def test_numpy_and_jax_see_the_same_harmonics(periods, samples):
    generator = np.random.default_rng(8)
    both = np.cumsum(generator.normal(size=(2, samples)), axis=1), np.array([0.1, 0.2])
    host = spectrum(*both, periods, samples)
    compiled = jax.jit(spectrum, static_argnums=(2, 3))
    traced = compiled(*map(jnp.asarray, both), periods, samples)
    for one, other in zip(host, traced, strict=True):
        assert isinstance(one, np.ndarray)
        assert one.size % 64 == 0
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
    np.testing.assert_array_equal(host[-1][:100], True)
    assert not host[-1][(samples + 1) // (2 * periods) :].any()


@pytest.mark.parametrize(
    ("samples", "highest"),
    [
        (3334, 0.35),  # one period: what has aliased falls on the harmonics
        (10_000, 0.5),  # between them
        (20_000, 0.5),
    ],
)
def test_harmonics_that_aliases_reach_are_left_out(samples, highest):
    v = np.random.default_rng(2).normal(size=samples)
    of = spectrum(np.stack([v, v]), np.full(2, 1e-3), *whole_periods(samples, RATE, PULSE))
    frequency, selected = of[0], of[-1]
    used = frequency[np.asarray(selected)]
    assert used.max() < highest * RATE
    assert used.max() > highest * RATE - 2 * PULSE
    assert used.size == round(used.max() / PULSE)  # and none below is


def test_a_cubic_drift_is_not_in_the_harmonics():
    """Of six periods; a polynomial of the fourth degree is no drift, and stays."""
    periods, samples = 6, 20_000
    ramp = np.linspace(-1, 1, samples)
    found = harmonics(np.stack([ramp**3, ramp**4 - ramp**2]), periods, samples)
    assert np.abs(found[0]).max() < 1e-12
    assert np.abs(found[1]).max() > 1e-5
