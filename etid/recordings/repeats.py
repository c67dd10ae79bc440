"""What differs between the pulse periods of one record, band by band.

An average over the periods, which is what estimators fit, hides every difference between them. Here
a record is cut into its P periods, each of them is transformed, and the deviation of each from
their mean Y is given as a change of the logarithm of the gain in some fifty bands of frequency,

    η = Σ conj(Y) (Y_p − Y) / Σ |Y|²,

with the variance that noise gives it. No model of driver or load is needed for that.

Periods are seldom a whole number of samples. The cut falls on the nearest sample, and the fraction
is taken out by a turn of the phase. Smooth parts of a deviation, which no pulse makes (a drift of
the mean, mains hum of 50 Hz), are projected out as a polynomial over the period.

**What has aliased** turns by e^(−j2πδ) where a cut is late by a fraction δ of a sample, unlike the
rest. `turn` is that direction, in which nothing can be concluded from a deviation.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.recordings.preflight import Inspected
from etid.signals.harmonics import fast_length
from etid.signals.measurement import RIPPLE
from etid.signals.pulse_train import RATE

BAND = 0.25  # of the sample rate; above it there is more of aliases than of the load
DEGREE = 6  # of the polynomial: it holds 0.994 of the 0.83 turns of mains hum of 50 Hz
SINGLE = 12  # harmonics that are bands of their own
RATIO = 1.08  # of the edges of the bands above
ALIGNED = 1e-3  # samples, below which a delay changes the gain in proportion
PASSES = 5  # to align periods; a clock that is off by 200 ppm needs three
MERGED = 4  # samples of V_th whose sum is one
LOW = 0.5  # of what is left of the band, in which such sums are as good as samples
TINY = 1e-30  # in place of the power of a record of zeros
# Amplitude by which cuts between samples let V_th differ, times the square of the pulse's width in
# samples: 1e-4 for 133 samples, 0.03 for 8.
CUT = 2.0
SURE = 5.0  # standard deviations by which the noise of a band must exceed that of all


class Repeats(NamedTuple):
    """Deviations of the periods of a recording from their mean; of several, along a first axis.

    Attributes:
        frequency: Middles of the bands [Hz].
        sample_rate: Samples per second [Hz].
        gain: Deviation of the logarithm of V_out.
        power: Σ |Y|².
        smooth: Σ conj(Y) times each polynomial.
        variance: Of the real part of a sum of `gain` over the periods with weights whose squares
            have the sum 1; of the imaginary part as well.
        turn: Direction of what has aliased, of length 1, or 0.
        unloaded: Deviation of the amplitude of V_th.
        unloaded_variance: As `variance`.
    """

    frequency: Float[np.ndarray, "*lane band"]
    sample_rate: Float[np.ndarray, "*lane"]
    gain: Complex[np.ndarray, "*lane period band"]
    power: Float[np.ndarray, "*lane band"]
    smooth: Complex[np.ndarray, "*lane polynomial band"]
    variance: Float[np.ndarray, "*lane band"]
    turn: Complex[np.ndarray, "*lane period"]
    unloaded: Float[np.ndarray, "*lane period"]
    unloaded_variance: Float[np.ndarray, "*lane"]


class Bands(NamedTuple):
    """The bands of records with one length of a period.

    Attributes:
        length: Samples of a period that are used.
        size: Samples to which they are filled up, whose transform is fast.
        edges: First harmonics of the bands, counted from 0.
        number: How many harmonics each has.
        middle: Middle of each [radian per sample].
        polynomials: Transforms of polynomials at the harmonics, orthonormal if their real and
            imaginary parts are put side by side.
    """

    length: int
    size: int
    edges: np.ndarray
    number: np.ndarray
    middle: np.ndarray
    polynomials: np.ndarray


@functools.lru_cache(maxsize=16)
def bands(sample_rate: float, pulse_rate: float) -> Bands:
    """The bands for a nominal pulse rate, whatever the clock makes of it."""
    length = int((1 - RATE) * sample_rate / pulse_rate)
    size = fast_length(length)
    count = int(BAND * size)
    edges = [*range(min(SINGLE, count))]
    while edges and edges[-1] * RATIO + 1 < count:
        edges.append(int(np.ceil(edges[-1] * RATIO + 1e-9)))
    edges = np.array(edges)
    number = np.diff([*edges, count])
    middle = 2 * np.pi * (edges + 1 + (number - 1) / 2) / size
    time = np.linspace(-1, 1, length)
    transforms = np.fft.rfft(np.polynomial.legendre.legvander(time, DEGREE), size, axis=0)[
        1 : count + 1
    ]
    joined = np.linalg.qr(np.concatenate([transforms.real, transforms.imag]))[0].T
    polynomials = joined[:, :count] + 1j * joined[:, count:]
    return Bands(length, size, edges, number, middle, polynomials.astype(np.complex64))


def repeats(seen: Sequence[Inspected]) -> list[Repeats | None]:
    """The deviations of the periods of recordings.

    None for those that hold less than two, or whose converter is coarse: its rounding differs
    between the periods, and is no noise.

    In single precision: the noise of a record is a hundred times its rounding errors. Recordings
    of equally many periods are looked at together, for a third of the time.

    Skin that changes during the record looks like hum between the harmonics. Where periods still
    differ after hum was subtracted, it was not the hum: they are compared as they were recorded.
    """
    found: list[Repeats | None] = [None] * len(seen)
    alike: dict[tuple, list[int]] = {}
    for number, one in enumerate(seen):
        coarse = one.coarse_th > 0 or one.coarse_out > 0
        if one.periods[0] > 1 and one.is_periodic and not coarse:
            of = one.recording
            key = one.periods[0], of.sample_rate, of.pulse_rate
            alike.setdefault(key, []).append(number)
    for numbers in alike.values():
        group = [seen[number] for number in numbers]
        records = [(one.v_th, one.v_out) for one in group]
        of_group = _of_equal_periods(group, records)
        for row, one in enumerate(group):
            hum = one.hum_th is not None or one.hum_out is not None
            if hum and _differ(of_group[row]):
                recorded = [(one.recorded_th, one.recorded_out)]
                (of_group[row],) = _of_equal_periods([one], recorded)
        for number, of in zip(numbers, of_group, strict=True):
            found[number] = of
    return found


def _differ(of: Repeats) -> bool:
    """Whether the periods differ by more than noise."""
    periods, count = of.gain.shape
    square = (_power(of.gain) / of.variance).sum()
    freedom = 2 * (periods - 1) * count
    return bool(square > freedom + SURE * math.sqrt(2 * freedom))


def _of_equal_periods(
    group: Sequence[Inspected], records: Sequence[tuple[np.ndarray, np.ndarray]]
) -> list[Repeats]:
    """The deviations of recordings with as many periods and equal rates, from these voltages."""
    of, (periods, _) = group[0].recording, group[0].periods
    at = np.stack([one.begins for one in group])
    known = bands(of.sample_rate, of.pulse_rate)
    sigma = np.array([one.sigma_out for one in group])
    # A record that is late would be cut within its pulses.
    loaded = [_turned(v, one) for one, (_, v) in zip(group, records, strict=True)]
    own = _deviations(loaded, at, known, sigma)
    sigma = np.array([one.sigma_th for one in group])
    merged = bands(of.sample_rate / MERGED, of.pulse_rate)
    sums = [_merged(v_th) for v_th, _ in records]
    unloaded = _deviations(sums, at / MERGED, merged, sigma * math.sqrt(MERGED))
    weight = np.where(merged.middle < LOW * merged.middle[-1], 1 / unloaded.variance, 0.0)
    smooth = _smooth(unloaded.mean, merged)
    # What a change of the amplitude by 1 makes where polynomials are projected out.
    unit = 1 - (np.real(smooth.sum(2))[:, :, None] * smooth).sum(1) / unloaded.power
    total = (weight * _power(unit)).sum(1)
    along = np.real(unloaded.gain * (weight * np.conj(unit))[:, None, :]).sum(2)
    amplitude, smooth = along / total[:, None], _smooth(own.mean, known)
    # Coloured noise is in no way of the amplitude: what that leaves tells how large it is.
    rest = unloaded.gain - amplitude[:, :, None] * unit[:, None, :]
    freedom = (2 * np.count_nonzero(weight, axis=1) - 1) * (periods - 1)
    noise = np.maximum(1.0, (weight[:, None, :] * _power(rest)).sum((1, 2)) / freedom)
    width = [np.count_nonzero(np.abs(v) > np.abs(v).max() / 2) / periods for v, _ in records]
    turn = np.exp(-2j * np.pi * own.late)
    turn -= turn.mean(1, keepdims=True)
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    turn = np.where(size > ALIGNED, turn / np.maximum(size, ALIGNED), 0)
    frequency = known.middle * (of.sample_rate / (2 * np.pi))
    rate, variance = np.asarray(of.sample_rate), noise / total + (CUT / np.square(width)) ** 2
    parts = own.gain, own.power, smooth, own.variance, turn, amplitude, variance
    return [Repeats(frequency, rate, *of_row) for of_row in zip(*parts, strict=True)]


def _smooth(mean: np.ndarray, known: Bands) -> np.ndarray:
    """Σ conj(Y) times each polynomial, for each recording."""
    products = np.conj(mean)[:, None, :] * known.polynomials
    return np.add.reduceat(products, known.edges, axis=2)


def _turned(v_out: Float[np.ndarray, " time"], of: Inspected) -> Float[np.ndarray, " time"]:
    """The loaded voltage without its lag: what is cut off at one end is put to the other."""
    return np.roll(v_out[: of.periods[1]], -of.lag) if of.lag else v_out


class _Deviations(NamedTuple):
    """`gain`, `power` and `variance` of a `Repeats`, the mean, and how late each cut is."""

    gain: np.ndarray
    power: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    late: np.ndarray


def _merged(v: Float[np.ndarray, " time"]) -> Float[np.ndarray, " part"]:
    """Sums of a few samples, which do for the amplitude at low frequencies."""
    whole = v[: v.size // MERGED * MERGED]
    return functools.reduce(np.add, (whole[first::MERGED] for first in range(MERGED)))


def _deviations(
    records: Sequence[Float[np.ndarray, "_"]],
    at: Float[np.ndarray, "lane period"],
    known: Bands,
    sigma: Float[np.ndarray, " lane"],
) -> "_Deviations":
    """Deviations of periods that begin `at`."""
    lanes, periods = at.shape
    last = np.array([v.size - known.length for v in records])
    starts = np.minimum(np.rint(at), last[:, None]).astype(int)
    late = starts - at
    cut = np.empty((lanes, periods, known.length), np.float32)
    for lane, v in enumerate(records):
        for row, start in enumerate(starts[lane]):
            cut[lane, row] = v[start : start + known.length]
    sigma = np.maximum(sigma, RIPPLE * np.ptp(cut[:, 0], axis=1))
    cut -= cut.mean((1, 2), keepdims=True)
    count = int(known.number.sum())
    raw = np.fft.rfft(cut, known.size)[:, :, 1 : count + 1]
    power, mean, weight, gain = _compared(raw, late, known)
    for _ in range(PASSES):
        # Least squares of a delay, η = jωτ, which is not quite right where the gain changes too.
        of_delay = known.middle * weight
        total = (known.middle * of_delay).sum(1)
        more = (np.imag(gain) * of_delay[:, None, :]).sum(2) / total[:, None]
        surely = np.maximum(ALIGNED, SURE * sigma * np.sqrt(known.length / total))
        moved = np.abs(more).max(1) > surely
        if not moved.any():
            break
        late = late + np.where(moved[:, None], more, 0.0)
        power, mean, weight, gain = _compared(raw, late, known)
    # What no change of the gain explains is noise.
    rest = np.add.reduceat(power, known.edges, axis=1) - weight * _power(gain).sum(1)
    freedom = 2 * (known.number - 1) * (periods - 1)
    overall = np.maximum(rest.sum(1) / max(freedom.sum(), 1), sigma**2 * known.length / 2)[:, None]
    freedom = np.maximum(freedom, 1)
    sure = rest > overall * (freedom + SURE * np.sqrt(2 * freedom))
    noise = np.where(sure & (known.number > 1), rest / freedom, overall)
    single = np.count_nonzero(known.number == 1)
    if single > 2:
        low = _noise_of_single(gain[:, :, :single], weight[:, :single])
        sure = low > overall[:, 0] * (1 + SURE * math.sqrt(2 / ((single - 2) * (periods - 1))))
        noise[:, :single] = np.where(sure, low, overall[:, 0])[:, None]
    return _Deviations(gain, weight, noise / weight, mean, late)


def _noise_of_single(gain: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Noise of bands of one harmonic, from second differences between them.

    A change of the load is smooth over the first harmonics, and coloured noise is not.
    """
    bend = gain[:, :, :-2] - 2 * gain[:, :, 1:-1] + gain[:, :, 2:]
    spread = 1 / weight[:, :-2] + 4 / weight[:, 1:-1] + 1 / weight[:, 2:]
    freedom = 2 * (gain.shape[1] - 1) * bend.shape[2]
    return (_power(bend) / spread[:, None, :]).sum((1, 2)) / freedom


