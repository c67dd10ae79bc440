"""Positions of the pulses of a record, and their spacing.

This module uses NumPy only, because it runs before anything is fitted.
"""

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

EVEN = 0.05  # relative range of the spacings up to which the pulses have one rate
RATE = 2e-3  # relative error of pulse_rate; a larger one is a wrong number, not an inexact clock


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
    step = coarse_step(period)
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


def coarse_step(period: float) -> int:
    """Samples that are averaged to find the pulses, for this pulse period [samples]."""
    return max(1, int(period / 512))


def room_of(step: int, rise: int) -> int:
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
    width = min(room_of(step, rise), (last - first) // 4)
    before = max(0, min(width, room - off))
    after = max(1, min(width, size - last - off - rise))
    template = rises(records[rows, first - before : first + after + rise], rise)
    start = max(0, last - before - off)
    where = rises(records[rows, start : last + after + off + rise], rise)
    between = edges.size - 1
    if where.shape[1] < template.shape[1]:  # the last edge is at the end of the record
        return np.full(rows.size, (last - first) / between)
    lag = highest(likeness_of(template, where)[1])
    return (start + lag - (first - before)) / between


def likeness_of(
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
