"""Faults of recordings of equal length and rates that can be detected before a fit, and forbid it.

A row is a recording; an axis of length 2 holds `v_th`, or the measured current, and `v_out`.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.signals.clipping import is_clipped, is_command, is_limited, may_be_clipped, may_be_limited
from etid.signals.filtering import TAPS
from etid.signals.lags import shifted, whole_lag
from etid.signals.pulse_train import rise_time

if TYPE_CHECKING:
    from etid.recordings.inspection import Inspection

_Rows = Int[np.ndarray, " row"]
_Holds = Bool[np.ndarray, " row"]
SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit

SEAM = 3  # samples on each side of the joint between two periods
BY_CHANCE = 4.0  # [standard deviations] largest difference that noise makes


def part(
    records: Float[np.ndarray, "recording 2 time"], rows: Sequence[int] | np.ndarray
) -> Float[np.ndarray, "row 2 time"]:
    """Some rows of records; no copy if these are all."""
    return records if len(rows) == len(records) else records[np.asarray(rows)]


def flat(
    spans: Float[np.ndarray, "recording 2"],
    covariance: Float[np.ndarray, "recording 2 2"],
    sigma: Float[np.ndarray, "recording 2"],
) -> Bool[np.ndarray, "recording 2"]:
    """Whether records carry no signal: eight standard deviations span them.

    Noise spans more in a long record, but its variance is then known better.
    """
    noise = np.diagonal(covariance, axis1=1, axis2=2) <= 1.2 * sigma**2
    return (spans <= 8 * sigma) | noise | (spans == 0)


def is_plausible(voltage: float, current: float) -> bool:
    """Whether the peak-to-peak v_out [V] and current [A] are those of a load at an electrode.

    Stimulators of nerves and skin stay below 0.1 A and 500 V in each direction. Electrodes in
    saline have 100 Ω, patches of membrane in a pipette 10 GΩ.
    """
    return bool(current <= 0.25 and voltage <= 2e3 and 1.0 <= voltage / current <= 1e12)


def saturated(
    records: Float[np.ndarray, "recording 2 time"],
    limits: Float[np.ndarray, "recording 2 limit"],
    step: Float[np.ndarray, "recording 2"],
    adc_range: Float[np.ndarray, "recording 2 limit"],
) -> Bool[np.ndarray, "recording 2"]:
    """Whether samples are at a limit of the converter, or at a rail of unknown place.

    Args:
        records: The records as they were recorded.
        limits: Their smallest and largest samples.
        step: Steps of their converters; 0 if unknown.
        adc_range: Ranges of their converters; NaN if unknown.
    """
    known = np.isfinite(adc_range).all(-1)
    low, high = np.moveaxis(adc_range, -1, 0)
    found = known & ((limits[..., 0] <= low + step / 2) | (limits[..., 1] >= high - step / 2))
    if not known.all():
        for at in map(tuple, np.argwhere(~known & may_be_clipped(records, limits))):
            found[at] = is_clipped(records[at], float(step[at]))
    return found


def held(
    sigma: Float[np.ndarray, "recording"],
    step: Float[np.ndarray, "recording"],
    span: Float[np.ndarray, "recording"],
) -> Bool[np.ndarray, "recording"]:
    """`is_command` of measured currents: a source that holds its current shows a flat top."""
    of = zip(sigma.tolist(), step.tolist(), span.tolist(), strict=True)
    return np.array([is_command(*one) for one in of], bool)


def limited(
    records: Float[np.ndarray, "recording 2 time"],
    limits: Float[np.ndarray, "recording limit"],
    unit: Float[np.ndarray, " recording"],
    lags: Float[np.ndarray, " recording"],
    sample_rate: float,
) -> Bool[np.ndarray, " recording"]:
    """Whether v_out stays at a level while v_th moves.

    Args:
        records: The records as they were recorded.
        limits: Smallest and largest sample of `v_out`.
        unit: Standard deviation of the noise of `v_out`, or its converter step if this is larger.
        lags: Lags of `v_out` [samples]; NaN where they are not known.
        sample_rate: Sampling rate [Hz].
    """
    late = np.where(np.isfinite(lags), np.where(np.abs(lags) <= 1, 0.0, lags), np.nan)
    found = (unit > 0) & np.isfinite(late)
    at = np.flatnonzero(found & (late == 0))
    if at.size:
        v_out = records[:, 1] if at.size == len(records) else records[at, 1]
        found[at] = may_be_limited(v_out, limits[at], unit[at], sample_rate)
    for row in np.flatnonzero(found):
        v_th, v_out = shifted(records[row, 0], records[row, 1], whole_lag(float(lags[row])))
        found[row] = is_limited(v_th, v_out, float(unit[row]), sample_rate)
    return found


def unconnected(
    records: Float[np.ndarray, "recording 2 time"],
    covariance: Float[np.ndarray, "recording 2 2"],
    sigma: Float[np.ndarray, "recording 2"],
    lags: Float[np.ndarray, " recording"],
) -> Bool[np.ndarray, " recording"]:
    """Whether v_out equals v_th, except for noise, an offset and a delay below one sample."""
    variance, size = np.square(sigma).sum(1), records.shape[2]
    whole = np.array([whole_lag(lag) if math.isfinite(lag) else 0 for lag in lags.tolist()])
    covariance = covariance.copy()
    for row in np.flatnonzero(whole):
        both = shifted(records[row, 0], records[row, 1], int(whole[row]))
        covariance[row] = covariance_of(np.stack(both))
    power = covariance[:, 0, 0] - np.square(sigma[:, 0])
    found = power > 0  # else nothing but noise; or squares that are too small for a number
    usual = np.where(found, power, 1.0)
    limit = 1e-3 + BY_CHANCE * np.sqrt(variance / ((size - np.abs(whole)) * usual))
    found &= ~(np.abs(covariance[:, 0, 1] / usual - 1) > limit)
    for row in np.flatnonzero(found):
        both = shifted(records[row, 0], records[row, 1], int(whole[row]))
        x, y = (v - v.mean() for v in both)
        slope = np.gradient(x)
        rest = y - x
        rest = rest - slope * ((slope @ rest) / (slope @ slope))
        # A delay of 0.1 sample leaves up to 0.5 % of the signal at the edges.
        allowed = x.size * (1.5 * variance[row] + 5e-3**2 * power[row])
        found[row] = bool(rest @ rest <= allowed)
    return found


def covariance_of(v: Float[np.ndarray, "*recording 2 time"]) -> Float[np.ndarray, "*recording 2 2"]:
    """Covariance of both voltages of each recording."""
    mean, square = v.mean(-1), np.zeros((*v.shape[:-1], 2))
    for first in range(0, v.shape[-1], 8192):  # longer products start BLAS threads
        part = v[..., first : first + 8192]
        square += np.vecdot(part[..., :, None, :], part[..., None, :, :])
    return square / v.shape[-1] - mean[..., :, None] * mean[..., None, :]


def is_periodic(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    spacing: Float[np.ndarray, " recording"],
    periods: int,
    samples: int,
    cut: float,
    counted: Bool[np.ndarray, " recording"],
) -> Bool[np.ndarray, " recording"]:
    """Whether whole periods have no step from their end to their start.

    Args:
        records: The records.
        sigma: Standard deviations of their noise.
        spacing: Length of a period of each recording [samples].
        periods: Number of periods.
        samples: Number of their samples.
        cut: Largest error of the places at which the periods begin [samples].
        counted: Whether `spacing` is not the stated one: jitter of the last pulse looks like
            another pulse rate.
    """
    rest = np.maximum(np.abs(periods * spacing - samples), cut)
    found = _closes(records, sigma, rest, samples)
    on_edge = found & counted & ~_closes(records, sigma, np.ones(rest.size), samples)
    for row in np.flatnonzero(on_edge):
        found[row] = begins_again(records[row], sigma[row], float(spacing[row]), samples)
    return found


def _closes(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    rest: Float[np.ndarray, " recording"],
    samples: int,
) -> Bool[np.ndarray, " recording"]:
    """Whether records have no step from their end to their start.

    Their length differs by `rest` from `samples`, up to half a sample. This makes a step if the
    signal is steep at the joint.
    """
    joint = np.concatenate([records[..., samples - SEAM : samples], records[..., :SEAM]], axis=-1)
    step = rest[..., None] * np.abs(np.diff(joint)).max(-1)
    return np.asarray(~(step > BY_CHANCE * sigma).any(-1))


def begins_again(
    records: Float[np.ndarray, "2 time"],
    sigma: Float[np.ndarray, "2"],
    spacing: float,
    samples: int,
) -> bool:
    """Whether a record that begins on an edge has the same edge at the end of all its periods.

    If the clock of the pulses jitters, the end of the record does not continue at its start.
    """
    ends = np.arange(1, round(samples / spacing)) * spacing
    cuts = np.rint(ends).astype(int)
    around = np.concatenate([np.arange(samples - SEAM, samples), np.arange(SEAM)])
    inside = records[:, cuts[:, None] + np.arange(-SEAM, SEAM)]
    difference = np.abs(inside - records[:, None, around]).max(-1)
    step = np.abs(np.diff(inside)).max(-1)  # of a jitter of one sample
    # The samples beside a cut say within 0.2 samples what lies between samples.
    allowed = (np.abs(cuts - ends) + 0.2) * step + BY_CHANCE * sigma[:, None]
    return bool((difference <= allowed).all())


def refused(seen: "Inspection") -> list[str | None]:
    """Names of the verdicts that forbid any fit, the first that applies; None if it is allowed.

    Properties of a recording with one fault may have no meaning, and are not asked for.
    """
    names: list[str | None] = [None] * len(seen.recordings)
    left = np.arange(len(names))
    for name, applies in _VERDICTS.items():
        if left.size:
            found = applies(seen, left)
            for row in left[found]:
                names[row] = name
            left = left[~found]
    return names


def _too_short(seen: "Inspection", rows: _Rows) -> _Holds:
    shortest = max(SHORTEST, rise_time(seen.sample_rate) + 1)
    return np.full(rows.size, seen.recorded.shape[2] < shortest)


def _saturated(seen: "Inspection", rows: _Rows) -> _Holds:
    nothing = math.nan, math.nan
    ranges = [seen.recordings[row].adc_range or nothing for row in rows]
    adc_range = np.repeat(np.array(ranges)[:, None], 2, axis=1)
    if seen.has_current:
        adc_range[:, 0] = nothing  # it is one of volts
    records, limits = part(seen.recorded, rows), seen.recorded_limits[rows]
    sigma, step = seen.sigma[rows], seen.step[rows]
    found = saturated(records, limits, step, adc_range)
    found[:, 0] &= ~seen.held[rows]  # a command may rest at its limits
    if seen.has_current:
        found[:, 0] &= ~held(sigma[:, 0], step[:, 0], seen.spans[rows, 0])
        return np.asarray(found.any(1))  # a stimulator that holds its voltage is no fault
    unit = np.maximum(np.maximum(sigma, step), seen.coarse[rows])[:, 1]
    of = limits[:, 1], unit, seen.correlated[rows], seen.sample_rate
    return found.any(1) | limited(records, *of)


def _implausible(seen: "Inspection", rows: _Rows) -> _Holds:
    found = [seen.has_current and not is_plausible(*seen.spans[row, ::-1]) for row in rows]
    return np.array(found, bool)


def _unconnected(seen: "Inspection", rows: _Rows) -> _Holds:
    if seen.has_current:
        return np.zeros(rows.size, bool)
    of = seen.covariance[rows], seen.sigma[rows], seen.correlated[rows]
    return unconnected(part(seen.quiet, rows), *of)


def _misaligned(seen: "Inspection", rows: _Rows) -> _Holds:
    both = zip(seen.kept, seen.shifts, strict=True)
    hopeless = [kept is None and found is not None for kept, found in both]
    of_th, of_both, of_out = (seen.covariance[rows, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    wrong = np.array(hopeless, bool)[rows]
    if seen.has_current:
        return np.asarray(wrong | (of_both <= 0))  # a passive load takes power
    noise = np.square(seen.sigma[rows])
    power = np.stack([of_th, of_out], axis=1)  # with the noise
    by_chance = np.sqrt((4 * power * noise).sum(1) / seen.recorded.shape[2])
    more = of_out > 1.01 * of_th + BY_CHANCE * by_chance
    return np.asarray(wrong | more | np.isnan(seen.correlated[rows]))


_VERDICTS = {
    "too_short": _too_short,
    "nonfinite_samples": lambda seen, rows: (
        ~(np.isfinite(seen.limits[rows]).all((1, 2)) & np.isfinite(seen.spans[rows]).all(1))
    ),
    "flat": lambda seen, rows: seen.is_flat[rows].any(1),
    "saturated": _saturated,
    "wrong_unit": _implausible,
    "unconnected": _unconnected,
    "rate_mismatch": lambda seen, rows: seen.mismatch | seen.clocks_differ[rows],
    "misaligned": _misaligned,
}
