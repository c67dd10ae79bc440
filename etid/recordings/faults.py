"""Faults of recordings of equal length and rates that can be detected before a fit.

A row is a recording; an axis of length 2 holds `v_th`, or the measured current, and `v_out`.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from etid.signals.clipping import is_clipped, is_command, is_limited, may_be_clipped, may_be_limited
from etid.signals.lags import shifted, whole_lag

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
