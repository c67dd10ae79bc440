"""Deviations of the periods of records from their mean, in bands of frequency.

The arrays of `etid.recordings.repeats`: transforms of periods in, gains, their noise and the
directions of aliases out.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.signals.periods import fast_length, length_of, turns
from etid.signals.transfer import power as power_of

# Relative to the sample rate. Below it, bands share one estimate of their noise. Above it, aliases
# can exceed the noise; each band then has its own.
PLAIN = 0.25
ALIGNED = 1e-3  # [samples] a smaller delay changes the gain in proportion
TINY = 1e-30  # replaces the power of a record of zeros
SURE = 5.0  # [standard deviations] the noise of a band must exceed that of all bands by this


class Bands(NamedTuple):
    """Bands of frequency of records with equal sample rates and pulse rates.

    Attributes:
        length: Number of samples of a period that are used.
        size: Number of samples after zero padding, chosen for a fast transform.
        edges: First harmonic of each band, counted from 0.
        number: Number of harmonics in each band.
        middle: Centre of each band [radian per sample].
        polynomials: Transforms of polynomials at the harmonics. As real vectors of real and
            imaginary parts they are orthonormal.
    """

    length: int
    size: int
    edges: np.ndarray
    number: np.ndarray
    middle: np.ndarray
    polynomials: np.ndarray


@functools.lru_cache(maxsize=16)
def bands(sample_rate: float, pulse_rate: float, band: float) -> Bands:
    """Bands for a nominal pulse rate, up to `band` times the sample rate.

    Each of the twelve lowest harmonics is a band. Above them the edges of the bands have a ratio of
    1.08. The polynomials have a degree of 6, which describes 0.994 of the 0.83 turns of 50 Hz hum.
    The measured pulse rate may differ from the nominal one.
    """
    length = length_of(sample_rate / pulse_rate)
    size = fast_length(length)
    count = int(band * size)
    edges, ratio = [*range(min(12, count))], 1.08
    while edges and edges[-1] * ratio + 1 < count:
        edges.append(int(np.ceil(edges[-1] * ratio + 1e-9)))
    edges = np.array(edges)
    number = np.diff([*edges, count])
    middle = 2 * np.pi * (edges + 1 + (number - 1) / 2) / size
    time = np.linspace(-1, 1, length)
    transforms = np.fft.rfft(np.polynomial.legendre.legvander(time, 6), size, axis=0)[1 : count + 1]
    joined = np.linalg.qr(np.concatenate([transforms.real, transforms.imag]))[0].T
    polynomials = joined[:, :count] + 1j * joined[:, count:]
    polynomials = polynomials.astype(np.complex64, order="C")
    return Bands(length, size, edges, number, middle, polynomials)


def smoothed(mean: np.ndarray, layout: Bands) -> np.ndarray:
    """Σ conj(Y) times each polynomial, for each recording and band."""
    products = np.conj(mean)[:, None, :] * layout.polynomials
    return np.add.reduceat(products, layout.edges, axis=2)


def rotations(
    late: Float[np.ndarray, "lane period"],
) -> tuple[Complex[np.ndarray, "lane period alias"], Complex[np.ndarray, "lane period direction"]]:
    """How aliases rotate with these delays [samples], without the mean, and an orthonormal basis.

    They are those of fs − f, fs + f, 2 fs − f and 2 fs + f.
    """
    turned = np.exp(-2j * np.pi * np.array([1, -1, 2, -2]) * late[:, :, None])
    turned -= turned.mean(1, keepdims=True)
    basis, by = np.linalg.qr(turned)
    size = np.abs(np.diagonal(by, axis1=1, axis2=2))
    return turned, np.where((size > ALIGNED)[:, None], basis, 0)


class Deviations(NamedTuple):
    """`gain`, `power` and `variance` as in `Repeats`, mean, delay and transform of each cut."""

    gain: np.ndarray
    power: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    late: np.ndarray
    raw: np.ndarray


def deviations_of(
    raw: Complex[np.ndarray, "lane period harmonic"],
    late: Float[np.ndarray, "lane period"],
    layout: Bands,
    least: Float[np.ndarray, "lane band"],
    aliased: Bool[np.ndarray, " lane"],
) -> Deviations:
    """Deviations of periods, and at least this noise.

    Args:
        raw: Transforms of the periods.
        late: By how much each of them is cut late [samples]; exact for records whose aliases are
            known (`aliased`).
        layout: The bands.
        least: Variance of the real part of a harmonic of one period, at least.
        aliased: Records whose aliases are known.
    """
    periods = raw.shape[1]
    power, mean, weight, gain = _compared(raw, late, layout)
    line = np.arange(periods) - (periods - 1) / 2
    line /= np.linalg.norm(line)
    for _ in range(5):  # a clock error of 200 ppm needs three
        # Least-squares estimate of a delay, η = jωτ; it is approximate if the gain changes too.
        of_delay = layout.middle * weight / least
        total = (layout.middle * of_delay).sum(1)
        more = (np.imag(gain) * of_delay[:, None, :]).sum(2) / total[:, None]
        surely = np.maximum(ALIGNED, SURE / np.sqrt(total))
        # Two clocks make a line of the delays, which is known better than each of them.
        slope = more @ line
        by_line = np.abs(slope) > surely
        singly = np.abs(more).max(1) > 1.5 * surely
        moved = (by_line | singly) & ~aliased
        if not moved.any():
            break
        line_of = np.where(by_line, slope, 0)[:, None] * line
        late = late + np.where(aliased[:, None], 0, np.where(singly[:, None], more, line_of))
        again = _compared(raw[moved], late[moved], layout)
        for whole, part in zip((power, mean, weight, gain), again, strict=True):
            whole[moved] = part
    # The part that no change of the gain explains is noise, or aliases.
    left, quiet = np.full(len(raw), periods - 1), gain
    if aliased.any():
        turn = rotations(late[aliased])[1][..., : periods - 2]
        left[aliased] -= turn.any(1).sum(1)
        power[aliased], _, _, of_rest = _compared(raw[aliased], late[aliased], layout, turn)
        quiet = gain.copy()
        quiet[aliased] = of_rest
    rest = np.add.reduceat(power, layout.edges, axis=1) - weight * power_of(quiet).sum(1)
    freedom = 2 * (layout.number - 1) * left[:, None]
    plain = layout.middle < 2 * np.pi * PLAIN
    excess = (rest / least)[:, plain].sum(1) / np.maximum(freedom[:, plain].sum(1), 1)
    overall = np.maximum(excess, 1.0)[:, None] * least
    freedom = np.maximum(freedom, 1)
    sure = rest > overall * (freedom + SURE * np.sqrt(2 * freedom))
    noise = np.where(sure & (layout.number > 1), rest / freedom, overall)
    single = np.count_nonzero(layout.number == 1)
    if single > 2:
        low = _noise_of_single(quiet[:, :, :single], (weight / overall)[:, :single], left)
        sure = low > 1 + SURE * np.sqrt(2 / ((single - 2) * left))
        noise[:, :single] = np.where(sure, low, 1.0)[:, None] * overall[:, :single]
    return Deviations(gain, weight, noise / weight, mean, late, raw)


def _noise_of_single(
    gain: np.ndarray, weight: np.ndarray, left: Int[np.ndarray, " lane"]
) -> np.ndarray:
    """Noise of the bands of one harmonic relative to 1/weight, of so many deviations.

    It is found from second differences between these bands. A change of the load is smooth over the
    first harmonics; coloured noise is not.
    """
    bend = gain[:, :, :-2] - 2 * gain[:, :, 1:-1] + gain[:, :, 2:]
    spread = 1 / weight[:, :-2] + 4 / weight[:, 1:-1] + 1 / weight[:, 2:]
    freedom = 2 * left * bend.shape[2]
    return (power_of(bend) / spread[:, None, :]).sum((1, 2)) / freedom


def _compared(
    raw: np.ndarray,
    late: Float[np.ndarray, "lane period"],
    layout: Bands,
    turn: Complex[np.ndarray, "lane period direction"] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Power of the deviations, mean, its power, and `gain`, for periods with these delays.

    Deviations in the directions `turn` are removed.
    """
    # Most recordings of a batch are cut alike.
    alike = late[:1] if (late == late[0]).all() else late
    turn_back = turns(alike * (2 * np.pi / layout.size), 1, raw.shape[2] + 1)
    deviation = raw * turn_back.astype(np.complex64)
    mean = np.einsum("lpk->lk", deviation) / raw.shape[1]  # faster than `mean`
    deviation -= mean[:, None, :]
    if turn is not None:
        along = turn.astype(np.complex64)
        deviation -= along @ (along.conj().swapaxes(1, 2) @ deviation)
    deviation = _without(deviation, layout.polynomials)
    weight = np.maximum(np.add.reduceat(power_of(mean), layout.edges, axis=1).astype(float), TINY)
    parts = deviation.view(np.float32)
    square = np.einsum("lpk,lpk->lk", parts, parts)
    deviation *= np.conj(mean)[:, None, :]
    sums = np.add.reduceat(deviation, layout.edges, axis=2)
    return square[:, ::2] + square[:, 1::2], mean, weight, sums / weight[:, None, :]


def _without(deviation: np.ndarray, polynomials: np.ndarray) -> np.ndarray:
    """Deviations without their projection on the polynomials; changed in place."""
    # Real and imaginary parts side by side: the real part of a product is the product of these.
    real, basis = deviation.view(np.float32), polynomials.view(np.float32)
    # One recording after the other, because such small products start no threads.
    for own in real:
        own -= (own @ basis.T) @ basis
    return deviation
