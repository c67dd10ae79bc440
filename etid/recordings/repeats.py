"""Differences between the pulse periods of one record, in bands of frequency.

Estimators fit the average over the periods. The average hides all differences between the periods.
This module cuts a record into its P periods and transforms each period. The deviation of a period p
from the mean Y is a change of the logarithm of the gain in about fifty bands of frequency,

    η = Σ conj(Y) (Y_p − Y) / Σ |Y|².

The module also computes the variance of η that noise causes. It needs no model of driver or load.

The length of a period is usually not a whole number of samples. A cut is at the nearest sample; a
rotation of the phase corrects the remaining fraction. Smooth parts of a deviation do not come from
pulses but from a drift of the mean or from mains hum of 50 Hz. They are projected out as a
polynomial over the period.

A driver with a source impedance turns a change of the load into one of a measured current X too.
Both are recorded at once, so the module then compares X̄ Y_p − Ȳ X_p, which no change of the driver
moves. Its projection on X̄ Ȳ, weighted by the noise, is the change of the logarithm of Y / X.

**Aliases** rotate by e^(−j2πδ) if a cut is late by a fraction δ of a sample; the rest does not.
`turn` is the direction t of this rotation. A deviation in this direction proves nothing: only
(1 − t tᴴ) η counts. Where the power A² of the aliases is known (`etid.signals.averaging`), those of
fs + f, which rotate by e^(j2πδ), and those of twice the sample rate have directions, too, and η is
weighted as if they were noise: by (1 + Σ ρ t tᴴ)⁻¹, ρ = n A²/σ² in a band of n harmonics.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.recordings.preflight import Inspected
from etid.signals.harmonics import aliases
from etid.signals.pulse_train import RATE, fast_length

# Relative to the sample rate. Below it, bands share one estimate of their noise. Above it, aliases
# can exceed the noise; each band then has its own.
PLAIN = 0.25
ALIASES = 0.03  # of the sample rate; above, a change is not told from aliases
ALIGNED = 1e-3  # [samples] a smaller delay changes the gain in proportion
TINY = 1e-30  # replaces the power of a record of zeros
SURE = 5.0  # [standard deviations] the noise of a band must exceed that of all bands by this


class Repeats(NamedTuple):
    """Deviations of the periods of a recording from their mean.

    A batch of recordings has one more axis, the first axis.

    Attributes:
        frequency: Centre of each band [Hz].
        sample_rate: Samples per second [Hz].
        gain: Deviation η of the logarithm of V_out.
        power: Σ |Y|².
        smooth: Σ conj(Y) times each polynomial.
        variance: Variance of the real part of a weighted sum of `gain` over the periods, if the
            squares of the weights have the sum 1. The imaginary part has the same variance.
        turn: Directions of the aliases, T, orthogonal to each other; the length of each is 1, or 0
            if all cuts have the same delay.
        removed: The part M of these directions that does not count: (1 − Tᴴ M T) η does.
        unloaded: Deviation of the amplitude of V_th.
        unloaded_variance: Variance of `unloaded`, defined as `variance`.
    """

    frequency: Float[np.ndarray, "*lane band"]
    sample_rate: Float[np.ndarray, "*lane"]
    gain: Complex[np.ndarray, "*lane period band"]
    power: Float[np.ndarray, "*lane band"]
    smooth: Complex[np.ndarray, "*lane polynomial band"]
    variance: Float[np.ndarray, "*lane band"]
    turn: Complex[np.ndarray, "*lane direction period"]
    removed: Complex[np.ndarray, "*lane band direction direction"]
    unloaded: Float[np.ndarray, "*lane period"]
    unloaded_variance: Float[np.ndarray, "*lane"]


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
    length = int((1 - RATE) * sample_rate / pulse_rate)
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


def repeats(inspected: Sequence[Inspected]) -> list[Repeats | None]:
    """Deviations of the periods of each recording.

    The result is None for a recording with fewer than two periods or with a coarse converter: the
    rounding errors of a coarse converter differ between the periods and are not noise.

    The computation uses single precision: the noise of a record is a hundred times its rounding
    errors. Recordings with the same number of periods are processed together, in a third of the
    time.

    Skin that changes during the record looks like hum between the harmonics. If the periods still
    differ after the subtraction of hum, hum was not the reason. Then the periods are compared as
    they were recorded.
    """
    deviations: list[Repeats | None] = [None] * len(inspected)
    alike: dict[tuple, list[int]] = {}
    for number, one in enumerate(inspected):
        if one.periods[0] > 1 and one.is_periodic and not one.coarse.any():
            recording = one.recording
            key = one.has_current, one.periods[0], recording.sample_rate, recording.pulse_rate
            alike.setdefault(key, []).append(number)
    for numbers in alike.values():
        group = [inspected[number] for number in numbers]
        of_group = _of_equal_periods(group, [one.quiet for one in group])
        for row, one in enumerate(group):
            if one.hums and _differ(of_group[row]):
                (of_group[row],) = _of_equal_periods([one], [one.recorded])
        for number, of_one in zip(numbers, of_group, strict=True):
            deviations[number] = of_one
    return deviations


def _differ(of: Repeats) -> bool:
    """Whether the periods differ by more than noise explains, in bands without aliases."""
    plain = of.frequency < PLAIN * of.sample_rate
    square = (_power(of.gain) / of.variance)[:, plain].sum()
    freedom = 2 * (len(of.gain) - 1) * np.count_nonzero(plain)
    return bool(square > freedom + SURE * math.sqrt(2 * freedom))


def _of_equal_periods(
    group: Sequence[Inspected], records: Sequence[Float[np.ndarray, "2 _"]]
) -> list[Repeats]:
    """Deviations of recordings with equal rates and numbers of periods, from these voltages."""
    recording, (periods, _) = group[0].recording, group[0].periods
    sample_rate, pulse_rate = recording.sample_rate, recording.pulse_rate
    at = np.stack([one.begins for one in group])
    layout = bands(sample_rate, pulse_rate, 0.4)
    # Without this shift, a late record would be cut within its pulses.
    loaded = [_turned(v, one) for one, (_, v) in zip(group, records, strict=True)]
    aliased = np.array([one.aliases is not None for one in group])
    own = _deviations(loaded, at, layout, _noise(group, 1, layout), aliased)
    if group[0].has_current:
        currents = [current for current, _ in records]
        other = _deviations(currents, at, layout, _noise(group, 0, layout), aliased)
        return _of_currents(group, layout, own, other)
    # Of V_th only the amplitude is wanted. If some of the samples were left out, the aliases of its
    # edges would look like another amplitude in each period: by 1e-3 if every fourth remains.
    low = bands(sample_rate, pulse_rate, 1 / 32)
    v_th = [v_th for v_th, _ in records]
    unloaded = _deviations(v_th, at, low, _noise(group, 0, low), aliased)
    weight, smooth = 1 / unloaded.variance, _smooth(unloaded.mean, low)
    # Effect of an amplitude change by 1 after the projection of the polynomials.
    unit = 1 - (np.real(smooth.sum(2))[:, :, None] * smooth).sum(1) / unloaded.power
    total = (weight * _power(unit)).sum(1)
    along = np.real(unloaded.gain * (weight * np.conj(unit))[:, None, :]).sum(2)
    amplitude, smooth = along / total[:, None], _smooth(own.mean, layout)
    # Coloured noise does not look like an amplitude change: the rest measures its size.
    rest = unloaded.gain - amplitude[:, :, None] * unit[:, None, :]
    freedom = (2 * low.middle.size - 1) * (periods - 1)
    noise = np.maximum(1.0, (weight[:, None, :] * _power(rest)).sum((1, 2)) / freedom)
    pulses = zip(group, records, strict=True)
    width = [_phase(v, *one.limits[0]) / periods for one, (v, _) in pulses]
    # Because cuts fall between samples, the amplitude differs by 1e-4 for 133 samples of a pulse,
    # by 0.03 for 8 samples.
    variance = noise / total + (2 / np.square(width)) ** 2
    turn, removed = _directions(own.late, group, layout)
    parts = own.gain, own.power, smooth, own.variance, turn, removed, amplitude, variance
    return _rows(sample_rate, layout, parts)


def _rows(sample_rate: float, layout: Bands, parts: tuple[np.ndarray, ...]) -> list[Repeats]:
    """The rows of the fields after `sample_rate`."""
    frequency = layout.middle * (sample_rate / (2 * np.pi))
    rate = np.asarray(sample_rate)
    return [Repeats(frequency, rate, *of_row) for of_row in zip(*parts, strict=True)]


def _directions(
    late: Float[np.ndarray, "lane period"], group: Sequence[Inspected], layout: Bands
) -> tuple[
    Complex[np.ndarray, "lane direction period"],
    Complex[np.ndarray, "lane band direction direction"],
]:
    """`Repeats.turn` and `Repeats.removed` for cuts with these delays [samples]."""
    turns, basis = _rotations(late)
    count = basis.shape[2]
    removed = np.zeros((len(group), layout.middle.size, count, count), complex)
    for row, one in enumerate(group):
        if one.aliases is None:
            basis[row, :, 1:] = 0
            removed[row, :, 0, 0] = _aliased(one, layout) & basis[row].any()
            continue
        place = layout.middle / (2 * np.pi)
        y = one.aliases[1].at(place)[:2]
        noise = _in_bands(one, layout, np.asarray(one.noise.variance[1]))
        ratio = np.repeat(y * layout.number / (len(late[row]) * noise), 2, axis=0)
        inside = basis[row].conj().T @ turns[row]
        of_aliases = np.einsum("ak,kb,ck->bac", inside, ratio, inside.conj())
        removed[row] = np.eye(count) - np.linalg.inv(np.eye(count) + of_aliases)
    return basis.swapaxes(1, 2), removed


def _rotations(
    late: Float[np.ndarray, "lane period"],
) -> tuple[Complex[np.ndarray, "lane period alias"], Complex[np.ndarray, "lane period direction"]]:
    """How aliases rotate with these delays [samples], without the mean, and an orthonormal basis.

    They are those of fs − f, fs + f, 2 fs − f and 2 fs + f.
    """
    turns = np.exp(-2j * np.pi * np.array([1, -1, 2, -2]) * late[:, :, None])
    turns -= turns.mean(1, keepdims=True)
    basis, by = np.linalg.qr(turns)
    size = np.abs(np.diagonal(by, axis1=1, axis2=2))
    return turns, np.where((size > ALIGNED)[:, None], basis, 0)


def _of_currents(
    group: Sequence[Inspected], layout: Bands, own: "_Deviations", other: "_Deviations"
) -> list[Repeats]:
    """Deviations of the quotients of voltage and current."""
    pairs = []
    clock = _turns(own.late * (2 * np.pi / layout.size), own.raw.shape[2])  # one for both
    for of in (own, other):
        unit = np.sqrt(of.power.sum(1))  # squares of small currents would underflow
        turned = of.raw * clock
        turned = turned / unit[:, None, None]
        noise = np.repeat(of.variance * of.power / unit[:, None] ** 2, layout.number, axis=1)
        pairs.append((turned, turned.mean(1), noise))
    (y, y_mean, y_noise), (x, x_mean, x_noise) = pairs
    white = 1 / np.sqrt(_power(x_mean) * y_noise + _power(y_mean) * x_noise)
    mean, by_y, by_x = white * x_mean * y_mean, white * x_mean, white * y_mean
    deviation = by_y[:, None] * y - by_x[:, None] * x
    power = np.maximum(np.add.reduceat(_power(mean), layout.edges, axis=1), TINY)
    smooth, gain = [], []
    # A drift of either channel is a polynomial times the mean of the other one.
    for row in range(len(mean)):
        drifts = np.concatenate([by_y[row] * layout.polynomials, by_x[row] * layout.polynomials])
        stacked = np.linalg.qr(np.concatenate([np.real(drifts), np.imag(drifts)], axis=1).T)[0].T
        basis = stacked[:, : mean.shape[1]] + 1j * stacked[:, mean.shape[1] :]
        rest = deviation[row] - np.real(deviation[row] @ basis.conj().T) @ basis
        gain.append(np.add.reduceat(rest * mean[row].conj(), layout.edges, axis=1) / power[row])
        smooth.append(np.add.reduceat(mean[row].conj() * basis, layout.edges, axis=1))
    none = np.zeros(own.late.shape)  # an amplitude that changes in both records does no harm
    turn, removed = _directions(own.late, group, layout)
    parts = np.stack(gain), power, np.stack(smooth), 1 / power, turn, removed
    rate = group[0].recording.sample_rate
    return _rows(rate, layout, (*parts, none, np.ones(len(none))))


def _phase(v: Float[np.ndarray, " time"], low: float, high: float) -> int:
    """Number of samples in all pulses; of biphasic pulses, those in the shorter phase."""
    half = max(-low, high) / 2
    above = int(np.count_nonzero(v > half)) if high > half else 0
    below = int(np.count_nonzero(v < -half)) if low < -half else 0
    return min(above, below) or max(above, below)


def _smooth(mean: np.ndarray, layout: Bands) -> np.ndarray:
    """Σ conj(Y) times each polynomial, for each recording and band."""
    products = np.conj(mean)[:, None, :] * layout.polynomials
    return np.add.reduceat(products, layout.edges, axis=2)


def _turned(v_out: Float[np.ndarray, " time"], of: Inspected) -> Float[np.ndarray, " time"]:
    """Loaded voltage without its lag; the samples cut off at one end are added at the other."""
    return np.roll(v_out[: of.periods[1]], -of.lag) if of.lag else v_out


def _aliased(one: Inspected, layout: Bands) -> Bool[np.ndarray, " band"]:
    """Bands whose aliases may exceed the noise.

    Those above `ALIASES`, and those where what continues V_out beyond is too large. Aliases of the
    n harmonics of a band add up, noise does not.
    """
    high = layout.middle > 2 * np.pi * ALIASES
    if one.has_current:
        return high
    variance = np.asarray(one.noise.variance[1])
    y = one.spectrum[2][: variance.size]
    ratio = np.asarray(aliases(y, variance, *one.periods).power / variance)
    return high | (_in_bands(one, layout, ratio) * layout.number > 0.1)


def _noise(
    group: Sequence[Inspected], record: int, layout: Bands
) -> Float[np.ndarray, "lane band"]:
    """Variance of the real part of a harmonic of one period, in each band of one of the records."""
    found = []
    for one in group:
        variance = _in_bands(one, layout, np.asarray(one.noise.variance[record]))
        found.append(variance * one.periods[1] * (layout.length / 2))
    return np.stack(found)


def _in_bands(
    one: Inspected, layout: Bands, values: Float[np.ndarray, " harmonic"]
) -> Float[np.ndarray, " band"]:
    """Values at the harmonics of a recording, at the centre of each band."""
    angle = one.spectrum[0] * (2 * np.pi / one.recording.sample_rate)
    return np.interp(layout.middle, angle[: values.size], values)


class _Deviations(NamedTuple):
    """`gain`, `power` and `variance` as in `Repeats`, mean, delay of each cut, `_transforms`."""

    gain: np.ndarray
    power: np.ndarray
    variance: np.ndarray
    mean: np.ndarray
    late: np.ndarray
    raw: np.ndarray


def _deviations(
    records: Sequence[Float[np.ndarray, "_"]],
    at: Float[np.ndarray, "lane period"],
    layout: Bands,
    least: Float[np.ndarray, "lane band"],
    aliased: Bool[np.ndarray, " lane"],
) -> "_Deviations":
    """Deviations of the periods with the starts `at` [samples] and at least this `_noise`.

    The starts are exact for records whose aliases are known (`aliased`).
    """
    periods = at.shape[1]
    last = np.array([v.size - layout.length for v in records])
    starts = np.minimum(np.rint(at), last[:, None]).astype(int)  # samples at which periods are cut
    late = starts - at
    raw = _transforms(records, starts, layout)
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
        turn = _rotations(late[aliased])[1][..., : periods - 2]
        left[aliased] -= turn.any(1).sum(1)
        power[aliased], _, _, of_rest = _compared(raw[aliased], late[aliased], layout, turn)
        quiet = gain.copy()
        quiet[aliased] = of_rest
    rest = np.add.reduceat(power, layout.edges, axis=1) - weight * _power(quiet).sum(1)
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
    return _Deviations(gain, weight, noise / weight, mean, late, raw)


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
    return (_power(bend) / spread[:, None, :]).sum((1, 2)) / freedom


def _power(values: np.ndarray) -> np.ndarray:
    return np.real(values) ** 2 + np.imag(values) ** 2


def _transforms(
    records: Sequence[Float[np.ndarray, "_"]], starts: Int[np.ndarray, "lane period"], layout: Bands
) -> np.ndarray:
    """Harmonics of each period, without the line from its first sample to its last.

    The line is that of the mean over the periods. A phase cannot rotate the ends of a period that
    are not 0: in a pulse or on its tail, cuts beside their place would look like a change.
    """
    # Single precision suffices, and the products with polynomials are faster.
    cut = np.zeros((*starts.shape, layout.size), np.float32)
    used = cut[..., : layout.length]  # the zeros after it make the transform fast
    for v, own, places in zip(records, used, starts.tolist(), strict=True):
        for period, start in zip(own, places, strict=True):
            period[:] = v[start : start + layout.length]
    first, last = used[..., [0, -1]].mean(1).T[..., None]
    used -= (first + (last - first) * np.linspace(0, 1, layout.length))[:, None]
    return np.fft.rfft(cut)[:, :, 1 : layout.polynomials.shape[1] + 1]


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
    deviation = raw * _turns(alike * (2 * np.pi / layout.size), raw.shape[2])
    mean = np.einsum("lpk->lk", deviation) / raw.shape[1]  # faster than `mean`
    deviation -= mean[:, None, :]
    if turn is not None:
        along = turn.astype(np.complex64)
        deviation -= along @ (along.conj().swapaxes(1, 2) @ deviation)
    deviation = _without(deviation, layout.polynomials)
    weight = np.maximum(np.add.reduceat(_power(mean), layout.edges, axis=1).astype(float), TINY)
    parts = deviation.view(np.float32)
    square = np.einsum("lpk,lpk->lk", parts, parts)
    deviation *= np.conj(mean)[:, None, :]
    sums = np.add.reduceat(deviation, layout.edges, axis=2)
    return square[:, ::2] + square[:, 1::2], mean, weight, sums / weight[:, None, :]


def _turns(angle: Float[np.ndarray, "lane period"], count: int) -> np.ndarray:
    """e^(−j k angle) for k = 1 … `count`, as products of a few exponentials for speed."""
    step = 1 << ((count - 1).bit_length() + 1) // 2
    fine = np.exp(-1j * angle[..., None] * np.arange(1, step + 1)).astype(np.complex64)
    coarse = np.exp(-1j * angle[..., None] * np.arange(0, count, step)).astype(np.complex64)
    product = coarse[..., :, None] * fine[..., None, :]
    return product.reshape(*angle.shape, -1)[..., :count]


def _without(deviation: np.ndarray, polynomials: np.ndarray) -> np.ndarray:
    """Deviations without their projection on the polynomials; changed in place."""
    # Real and imaginary parts side by side: the real part of a product is the product of these.
    real, basis = deviation.view(np.float32), polynomials.view(np.float32)
    # One recording after the other, because such small products start no threads.
    for own in real:
        own -= (own @ basis.T) @ basis
    return deviation
