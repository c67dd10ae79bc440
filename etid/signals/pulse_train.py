"""Positions of the pulses of a record, their spacing, and the lag between two records.

Two records with separate triggers may start hundreds of samples apart. `lags_of` finds this lag.
Whole samples are removed before a fit. The fit then estimates the rest, about half a sample, with
the elements. This module uses NumPy only, because it runs before anything is fitted.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.fft
from jaxtyping import Complex, Float, Int

from etid.signals.harmonics import fast_length

COARSE = 512  # samples per period after averaging; enough to find the pulses
HALF = 0.5  # a pulse begins and ends at this fraction of the highest sample
RINGING = 0.02  # of a period; a shorter gap does not split a pulse in two
EVEN = 0.05  # relative range of the spacings up to which the pulses have one rate
RATE = 2e-3  # relative error of pulse_rate; a larger one is a wrong number, not an inexact clock
CLOCK = 3e-4  # relative error of a clock; a larger one is reported
# [samples] The rate is counted if the last pulse is farther from its nominal place than this. At
# 20 dB noise moves it by 0.2. At 60 dB and dry skin, one sample would let aliases leak into the
# harmonics, by two standard errors.
SHIFTED = 0.5
EDGE = 5e-6  # [s] time over which the rise of edges is measured, at any sample rate
LAGS = 400  # [samples] largest lag, late or early
PART = 1 / 4  # largest lag as a fraction of the period
AROUND = 1 / 8  # fraction of a period before and after an edge that is correlated
DELAYED = 1.0  # [samples] a fit takes smaller lags as they are: it fits delays, and skin delays too
NEAR = 16  # [samples] largest lag that an aligned record may still have
FINE = 0.5  # [samples] grid of the search for that lag


@dataclasses.dataclass(frozen=True)
class PulseTrain:
    """The pulses of a record.

    Attributes:
        edges: Starts of the pulses, or their ends if there are more ends [samples].
        spacing: Spacing of the pulses [samples]; None for a single pulse or uneven spacing.
        size: Length of the record [samples].
        sample_rate: Samples per second [Hz], as the recording says.
        pulse_rate: Pulses per second [Hz], as the recording says.
    """

    edges: Int[np.ndarray, " pulse"]
    spacing: float | None
    size: int
    sample_rate: float
    pulse_rate: float

    @property
    def counted(self) -> float:
        """Pulse rate [Hz] as measured by the clock of the converter.

        A clock error of 50 ppm moves the last of 30 periods by five samples. Averaging would then
        remove the harmonics above the 600th.

        Returns:
            The nominal rate of the recording if the last pulse is less than half a sample from its
            nominal place, or if the spacing contradicts the rates; otherwise the counted rate.
        """
        nominal = self.sample_rate / self.pulse_rate
        if self.spacing is None or abs(self.spacing / nominal - 1) > RATE:
            return self.pulse_rate
        if abs(self.spacing - nominal) * (self.edges.size - 1) < SHIFTED:
            return self.pulse_rate
        return self.sample_rate / self.spacing

    @property
    def mismatch(self) -> str:
        """How the spacing of the pulses contradicts the rates; empty if it does not."""
        rate, pulse_rate = self.sample_rate, self.pulse_rate
        nominal = rate / pulse_rate
        said = f"sample_rate / pulse_rate is {nominal:.6g}"
        if self.spacing is not None:
            if abs(self.spacing / nominal - 1) <= RATE:
                return ""
            return (
                f"The pulses are {self.spacing:.6g} samples apart, but {said}. That would be right "
                f"with sample_rate = {_counted(pulse_rate * self.spacing)} Hz, or with "
                f"pulse_rate = {_counted(rate / self.spacing)} Hz."
            )
        if self.edges.size != 1:
            return ""
        apart = max(self.edges[0], self.size - self.edges[0])
        if apart <= (1 + EVEN) * nominal:
            return ""
        return (
            f"There is one pulse and none in the {apart} samples beside it, but {said}. That would "
            f"be right with sample_rate > {_counted(pulse_rate * apart)} Hz, or with "
            f"pulse_rate < {_counted(rate / apart)} Hz."
        )


def _counted(rate: float) -> str:
    """A rate with four digits: pulses thousands of samples apart determine no more."""
    return f"{float(f'{rate:.4g}'):.9g}"


@np.errstate(over="ignore", invalid="ignore")  # of a damaged file
def find_pulses(v: Float[np.ndarray, " time"], sample_rate: float, pulse_rate: float) -> PulseTrain:
    """Find the pulses of an unloaded record.

    The record is averaged over a five-hundredth of a period. A pulse begins and ends where the
    average crosses half of its highest value, such as 25 V of 50 V. Noise at 20 dB (1 V), hum and
    drift do not reach this level.

    Args:
        v: Unloaded voltage [V].
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz]; may be wrong by an order of magnitude.
    """
    period = sample_rate / pulse_rate
    step = max(1, int(period / COARSE))
    whole = v.size // step * step
    coarse = np.add.reduceat(v[:whole], np.arange(0, whole, step)) / step if whole else v[:0]
    if coarse.size == 0 or not np.isfinite(coarse).all():
        return PulseTrain(np.zeros(0, int), None, v.size, sample_rate, pulse_rate)
    coarse = coarse - coarse.mean()
    top = coarse[np.argmax(np.abs(coarse))]
    above = coarse / top > HALF if top != 0 else np.zeros(coarse.size, bool)
    turns = np.flatnonzero(np.diff(above)) + 1
    begins, ends = turns[above[turns]], turns[~above[turns]]
    apart = max(1.0, RINGING * period / step)
    begins = begins[np.diff(begins, prepend=-np.inf) > apart]
    ends = ends[np.diff(ends, append=np.inf) > apart]
    # A pulse that is cut by an end of the record has only one edge.
    edges = (begins if begins.size >= ends.size else ends) * step
    whole = begins.size > 0 and ends.size > 0  # a record without both has no pulse
    found = PulseTrain(edges if whole else edges[:0], None, v.size, sample_rate, pulse_rate)
    gaps = np.diff(found.edges)
    if gaps.size == 0 or np.ptp(gaps) > EVEN * gaps.mean():
        return found
    return dataclasses.replace(found, spacing=_spacing(v, found, step))


def _spacing(v: Float[np.ndarray, " time"], found: PulseTrain, step: int) -> float:
    """Spacing of the pulses [samples], from the first and the last edge."""
    first, last = int(found.edges[0]), int(found.edges[-1])
    off = 2 * step + 2  # [samples] error of the coarse edges
    rise = rise_time(found.sample_rate)
    room = min(first, v.size - last - rise)
    width = min(8 * step + 4 * rise, (last - first) // 4)
    before = max(0, min(width, room - off))
    after = max(1, min(width, v.size - last - off - rise))
    template = rises(v[first - before : first + after + rise], rise)
    start = max(0, last - before - off)
    where = rises(v[start : last + after + off + rise], rise)
    if where.size < template.size:  # the last edge is at the end of the record
        return (last - first) / (found.edges.size - 1)
    # Least squares of the difference. The correlation alone is biased towards the steepest part of
    # a slow edge.
    power = np.convolve(where**2, np.ones(template.size), "valid")
    lag = highest(np.correlate(where, template, "valid") - power / 2)
    return (start + lag - (first - before)) / (found.edges.size - 1)


def rise_time(sample_rate: float) -> int:
    """Number of samples over which the rise of edges is measured."""
    return max(1, round(EDGE * sample_rate))


def rises(v: Float[np.ndarray, " time"], rise: int) -> Float[np.ndarray, " sample"]:
    """Rise of `v` over `rise` samples; edges exceed noise and droop at any sample rate."""
    return v[rise:] - v[:-rise]


def highest(correlation: Float[np.ndarray, " lag"]) -> float:
    """Position of the maximum [samples], interpolated by a parabola."""
    top = int(np.argmax(correlation))
    if not 0 < top < correlation.size - 1:
        return float(top)
    left, middle, right = correlation[top - 1 : top + 2]
    bend = left - 2 * middle + right
    return top if bend == 0 else top + 0.5 * float((left - right) / bend)


# --- Lag between two records ----------------------------------------------------------------------


def lags_of(
    records: Float[np.ndarray, "recording 2 time"], trains: Sequence[PulseTrain]
) -> list[float | None]:
    """Lag of `v_out` behind `v_th` of each recording, from the edges of one pulse.

    The load smooths the edges. The lag found is therefore up to one sample too large.

    Args:
        records: Unloaded and loaded voltage [V] of recordings with equal rates.
        trains: The pulses of each `v_th`.

    Returns:
        The lags [samples]; None if both records have opposite polarity or are too far apart.
    """
    parts = [_edges(both[0], both[1], train) for both, train in zip(records, trains, strict=True)]
    size = fast_length(max(where.size for where, _ in parts))
    # Single precision suffices, and its transforms take a fourth of the time.
    both = np.zeros((len(parts), 2, size), np.float32)
    for row, (where, template) in enumerate(parts):
        both[row, 0, : where.size], both[row, 1, : template.size] = where, template
    transforms = np.asarray(scipy.fft.rfft(both))
    products = scipy.fft.irfft(transforms[:, 0] * np.conj(transforms[:, 1]), size)
    return [_lag(*parts) for parts in zip(np.asarray(products), trains, strict=True)]


def _period(train: PulseTrain) -> float:
    return train.spacing or train.sample_rate / train.pulse_rate


def _edges(
    v_th: Float[np.ndarray, " time"], v_out: Float[np.ndarray, " time"], train: PulseTrain
) -> tuple[Float[np.ndarray, " place"], Float[np.ndarray, " template"]]:
    """Rises of `v_out` half a period around an edge, and rises of `v_th` at the edge."""
    period = _period(train)
    rise, edges = rise_time(train.sample_rate), train.edges[train.edges < v_th.size]
    edge = edges[edges.size // 2] if edges.size else np.argmax(np.abs(rises(v_th, rise)))
    first = max(0, int(edge) - int(AROUND * period))
    template = rises(v_th[first : int(edge) + int(AROUND * period) + rise], rise)
    reach = int(period / 2)
    where = np.zeros(template.size + 2 * reach)
    start = max(0, first - reach)
    found = rises(v_out[start : first + reach + template.size + rise], rise)
    begin = start - (first - reach)
    where[begin : begin + found.size] = found
    return where, template


def _lag(correlation: Float[np.ndarray, " place"], train: PulseTrain) -> float | None:
    """The lag with the highest correlation; None if it is too large or the polarity is wrong."""
    period = _period(train)
    reach = int(period / 2)
    correlation = correlation[: 2 * reach + 1]
    if correlation.max() <= -correlation.min():
        return None
    lag = highest(correlation) - reach
    return lag if abs(lag) <= min(LAGS, PART * period) else None


def whole_lag(lag: float) -> int:
    """Lag to be removed [samples]; 0 if a fit takes the lag as it is."""
    return 0 if abs(lag) <= DELAYED else round(lag)


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
    """Lag of a record behind its prediction [samples], between −`NEAR` and `NEAR`.

    Args:
        predicted: Fourier coefficients of the prediction.
        measured: Fourier coefficients of the record.
        weight: Weight of each coefficient, such as the reciprocal of its variance.
        turn: Phase by which a delay of one sample turns each coefficient [rad].
    """
    turned = np.conj(predicted) * measured * weight * np.exp(-1j * NEAR * turn)
    step, correlation = np.exp(1j * FINE * turn), []
    for _ in range(round(2 * NEAR / FINE) + 1):
        correlation.append(turned.sum().real)
        turned = turned * step
    return FINE * highest(np.array(correlation)) - NEAR
