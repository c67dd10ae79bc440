"""Bands of the gain: their closed forms, for pulses whose gain, noise and tail are known."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.display import gain_bands
from etid.display import projection as projection_of
from etid.display.gain_bands import LAST_BAND, RELATIVE, WIDEST, Bands, unloaded_bands
from etid.signals.harmonics import ALIASED
from etid.signals.noise import RIPPLE

SIZE, RATE, SIGMA = 2048, 120e3, 12.0
DECAY = 1.0 / SIZE  # [1/sample] of the tail: a third of it is left after a period
ROUNDING = 1e-9  # sums of 2000 numbers
DESCRIBED = ("frequency", "weight", "spread")
UNLIMITED = np.array([-np.inf, np.inf])


def window():
    """One period in the steady state: pulse, tail, and no DC."""
    t = np.arange(SIZE)
    v = 3.0 * np.exp(-DECAY * t)
    pulse = np.exp(-0.5 * ((t - 40) / 1.2) ** 2)  # has power at all harmonics
    return v - v.sum() * pulse / pulse.sum()


def unloaded(noise):
    rng = np.random.default_rng(0)
    v_th = np.tile(window(), 3) + noise * rng.standard_normal(3 * SIZE)
    return unloaded_bands(v_th, noise, RATE, float(SIZE))


@pytest.fixture(scope="module")
def exact():
    return unloaded(0.0)


def bands_of(of):
    """The bins of each band, counted from 1."""
    edges = gain_bands._edges(of.x.size)
    return [np.arange(*ends) for ends in itertools.pairwise(edges)]


def white(of, lanes):
    """Noise that is the same in all bands."""
    return np.ones((lanes, of.frequency.size))


measured = jax.jit(Bands.measure)
lacking_tail = jax.jit(Bands._lacking_tail)


@pytest.mark.parametrize("bins", [40, 100, 333, 1000])
def test_bands_follow_each_other_and_are_a_quarter_of_their_frequency(bins):
    edges = gain_bands._edges(bins)
    width = np.diff(edges)
    assert (edges[0], edges[-1], width[-1]) == (1, bins + 1, LAST_BAND)
    for first, wide in zip(edges[:-2], width[:-2], strict=False):
        assert wide == min(max(first // RELATIVE, 1), WIDEST)
    assert 0 < width[-2] <= min(max(edges[-3] // RELATIVE, 1), WIDEST)


def test_the_rate_of_a_tail_is_found_and_is_zero_where_nothing_decays():
    assert gain_bands._tail_rate(window() + 7.0) == pytest.approx(DECAY, rel=ROUNDING)
    assert gain_bands._tail_rate(-window()) == pytest.approx(DECAY, rel=ROUNDING)
    assert gain_bands._tail_rate(np.zeros(SIZE)) == 0.0
    growing = window()[::-1].copy()
    assert gain_bands._tail_rate(growing) == 0.0


def test_a_band_is_described_by_the_sums_over_its_bins():
    of, projection = unloaded(SIGMA)
    assert of.samples == SIZE
    bins = of.x.size
    assert bins == int(ALIASED * SIZE)
    variance = SIZE * SIGMA**2 / 3  # of the mean of three periods
    np.testing.assert_allclose(of.variance_x, variance)
    known = {name: np.asarray(getattr(of, name)) for name in ("x", *DESCRIBED)}
    drowned = []
    for i, k in enumerate(bands_of(of)):
        x = known["x"][k - 1]
        strength = (abs(x) ** 2).sum()
        centre = (abs(x) ** 2 * k).sum() / strength
        squares = (abs(x) ** 2 * (k - centre) ** 2).sum()
        signal = strength - k.size * variance
        drowned.append(signal <= 0.5 * strength)
        assert known["frequency"][i] == pytest.approx(centre * RATE / SIZE, rel=ROUNDING)
        spread = squares / strength * (2 * np.pi / SIZE) ** 2
        assert known["spread"][i] == pytest.approx(spread, rel=1e-6, abs=1e-18)
        # What neighbours share makes it smaller; blocks drop a part of the noise in X.
        low, high = (0.0, 0.0) if drowned[-1] else (1.6 * signal**2 / strength, 2.1 * strength)
        assert low <= known["weight"][i] <= high, i
    assert any(drowned)
    assert not all(drowned)
    assert not np.asarray(of.alias).any()  # each period is sampled at the same phase
    assert projection.floor == pytest.approx(SIZE * (RIPPLE * np.ptp(window())) ** 2, rel=0.1)
    whole = np.fft.rfft(window())[1 : bins + 1]
    np.testing.assert_allclose(of.x, whole, atol=6 * np.sqrt(variance))


def test_a_bent_and_delayed_gain_departs_from_its_value_at_the_centre(exact):
    """½ s² (G″ − 2jτ G′ − τ² G) is exact in the coefficients for a parabola."""
    of, _ = exact
    angle = 2 * np.pi * np.asarray(of.frequency) / RATE
    a, b, c, delay = 0.4 - 0.1j, -0.3 + 0.2j, 0.5 + 0.7j, 1.7
    gain = a + b * angle + c * angle**2
    bend = 2 * c - 2j * delay * (b + 2 * c * angle) - delay**2 * gain
    found = of.departure(jnp.asarray(gain), jnp.asarray(delay))
    expected = 0.5 * np.asarray(of.spread) * bend
    np.testing.assert_allclose(found[1:-1], expected[1:-1], rtol=1e-6, atol=1e-12)


def test_gain_and_noise_are_those_of_a_straight_line_in_each_band(exact):
    of, projection = exact
    rng, noise = np.random.default_rng(1), 3.0
    number = np.arange(SIZE // 2 + 1)
    gain = 0.5 - 1e-4 * number + 1e-4j * number
    v_out = np.fft.irfft(np.fft.rfft(window()) * gain, SIZE)[None, :].repeat(100, axis=0)
    seen = projection.band_sums(v_out, UNLIMITED)
    assert seen.variance == pytest.approx(projection.floor)
    assert not seen.clipped.any()
    found, weight = measured(of, seen, white(of, 100), np.zeros(100), np.zeros(100))
    centre = np.asarray(of.frequency) * SIZE / RATE
    # Blocks are exact to a thousandth of a standard error, numbers are in single precision.
    expected = 0.5 - 1e-4 * centre + 1e-4j * centre
    np.testing.assert_allclose(found[0], expected, atol=1e-4)
    np.testing.assert_allclose(weight[0], of.weight / projection.floor, rtol=1e-6)

    noisy = projection.band_sums(v_out + noise * rng.standard_normal(v_out.shape), UNLIMITED)
    freedom = sum(count for _, count in projection.runs) * (projection.within.shape[1] - 1)
    uncertain = 5 * np.sqrt(2 / freedom / 100)
    assert np.mean(noisy.variance) == pytest.approx(SIZE * noise**2, rel=uncertain)
    found, weight = measured(of, noisy, white(of, 100), np.zeros(100), np.zeros(100))
    # χ² of all gains: 100 lanes, two numbers for each band, and the noise is known to a tenth.
    squares = np.asarray(weight) * abs(np.asarray(found) - expected) ** 2
    count = squares.size
    assert squares.sum() == pytest.approx(2 * count, rel=5 * np.sqrt(1 / count) + 0.1)


def test_what_a_window_lacks_of_the_tail_is_added_to_the_gain(exact):
    """Amplitude 1 after 1 − lacking: the tail of the pulse before is smaller by this part."""
    of, projection = exact
    lacking = np.array([0.5, -0.8, 0.0])
    tail = 3.0 * np.exp(-DECAY * (SIZE + np.arange(SIZE)))
    offset = np.array([0.3, 0.0, -0.2])
    v_out = 0.5 * (window() - lacking[:, None] * tail) + offset[:, None]
    seen = projection.band_sums(v_out, UNLIMITED)
    found, weight = measured(of, seen, white(of, 3), lacking, offset)
    before, _ = measured(of, seen, white(of, 3), np.zeros(3), offset)
    error = abs(np.asarray(found) - 0.5).max(1)
    without = abs(np.asarray(before) - 0.5).max(1)
    # The mean of the last samples is not quite their middle, and numbers are in single precision.
    assert (error[:2] < 1e-2 * without[:2]).all(), error / without
    assert (without[:2] > 1e-3).all()
    np.testing.assert_array_equal(found[2], before[2])
    unsure = np.asarray(of.weight) * abs(0.2 * np.asarray(found - before)) ** 2 / 2
    expected = np.asarray(of.weight) / (np.asarray(seen.variance)[:, None] + unsure)
    np.testing.assert_allclose(weight, expected, rtol=1e-6)


def test_edges_are_what_stands_out_of_the_noise_of_the_mean_period():
    sigma = 25.0
    noise = sigma * np.random.default_rng(2).standard_normal(3 * SIZE)
    v_th = np.tile(window(), 3) + noise
    _, projection = unloaded_bands(v_th, sigma, RATE, float(SIZE))
    mean = v_th.reshape(3, SIZE).mean(0)
    found = {
        of: tuple(projection_of._partition(mean, of, projection.block)[0])
        for of in (sigma / np.sqrt(3), sigma * np.sqrt(3))
    }
    assert projection.pieces == found[sigma / np.sqrt(3)]
    assert projection.pieces != found[sigma * np.sqrt(3)]


def test_the_tail_of_a_load_has_its_own_rate_as_far_as_noise_lets_it_be_seen(exact):
    of, projection = exact
    t, lacking = np.arange(SIZE), np.full(4, 0.5)
    v_out = np.stack([np.exp(-1.01 * DECAY * t)] * 3 + [np.exp(-DECAY * t[::-1])])
    last, middle = round(gain_bands.LAST * SIZE), SIZE // 2
    early, late = v_out[:, middle : middle + last].mean(1), v_out[:, -last:].mean(1)
    span = DECAY * (SIZE - last - middle)
    # Noise by which the logarithm of the rate is as uncertain as loads make it.
    equal = (0.2 * span) ** 2 * SIZE * last / (early[0] ** -2 + late[0] ** -2)
    seen = projection.band_sums(v_out, UNLIMITED)
    for found, mean in zip(seen.means(), (v_out.mean(1), early, late), strict=True):
        np.testing.assert_allclose(found, mean, rtol=1e-6)
    variance = np.array([0.0, equal, 1e9 * equal, 0.0])
    sums = np.column_stack([seen.values[:, :-2], early, late])
    seen = seen._replace(values=sums, variance=variance)
    found = np.asarray(lacking_tail(of, seen, lacking, np.zeros(4)))
    left = late / (1 - 0.5 * np.exp(-1.0))
    shape, by_rate = np.asarray(of.tail)
    for i, part in enumerate((0.01, 0.005, 0.0, 0.0)):
        expected = 0.5 * left[i] * (shape + part * by_rate)
        np.testing.assert_allclose(found[i], expected, atol=1e-6 * abs(expected).max())
    # The second row of the tail is the derivative with respect to the logarithm of the rate.
    later = np.arange(SIZE) + last / 2
    x = np.asarray(of.x)

    def projected(rate):
        e = np.fft.rfft(np.exp(-rate * later))[1 : x.size + 1] * x.conj()
        strengths = [(abs(x[k - 1]) ** 2).sum() for k in bands_of(of)]
        return np.array([e[k - 1].sum() for k in bands_of(of)]) / strengths

    np.testing.assert_allclose(shape, projected(DECAY), atol=1e-6 * abs(shape).max())
    step = 1e-4
    slope = (projected(DECAY * (1 + step)) - projected(DECAY * (1 - step))) / (2 * step)
    np.testing.assert_allclose(by_rate, slope, atol=1e-6 * abs(slope).max())
    assert of.tail_left == pytest.approx(np.exp(-1.0), rel=1e-6)


def test_aliases_of_periods_at_three_phases_are_those_of_a_gaussian_pulse():
    period, width = SIZE + 1 / 3, 0.9
    t = np.arange(9 * SIZE) % period - 40
    of, _ = unloaded_bands(np.exp(-0.5 * (t / width) ** 2), 1e-6, RATE, period)
    w = 2 * np.pi * np.arange(1, of.x.size + 1) / SIZE
    x, aliased = (np.exp(-0.5 * (width * at) ** 2 - 40j * at) for at in (w, w - 2 * np.pi))
    product, size = x.conj() * aliased, abs(x) ** 2
    expected = np.array([product[k - 1].sum() / size[k - 1].sum() for k in bands_of(of)])
    # A window is a third of a sample shorter than a period.
    np.testing.assert_allclose(of.alias, expected, atol=1e-2 * abs(expected).max())
