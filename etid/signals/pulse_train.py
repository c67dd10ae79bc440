"""Positions of the pulses of a record, their spacing, and the lag between two records.

Two records with separate triggers may start hundreds of samples apart. `lags_of` finds this lag.
Whole samples are removed before a fit. The fit then estimates the rest, about half a sample, with
the elements. This module uses NumPy only, because it runs before anything is fitted.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

EVEN = 0.05  # relative range of the spacings up to which the pulses have one rate
# Drift of V_out against V_th from the first pulse to the last, above which clocks differ; of both,
# the larger counts. 0.33 µs from one pulse to the next make R_s of dry skin 1.5 % wrong. Aliases of
# edges that are shorter than a sample look like 0.05 samples.
DRIFT, DRIFT_SAMPLES = 0.5e-6, 0.1  # [s], [samples]
SURE = 5.0  # that drift must have so many standard errors, or noise hides it
STEADY = 0.25  # part of the drift by which a pulse in the middle may be off its place
TINY = 1e-300  # replaces the power of an edge of zeros
RATE = 2e-3  # relative error of pulse_rate; a larger one is a wrong number, not an inexact clock
# Relative to the sample rate. Below the first, the drift of the mean is larger than a delay; above
# the second, aliases are a twentieth of the signal.
PHASES = 0.005, 0.05


@dataclasses.dataclass(frozen=True)
class PulseTrain:
    """The pulses of a record.

    Attributes:
        edges: Starts of the pulses, or their ends if there are more ends [samples].
        spacing: Spacing of the pulses [samples]; None for a single pulse, uneven spacing, or
            pulses of different shapes, such as the crests of a multisine.
        size: Length of the record [samples].
        sample_rate: Samples per second [Hz], as the recording says.
        pulse_rate: Pulses per second [Hz], as the recording says.
    """

    edges: Int[np.ndarray, " pulse"]
    spacing: float | None
    size: int
    sample_rate: float
    pulse_rate: float

    @functools.cached_property
    def counted(self) -> float:
        """Pulse rate [Hz] as measured by the clock of the converter.

        A clock error of 50 ppm moves the last of 30 periods by five samples. Averaging would then
        remove the harmonics above the 600th. At 20 dB noise moves it by 0.2 samples. At 60 dB and
        dry skin, one sample would let aliases leak into the harmonics, by two standard errors.

        Returns:
            The nominal rate of the recording if the last pulse is less than half a sample from its
            nominal place, or if the spacing contradicts the rates; otherwise the counted rate.
        """
        nominal = self.sample_rate / self.pulse_rate
        if self.spacing is None or abs(self.spacing / nominal - 1) > RATE:
            return self.pulse_rate
        if abs(self.spacing - nominal) * (self.edges.size - 1) < 0.5:
            return self.pulse_rate
        return self.sample_rate / self.spacing

    @functools.cached_property
    def mismatch(self) -> str:
        """How the spacing of the pulses contradicts the rates; empty if it does not."""
        rate, pulse_rate = self.sample_rate, self.pulse_rate
        nominal = rate / pulse_rate
        said = f"sample_rate / pulse_rate is {nominal:.6g}"
        rest = max(self.edges[0], self.size - self.edges[-1]) if self.edges.size else 0
        if self.spacing is not None:
            # Two crests of a chirp or a pair of pulses, with room for a third, are no train.
            is_pair = self.edges.size == 2 and rest > (1 + EVEN) * self.spacing
            if abs(self.spacing / nominal - 1) <= RATE or is_pair:
                return ""
            is_period = abs(pulse_rate * rate / self.spacing - 1) <= RATE
            slip = " pulse_rate is a period in seconds; give pulses per second." * is_period
            return (
                f"The pulses are {self.spacing:.6g} samples apart, but {said}. That would be right "
                f"with sample_rate = {_counted(pulse_rate * self.spacing)} Hz, or with "
                f"pulse_rate = {_counted(rate / self.spacing)} Hz.{slip}"
            )
        if self.edges.size != 1:
            return ""
        if rest <= (1 + EVEN) * nominal:
            return ""
        return (
            f"There is one pulse and none in the {rest} samples beside it, but {said}. That would "
            f"be right with sample_rate > {_counted(pulse_rate * rest)} Hz, or with "
            f"pulse_rate < {_counted(rate / rest)} Hz."
        )


def _counted(rate: float) -> str:
    """A rate with four digits: pulses thousands of samples apart determine no more."""
    return f"{float(f'{rate:.4g}'):.9g}"


def find_pulses(v: Float[np.ndarray, " time"], sample_rate: float, pulse_rate: float) -> PulseTrain:
    """The pulses of an unloaded record, as `pulse_trains` finds them."""
    (train,) = pulse_trains(v[None], sample_rate, pulse_rate)
    return train


@np.errstate(over="ignore", invalid="ignore")  # of a damaged file
def pulse_trains(
    records: Float[np.ndarray, "record time"], sample_rate: float, pulse_rate: float
) -> list[PulseTrain]:
    """Find the pulses of unloaded records.

    Each record is averaged over a five-hundredth of a period. A pulse begins and ends where the
    average crosses half of its highest value, such as 25 V of 50 V. Noise at 20 dB (1 V), hum and
    drift do not reach this level.
    """
    size, period = records.shape[1], sample_rate / pulse_rate
    if period > size:
        # Both rates may be wrong: pulse_rate may be a period.
        period = min(float(size), sample_rate * pulse_rate)
    step = _step(period)
    number = size // step
    coarse = records[:, : number * step].reshape(len(records), number, step)
    coarse = np.einsum("rps->rp", coarse) / step
    nothing = PulseTrain(np.zeros(0, int), None, size, sample_rate, pulse_rate)
    trains = [nothing] * len(records)
    usable = np.isfinite(coarse).all(1) & (number > 0)
    if not usable.any():
        return trains
    coarse = coarse[usable]
    coarse = coarse - coarse.mean(1, keepdims=True)
    top = np.take_along_axis(coarse, np.argmax(np.abs(coarse), axis=1)[:, None], axis=1)
    above = coarse / np.where(top != 0, top, 1.0) > np.where(top != 0, 0.5, np.inf)
    # The pulses of most records begin at the same places. These records are processed together.
    alike: dict[bytes, list[int]] = {}
    for row, key in enumerate(np.packbits(above, axis=1)):
        alike.setdefault(key.tobytes(), []).append(row)
    rows = np.flatnonzero(usable)
    for same in alike.values():
        edges = _edges_of(above[same[0]], period / step) * step
        gaps = np.diff(edges)
        even = gaps.size > 0 and np.ptp(gaps) <= EVEN * gaps.mean()
        several = rows[same]
        spacings: list[float | None] = [None] * len(same)
        if even:
            found = _spacings(records, several, edges, step, sample_rate)
            both = zip(found.tolist(), _continue_alike(coarse[same], edges, step), strict=True)
            spacings = [spacing if continues else None for spacing, continues in both]
        for row, spacing in zip(several, spacings, strict=True):
            trains[row] = PulseTrain(edges, spacing, size, sample_rate, pulse_rate)
    return trains


def _continue_alike(
    coarse: Float[np.ndarray, "record place"], edges: Int[np.ndarray, " pulse"], step: int
) -> Bool[np.ndarray, " record"]:
    """Whether records continue after the last pulse as after the first one, and before them.

    Of records that are not alike, the difference has twice the mean power of both, or more.
    """
    late = (int(edges[-1]) - int(edges[0])) // step
    first, last = coarse[:, :-late], coarse[:, late:]
    return np.var(last - first, axis=1) < 0.5 * (np.var(first, axis=1) + np.var(last, axis=1))


def _step(period: float) -> int:
    """Samples that are averaged to find the pulses, for this pulse period [samples]."""
    return max(1, int(period / 512))


def _room(step: int, rise: int) -> int:
    """Samples beside the coarse place of an edge that hold all of it."""
    return 8 * step + 4 * rise


def _edges_of(above: Bool[np.ndarray, " place"], period: float) -> Int[np.ndarray, " pulse"]:
    """Starts of the pulses, or their ends if there are more ends; none without a whole pulse."""
    turns = np.flatnonzero(np.diff(above)) + 1
    begins, ends = turns[above[turns]], turns[~above[turns]]
    gap = max(1.0, 0.02 * period)  # a shorter gap is ringing
    begins = begins[np.diff(begins, prepend=-np.inf) > gap]
    ends = ends[np.diff(ends, append=np.inf) > gap]
    if not begins.size or not ends.size:
        return begins[:0]
    # A pulse that is cut by an end of the record has only one edge.
    return begins if begins.size >= ends.size else ends


def _spacings(
    records: Float[np.ndarray, "record time"],
    rows: Int[np.ndarray, " row"],
    edges: Int[np.ndarray, " pulse"],
    step: int,
    sample_rate: float,
) -> Float[np.ndarray, " row"]:
    """Spacing of the pulses of some records [samples], from the first and the last edge."""
    first, last, size = int(edges[0]), int(edges[-1]), records.shape[1]
    off = 2 * step + 2  # [samples] error of the coarse edges
    rise = rise_time(sample_rate)
    room = min(first, size - last - rise)
    width = min(_room(step, rise), (last - first) // 4)
    before = max(0, min(width, room - off))
    after = max(1, min(width, size - last - off - rise))
    template = rises(records[rows, first - before : first + after + rise], rise)
    start = max(0, last - before - off)
    where = rises(records[rows, start : last + after + off + rise], rise)
    between = edges.size - 1
    if where.shape[1] < template.shape[1]:  # the last edge is at the end of the record
        return np.full(rows.size, (last - first) / between)
    lag = highest(_compared(template, where)[1])
    return (start + lag - (first - before)) / between


def _compared(
    template: Float[np.ndarray, "record part"], where: Float[np.ndarray, "record time"]
) -> tuple[Float[np.ndarray, "record lag part"], Float[np.ndarray, "record lag"]]:
    """The parts of records as long as a template, and how much they are like it.

    That is by least squares of the difference. The correlation alone is biased towards the steepest
    part of a slow edge.
    """
    parts = np.lib.stride_tricks.sliding_window_view(where, template.shape[1], axis=1)
    power = np.einsum("rls,rls->rl", parts, parts)
    return parts, np.einsum("rls,rs->rl", parts, template) - power / 2


def rise_time(sample_rate: float) -> int:
    """Number of samples over which the rise of edges is measured, 5 µs at any sample rate."""
    return max(1, round(5e-6 * sample_rate))


def rises(v: Float[np.ndarray, "*record time"], rise: int) -> Float[np.ndarray, "*record sample"]:
    """Rise of `v` over `rise` samples; edges exceed noise and droop at any sample rate."""
    return v[..., rise:] - v[..., :-rise]


def highest(correlation: Float[np.ndarray, "*record lag"]) -> Float[np.ndarray, "*record"]:
    """Position of the maximum [samples], interpolated by a parabola."""
    top = np.argmax(correlation, axis=-1)
    last = correlation.shape[-1] - 1
    at = np.clip(top[..., None] + np.arange(-1, 2), 0, last)
    left, middle, right = np.moveaxis(np.take_along_axis(correlation, at, axis=-1), -1, 0)
    bend = left - 2 * middle + right
    inside = (top > 0) & (top < last) & (bend != 0)
    beside = np.where(inside, 0.5 * (left - right) / np.where(inside, bend, 1.0), 0.0)
    return np.asarray(top + beside)


# --- Drift of one record against the other --------------------------------------------------------


def largest_drift(sample_rate: float) -> float:
    """Drift above which clocks differ [samples]."""
    return max(DRIFT * sample_rate, DRIFT_SAMPLES)


def clocks_apart(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    trains: Sequence[PulseTrain],
    lags: Float[np.ndarray, " recording"],
) -> Float[np.ndarray, " recording"]:
    """How far `v_out` drifts from `v_th` between the first and the last pulse [samples].

    Three pulses are compared, the first, one in the middle and the last, of those that have room on
    both sides. A drift is 0 with fewer pulses, if it is small in all recordings that are alike, if
    noise hides it, or if it is not steady: of a lost sample or a disturbed period.

    Args:
        records: Unloaded and loaded voltage [V] of recordings with equal rates.
        sigma: Standard deviations of their noise [V].
        trains: The pulses of each `v_th`.
        lags: Lags of `v_out` [samples], as `lags_of` finds them; NaN if they are not known.
    """
    apart, alike = np.zeros(len(records)), dict[tuple[bytes, int], list[int]]()
    for row, (train, lag) in enumerate(zip(trains, lags.tolist(), strict=True)):
        if train.spacing is not None and math.isfinite(lag):
            alike.setdefault((train.edges.tobytes(), round(lag)), []).append(row)
    for (_, late), rows in alike.items():
        apart[rows] = _drifts(records, sigma, rows, trains[rows[0]], late)
    return apart


def _drifts(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    rows: list[int],
    train: PulseTrain,
    late: int,
) -> Float[np.ndarray, " row"]:
    """`clocks_apart` of recordings with the same edges and the same lag in whole samples."""
    rise, step = rise_time(train.sample_rate), _step(train.sample_rate / train.pulse_rate)
    width, off = _room(step, rise), 2 * step + 2
    room = train.edges + np.array([[min(late, 0)], [max(late, 0)]])
    least = step + 1 + off  # an edge is within a step before its coarse place
    fits = (room[0] >= least) & (room[1] + width + off + rise <= records.shape[2])
    edges = train.edges[fits]
    if edges.size < 3:
        return np.zeros(len(rows))
    first, middle, last = edges[[0, edges.size // 2, -1]].tolist()
    window = int(min(width, room[0][fits][0] - off)), width

    def drift(later: int) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
        (of_th, error_th), (of_out, error_out) = (
            _moved(records[:, which], rows, (first + by, later + by), window, off, rise)
            for which, by in enumerate((0, late))
        )
        return of_out - of_th, np.hypot(error_th * sigma[rows, 0], error_out * sigma[rows, 1])

    whole, error = drift(last)
    every = (train.edges[-1] - train.edges[0]) / (last - first) * whole
    largest = largest_drift(train.sample_rate)
    if (np.abs(every) <= largest).all():  # nearly all recordings
        return np.zeros(len(rows))
    half, _ = drift(middle)
    steady = np.abs(half - whole * (middle - first) / (last - first)) < STEADY * np.abs(whole)
    return np.where(steady & (SURE * error < largest), every, 0.0)


def _moved(
    v: Float[np.ndarray, "record time"],
    rows: Sequence[int],
    at: tuple[int, int],
    window: tuple[int, int],
    off: int,
    rise: int,
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
    """How much later than expected the second of two edges is [samples], up to `off`.

    The second result is the standard error for white noise of standard deviation 1.
    """
    (first, later), (before, after) = at, window
    template = rises(v[rows, first - before : first + after + rise], rise)
    where = rises(v[rows, later - before - off : later + after + off + rise], rise)
    parts, likeness = _compared(template, where)
    top = np.argmax(likeness, axis=1)
    lag, error = _within_a_sample(template, parts[np.arange(len(rows)), top], rise)
    return top - off + lag, error


def _within_a_sample(
    one: Float[np.ndarray, "record time"], other: Float[np.ndarray, "record time"], rise: int
) -> tuple[Float[np.ndarray, " record"], Float[np.ndarray, " record"]]:
    """Lag of the other of two records that differ by less than a sample, and by a factor.

    It is that of least squares. Aliases of a steep edge would move it by a tenth of a sample, so
    that only frequencies below a quarter of the sample rate count. The second result is the lag's
    standard error if both are rises of records with white noise of standard deviation 1.
    """
    count = 1 + one.shape[1] // 4
    turn = 2j * np.pi * np.fft.rfftfreq(one.shape[1])[:count]
    aim, turned = (np.fft.rfft(of)[:, :count] for of in (one, other))
    size, power = (np.square(np.abs(of)) for of in (turned, turn * turned))
    lag, total = np.zeros(len(one)), np.maximum(power.sum(1), TINY)
    for _ in range(3):  # of half a sample, the third step is below 1e-4 samples
        moved = turned * np.exp(turn * lag[:, None])
        factor = (np.conj(moved) * aim).real.sum(1) / np.maximum(size.sum(1), TINY)
        step = (np.conj(turn * moved) * aim).real.sum(1) / total
        lag = np.clip(lag + step / np.where(factor > 0.1, factor, np.inf), -1.0, 1.0)
    noise = one.shape[1] * np.square(np.abs(np.exp(turn * rise) - 1))
    return lag, np.sqrt((power * noise).sum(1)) / total


# --- Lag between two records ----------------------------------------------------------------------


def lags_of(
    records: Float[np.ndarray, "recording 2 time"], trains: Sequence[PulseTrain]
) -> Float[np.ndarray, " recording"]:
    """Lag of `v_out` behind `v_th` of each recording, from the edges of one period.

    The load smooths the edges. The lag found is therefore up to one sample too large.

    Args:
        records: Unloaded and loaded voltage [V] of recordings with equal rates.
        trains: The pulses of each `v_th`.

    Returns:
        The lags [samples]; NaN if both records have opposite polarity, are more than 400 samples
        or a quarter of a period apart, or are shorter than an edge.
    """
    lags = np.full(len(records), np.nan)
    if not trains or records.shape[2] <= rise_time(trains[0].sample_rate):
        return lags
    for window, rows in _windows(records[:, 0], trains).items():
        found = _lags(records, rows, window)
        lags[rows] = np.where(np.abs(found) <= window.largest, found, np.nan)
    return lags


class _Window(NamedTuple):
    """Which samples are correlated.

    Attributes:
        first: First sample of the template.
        last: Sample after the template, with the rise.
        reach: Largest lag that is searched [samples].
        rise: Samples over which edges rise.
        largest: Largest lag that is accepted [samples].
    """

    first: int
    last: int
    reach: int
    rise: int
    largest: int


def _windows(
    records: Float[np.ndarray, "record time"], trains: Sequence[PulseTrain]
) -> dict[_Window, list[int]]:
    """The records of each window, of unloaded records with equal rates.

    A window holds the pulse in the middle of a record, and half a period on both sides. With only
    one edge of a pulse, the other edge would look like this one with the wrong polarity. Of a whole
    period, the noise beside the pulse would hide it at 10 dB.
    """
    size, rise = records.shape[1], rise_time(trains[0].sample_rate)
    alike: dict[tuple[int, int, int, int], list[int]] = {}
    for row, train in enumerate(trains):
        period = train.spacing or train.sample_rate / train.pulse_rate
        edges = train.edges[train.edges < size]
        if not edges.size:
            edges = np.array([np.argmax(np.abs(rises(records[row], rise)))])
        reach = int(period / 2), min(400, int(period / 4))
        alike.setdefault((int(edges[edges.size // 2]), _step(period), *reach), []).append(row)
    windows: dict[_Window, list[int]] = {}
    for (edge, step, around, largest), rows in alike.items():
        begin = max(0, edge - around)
        number = (min(edge + around, size) - begin) // step
        coarse = records[rows, begin : begin + number * step].reshape(len(rows), number, step)
        coarse = np.einsum("rps->rp", coarse)
        coarse = np.abs(coarse - coarse.mean(1, keepdims=True))
        high = ~(coarse < 0.5 * coarse.max(1, keepdims=True))
        firsts, lasts = high.argmax(1), number - high[:, ::-1].argmax(1)
        beside = _room(step, rise)
        for row, first, last in zip(rows, firsts.tolist(), lasts.tolist(), strict=True):
            of = max(0, begin + step * first - beside), min(begin + step * last + beside, size)
            windows.setdefault(_Window(*of, around, rise, largest), []).append(row)
    return windows


def _lags(
    records: Float[np.ndarray, "recording 2 time"], rows: Sequence[int], window: _Window
) -> Float[np.ndarray, " row"]:
    """The lags with the highest correlation; infinite if the polarity is wrong."""
    first, last, reach, rise, largest = window
    template = rises(records[rows, 0, first:last], rise)
    begin = first - reach
    start = max(0, begin)
    searched = rises(records[rows, 1, start : last + reach], rise)
    size = fast_length(template.shape[1] + 2 * reach)
    both = np.zeros((len(rows), 2, size))
    both[:, 0, start - begin : start - begin + searched.shape[1]] = searched
    both[:, 1, : template.shape[1]] = template
    transforms = np.fft.rfft(both)
    products = np.fft.irfft(transforms[:, 0] * np.conj(transforms[:, 1]), size)
    correlation = products[:, : 2 * reach + 1]
    lag = highest(correlation) - reach
    # At half a period, pulses that last half of it have the other polarity.
    accepted = correlation[:, reach - largest : reach + largest + 1]
    return np.where(accepted.max(1) > -accepted.min(1), lag, np.inf)


@functools.cache
def fast_length(least: int) -> int:
    """The smallest length 2^i 3^j 5^k that is not below `least`: its Fourier transform is fast."""
    odd = (3**j * 5**k for j in range(30) for k in range(20))
    return min(of << (-(-least // of) - 1).bit_length() for of in odd)


def whole_lag(lag: float) -> int:
    """Lag to be removed [samples]; 0 up to one sample: a fit finds it, and skin delays too."""
    return 0 if abs(lag) <= 1 else round(lag)


def shifted(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], late: int
) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
    """Both records, cut to their overlap; `late` is the lag of `v_out` in whole samples."""
    if late < 0:
        return v_th[-late:], v_out[:late]
    return v_th[: v_th.size - late], v_out[late:]


def rest(
    predicted: Complex[np.ndarray, " frequency"],
    measured: Complex[np.ndarray, " frequency"],
    weight: Float[np.ndarray, " frequency"],
    turn: Float[np.ndarray, " frequency"],
) -> float:
    """Lag of an aligned record behind its prediction [samples], between −16 and 16.

    Args:
        predicted: Fourier coefficients of the prediction.
        measured: Fourier coefficients of the record.
        weight: Weight of each coefficient, such as the reciprocal of its variance.
        turn: Phase by which a delay of one sample turns each coefficient [rad].
    """
    largest, grid = 16, 0.5
    turned = np.conj(predicted) * measured * weight * np.exp(-1j * largest * turn)
    step, correlation = np.exp(1j * grid * turn), []
    for _ in range(round(2 * largest / grid) + 1):
        correlation.append(turned.sum().real)
        turned = turned * step
    return grid * float(highest(np.array(correlation))) - largest
