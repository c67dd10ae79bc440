"""Bands of the gain: their closed forms, for pulses whose gain, noise and tail are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from etid.online import gain_bands
from etid.online.gain_bands import RELATIVE, WIDEST, Bands, unloaded_bands
from etid.signals.harmonics import ALIASED
from etid.signals.noise import RIPPLE

SIZE, RATE, SIGMA = 2048, 120e3, 6.0
DECAY = 1.0 / SIZE  # [1/sample] of the tail: a third of it is left after a period
ROUNDING = 1e-9  # sums of 2000 numbers
DESCRIBED = ("strength", "frequency", "signal", "weight", "width", "spread")


def window():
    """One period in the steady state: pulse, tail, and no DC."""
    t = np.arange(SIZE)
    v = 3.0 * np.exp(-DECAY * t)
    pulse = np.exp(-0.5 * ((t - 40) / 1.2) ** 2)  # has power at all harmonics
    return v - v.sum() * pulse / pulse.sum()


@pytest.fixture(scope="module")
def of():
    noise = SIGMA * np.random.default_rng(0).standard_normal(3 * SIZE)
    return unloaded_bands(np.tile(window(), 3) + noise, SIGMA, RATE, float(SIZE))


@pytest.fixture(scope="module")
def exact():
    return unloaded_bands(np.tile(window(), 3), 0.0, RATE, float(SIZE))


def bands_of(of):
    """The bins of each band, counted from 1."""
    return [
        np.arange(first + i * width, first + (i + 1) * width)
        for first, width, count in of.groups
        for i in range(count)
    ]


measured = jax.jit(Bands.measure)
lacking_tail = jax.jit(Bands._lacking_tail)


@pytest.mark.parametrize("bins", [20, 31, 32, 100, 333, 1000])
def test_bands_follow_each_other_and_are_a_sixteenth_of_their_frequency(bins):
    groups = gain_bands._groups(bins)
    following = 1
    for i, (first, width, count) in enumerate(groups):
        assert (first, width) == (following, 2**i)
        assert count > 0
        assert width == 1 or width * RELATIVE <= first
        following = first + width * count
        if i + 1 < len(groups):  # the next width is allowed here, and not before
            assert 0 <= following - 2 * RELATIVE * width < width
    assert 0 <= following - 1 - bins < groups[-1][1]
    assert max(width for _, width, _ in groups) <= WIDEST
    assert len(groups) == 1 + sum(bins >= 2 * RELATIVE * 2**i for i in range(4))


def test_the_transform_has_the_smallest_largest_factor_within_a_thousandth():
    cheap = {3333: 3332, 2003: 2002, 1000: 1000, 2050: 2048, 2051: 2050, 4100: 4096, 49: 49}
    assert {size: gain_bands._cheap_size(size) for size in cheap} == cheap


def test_slopes_are_those_of_a_parabola_through_three_points():
    x = np.array([1.0, 1.5, 2.7, 3.0, 5.0])
    a, b, c = 0.3, -2.0, 1.7
    y = a + b * x + c * x**2
    near = np.stack([y[:-2], y[1:-1], y[2:]])
    first, second = gain_bands._slopes(x)
    np.testing.assert_allclose((first[:, 1:-1] * near).sum(0), b + 2 * c * x[1:-1], rtol=1e-12)
    np.testing.assert_allclose((second[:, 1:-1] * near).sum(0), 2 * c, rtol=1e-12)
    assert not first[:, [0, -1]].any()
    assert not second[:, [0, -1]].any()


def test_the_rate_of_a_tail_is_found_and_is_zero_where_nothing_decays():
    assert gain_bands._tail_rate(window() + 7.0) == pytest.approx(DECAY, rel=ROUNDING)
    assert gain_bands._tail_rate(-window()) == pytest.approx(DECAY, rel=ROUNDING)
    assert gain_bands._tail_rate(np.zeros(SIZE)) == 0.0
    growing = window()[::-1].copy()
    assert gain_bands._tail_rate(growing) == 0.0


def test_a_band_is_described_by_the_sums_over_its_bins(of):
    assert of.size == of.samples == SIZE
    bands = bands_of(of)
    bins = bands[-1][-1]
    assert of.x.shape == (bins,)
    assert bins - WIDEST < int(ALIASED * SIZE) <= bins
    variance = SIZE * SIGMA**2 / 3  # of the mean of three periods
    assert of.variance_x == pytest.approx(variance)
    known = {name: np.asarray(getattr(of, name)) for name in ("x", "offset", *DESCRIBED)}
    alone = 0
    for i, k in enumerate(bands):
        x = known["x"][k - 1]
        strength = (abs(x) ** 2).sum()
        centre = (abs(x) ** 2 * k).sum() / strength
        squares = (abs(x) ** 2 * (k - centre) ** 2).sum()
        signal = strength - k.size * variance
        drowned = signal <= 0.5 * strength
        alone += drowned
        expected = {
            "strength": strength,
            "frequency": centre * RATE / SIZE,
            "signal": strength if drowned else signal,
            "weight": 0.0 if drowned else 2 * signal**2 / strength,
            "width": squares if k.size > 1 else 0.0,
            "spread": squares / strength * (2 * np.pi / SIZE) ** 2 if k.size > 1 else 0.0,
        }
        for name, value in expected.items():
            assert known[name][i] == pytest.approx(value, rel=1e-9), (name, i)
        np.testing.assert_allclose(known["offset"][k - 1], k - centre, rtol=1e-9, atol=1e-9)
    assert 0 < alone < len(bands)  # both cases are there
    assert not np.asarray(of.alias).any()  # each period is sampled at the same phase
    assert of.floor == pytest.approx(SIZE * (RIPPLE * np.ptp(window())) ** 2, rel=0.1)
    whole = jnp.fft.rfft(jnp.asarray(window()))[1 : bins + 1]
    np.testing.assert_allclose(of.x, whole, atol=6 * np.sqrt(variance))


def test_a_bent_and_delayed_gain_departs_from_its_value_at_the_centre(exact):
    """½ s² (G″ − 2jτ G′ − τ² G) is exact in the coefficients for a parabola."""
    angle = 2 * np.pi * np.asarray(exact.frequency) / RATE
    a, b, c, delay = 0.4 - 0.1j, -0.3 + 0.2j, 0.5 + 0.7j, 1.7
    gain = a + b * angle + c * angle**2
    bend = 2 * c - 2j * delay * (b + 2 * c * angle) - delay**2 * gain
    found = exact.departure(jnp.asarray(gain), jnp.asarray(delay))
    expected = 0.5 * np.asarray(exact.spread) * bend
    np.testing.assert_allclose(found[1:-1], expected[1:-1], rtol=1e-6, atol=1e-12)


def loaded(gain, noise):
    """Windows behind a gain that is a straight line in frequency, and nothing lacks."""
    number = np.arange(SIZE // 2 + 1)
    v = np.fft.irfft(np.fft.rfft(window()) * gain(number), SIZE)
    return v + noise * np.random.default_rng(1).standard_normal((3, SIZE))


def line(number):
    return 0.5 - 1e-4 * number + 1e-4j * number


def test_gain_and_noise_are_those_of_a_straight_line_in_each_band(exact):
    v_out = loaded(line, 1.0)
    found = measured(exact, v_out, np.zeros(3), np.zeros(3))
    y = np.fft.rfft(v_out)
    squares, freedom = 0.0, 0
    for i, k in enumerate(bands_of(exact)):
        x = np.fft.rfft(window())[k]
        columns = np.stack([x, x * np.asarray(exact.offset)[k - 1]], axis=1)[:, : min(k.size, 2)]
        straight, _, _, _ = np.linalg.lstsq(columns, y[:, k].T)
        np.testing.assert_allclose(found.gain[:, i], straight[0], rtol=1e-4)  # single precision
        if k.size > 1:
            squares += (abs(y[:, k].T - columns @ straight) ** 2).sum(0)
            freedom += k.size - 2
    np.testing.assert_allclose(found.variance, squares / freedom, rtol=1e-4)
    weight = np.asarray(exact.weight) / np.asarray(found.variance)[:, None]
    np.testing.assert_allclose(found.weight, weight, rtol=1e-6)


def test_without_noise_the_variance_is_the_floor(exact):
    found = measured(exact, loaded(lambda number: 0.5 + 0 * number, 0.0), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(found.variance, exact.floor)
    np.testing.assert_allclose(found.gain, 0.5, rtol=1e-4)


def test_what_a_window_lacks_of_the_tail_is_added_to_the_gain(exact):
    """Amplitude 1 after 1 − lacking: the tail of the pulse before is smaller by this part."""
    lacking = np.array([0.5, -0.8, 0.0])
    tail = 3.0 * np.exp(-DECAY * (SIZE + np.arange(SIZE)))
    offset = np.array([0.3, 0.0, -0.2])
    v_out = 0.5 * (window() - lacking[:, None] * tail) + offset[:, None]
    found = measured(exact, v_out, lacking, offset)
    before = measured(exact, v_out, np.zeros(3), offset)
    error = abs(np.asarray(found.gain) - 0.5).max(1)
    without = abs(np.asarray(before.gain) - 0.5).max(1)
    # The mean of the last samples is not quite their middle, and numbers are in single precision.
    assert (error[:2] < 2e-3 * without[:2]).all(), error / without
    assert (without[:2] > 1e-3).all()
    np.testing.assert_array_equal(found.gain[2], before.gain[2])
    unsure = np.asarray(exact.weight) * abs(0.2 * np.asarray(found.gain - before.gain)) ** 2 / 2
    expected = np.asarray(exact.weight) / (np.asarray(found.variance)[:, None] + unsure)
    np.testing.assert_allclose(found.weight, expected, rtol=1e-3)


def test_the_tail_of_a_load_has_its_own_rate_as_far_as_noise_lets_it_be_seen(exact):
    t, lacking = np.arange(SIZE), np.full(4, 0.5)
    faster = 1.01 * DECAY
    v_out = np.stack([np.exp(-faster * t)] * 3 + [np.exp(-DECAY * t[::-1])])
    last = round(gain_bands.LAST * SIZE)
    middle = SIZE // 2
    early, late = v_out[0, middle : middle + last].mean(), v_out[0, -last:].mean()
    span = DECAY * (SIZE - last - middle)
    # Noise by which the logarithm of the rate is as uncertain as loads make it.
    equal = (0.2 * span) ** 2 * SIZE * last / (early**-2 + late**-2)
    variance = np.array([0.0, equal, 1e9 * equal, 0.0])
    found = np.asarray(lacking_tail(exact, v_out, lacking, np.zeros(4), variance))
    left = v_out[:, -last:].mean(1) / (1 - 0.5 * np.exp(-1.0))
    shape, by_rate = np.asarray(exact.tail)
    for i, part in enumerate((0.01, 0.005, 0.0, 0.0)):
        expected = 0.5 * left[i] * (shape + part * by_rate)
        np.testing.assert_allclose(found[i], expected, atol=1e-6 * abs(expected).max())
    # The second row of the tail is the derivative with respect to the logarithm of the rate.
    later = np.arange(SIZE) + last / 2
    x = np.asarray(exact.x)

    def projected(rate):
        e = np.fft.rfft(np.exp(-rate * later))[1 : x.size + 1] * x.conj()
        return np.array([e[k - 1].sum() for k in bands_of(exact)]) / np.asarray(exact.signal)

    np.testing.assert_allclose(shape, projected(DECAY), rtol=1e-6)
    step = 1e-4
    slope = (projected(DECAY * (1 + step)) - projected(DECAY * (1 - step))) / (2 * step)
    np.testing.assert_allclose(by_rate, slope, atol=1e-6 * abs(slope).max())
    assert exact.tail_left == pytest.approx(np.exp(-1.0), rel=1e-6)