def _power(values: np.ndarray) -> np.ndarray:
    return np.real(values) ** 2 + np.imag(values) ** 2


def _compared(
    raw: np.ndarray, late: Float[np.ndarray, "lane period"], known: Bands
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of periods that are late: power of the deviations, the mean, its power, and `gain`."""
    aligned = raw * _turns(late * (2 * np.pi / known.size), raw.shape[2])
    mean = aligned.mean(1)
    aligned -= mean[:, None, :]
    deviation = _without(aligned, known.polynomials)
    weight = np.maximum(np.add.reduceat(_power(mean), known.edges, axis=1).astype(float), TINY)
    sums = np.add.reduceat(np.conj(mean)[:, None, :] * deviation, known.edges, axis=2)
    return _power(deviation).sum(1), mean, weight, sums / weight[:, None, :]


def _turns(angle: Float[np.ndarray, "lane period"], count: int) -> np.ndarray:
    """e^(−j k angle) for k = 1 … `count`, by products of few exponentials."""
    step = 1 << ((count - 1).bit_length() + 1) // 2
    fine = np.exp(-1j * angle[..., None] * np.arange(1, step + 1)).astype(np.complex64)
    coarse = np.exp(-1j * angle[..., None] * np.arange(0, count, step)).astype(np.complex64)
    product = coarse[..., :, None] * fine[..., None, :]
    return product.reshape(*angle.shape, -1)[..., :count]


def _without(deviation: np.ndarray, polynomials: np.ndarray) -> np.ndarray:
    """Deviations without what the polynomials can do."""
    # One recording after the other: products so small start no threads.
    for own in deviation:
        own -= np.real(own @ polynomials.conj().T).astype(own.dtype) @ polynomials
    return deviation
