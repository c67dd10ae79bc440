"""Recordings of equal length and equal rates, inspected together."""

import functools
import math
from collections.abc import Hashable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.recordings import faults
from etid.recordings.faults import covariance_of
from etid.recordings.recording import Recording, Samples, quietly
from etid.signals.averaging import (
    PLACES,
    Differing,
    differing_aliases,
    left,
    weighted,
    weights,
)
from etid.signals.disturbances import Joint, Shifts, disturbed, kept
from etid.signals.drift import clocks_apart, largest_drift
from etid.signals.filtering import TAPS
from etid.signals.harmonics import (
    filled,
    harmonics,
    whole_periods,
)
from etid.signals.lags import lags_of
from etid.signals.mains import Hum, separated
from etid.signals.noise import Noise, floor, noise_of
from etid.signals.periods import Periods
from etid.signals.pulse_train import PulseTrain, pulse_trains, rise_time
from etid.signals.quick_looks import humming, shows_few, uneven
from etid.signals.rounding import VISIBLE, is_coarse, step_of

_Key = TypeVar("_Key", bound=Hashable)
_Rows = Int[np.ndarray, " row"]
_Holds = Bool[np.ndarray, " row"]
SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit


class Group:
    """Recordings of equal length and rates that hold equal numbers of periods, inspected together.

    Each property has one entry for each recording and is computed once, when it is used. An axis of
    length 2 holds `v_th` and `v_out`. In recordings of a measured current, the current is in the
    place of `v_th`, here and below, and its unit is the ampere.

    Args:
        recordings: The recordings; `together` puts them into groups.
    """

    def __init__(self, recordings: Sequence[Recording]) -> None:
        self.recordings = recordings
        self.sample_rate = recordings[0].sample_rate
        self.pulse_rate = recordings[0].pulse_rate
        self.has_current = recordings[0].cause == "current"
        self._cut = 0.0  # largest error of the places at which the periods begin [samples]
        self._cuts: dict[int, Periods] = {}

    @functools.cached_property
    @quietly()
    def whole(self) -> Float[np.ndarray, "recording 2 time"]:
        """Voltages of all periods as they were recorded [V]."""
        size = self.recordings[0].samples["v_out"].stored.size
        whole = np.empty((len(self.recordings), 2, size))
        for records, one in zip(whole, self.recordings, strict=True):
            for v, record in zip(records, _records(one), strict=True):
                record.write_to(v)
        whole.flags.writeable = False
        return whole

    def part(self, rows: Sequence[int]) -> "Group":
        """Some of the recordings."""
        part = Group([self.recordings[row] for row in rows])
        vars(part).update(whole=self.whole[rows], trains=[self.trains[row] for row in rows])
        return part

    def joined(self, row: int, plan: Joint) -> "Group":
        """One of the recordings with the periods of a plan, as a group of its own."""
        joined = self.part([row])
        whole = plan(self.whole[row])[None]
        quiet = whole if self.quiet is self.whole else plan(self.quiet[row])[None]
        vars(joined).update(
            whole=whole,
            quiet=quiet,
            periods=(plan.first.size, whole.shape[2]),
            begins=plan.begins[None],
            coarse=self.coarse[[row]],
            apart=self.apart[[row]],
            _periods=[(None, None)],
            _cut=1.0,  # each period begins at a whole sample
        )
        return joined

    @functools.cached_property
    def step(self) -> Float[np.ndarray, "recording 2"]:
        """Converter steps [V]; 0 if unknown."""
        return np.array([[v.resolution or 0.0 for v in _records(one)] for one in self.recordings])

    @functools.cached_property
    @quietly()
    def noise(self) -> Float[np.ndarray, "recording 2"]:
        """Standard deviations of the noise of a sample of `whole` [V]; see `Noise.std`."""
        of, samples = self._of_whole, self._shown[1]
        if self.mismatch and self.periods[0]:
            samples = self.whole.shape[2]
            of = noise_of(self.whole, 1, samples)
        return np.maximum(of.std(samples), self.step / math.sqrt(12.0))

    @property
    def _shown(self) -> tuple[int, int]:
        """`periods`; less than a period is taken for one."""
        return self.periods if self.periods[0] else (1, self.whole.shape[2])

    @functools.cached_property
    def _of_whole(self) -> Noise:
        """The noise of `whole` at each harmonic."""
        return self._noise(self.whole)

    def _noise(self, records: Float[np.ndarray, "recording 2 time"]) -> Noise:
        periods, samples = self._shown
        rest = periods * self.counted_spacing - samples
        return noise_of(records, periods, samples, np.repeat(rest[:, None], 2, axis=1))

    @functools.cached_property
    @quietly()
    def coarse(self) -> Float[np.ndarray, "recording 2"]:
        """Converter steps [V] that exceed the noise, else 0."""
        found = np.zeros(self.step.shape)
        spans = np.ptp(self.recorded_limits, axis=-1)
        visible = (self.step > VISIBLE * spans) | ((self.step == 0) & shows_few(self.whole))
        for row, which in np.argwhere(visible):
            v = self.whole[row, which]
            step = float(self.step[row, which]) or step_of(v)
            found[row, which] = step if is_coarse(v, step) else 0.0
        return found

    @functools.cached_property
    def trains(self) -> list[PulseTrain]:
        """Pulse trains of `v_th`."""
        return pulse_trains(self.whole[:, 0], self.sample_rate, self.pulse_rate)

    @property
    def mismatch(self) -> bool:
        """Whether the pulses contradict the rates."""
        return self.trains[0].mismatch != ""

    @functools.cached_property
    def counted_spacing(self) -> Float[np.ndarray, " recording"]:
        """Length of a pulse period, from the measured pulse rate [samples]."""
        return self.sample_rate / np.array([train.counted for train in self.trains])

    @functools.cached_property
    def periods(self) -> tuple[int, int]:
        """Number of whole periods in each recording, and their number of samples."""
        return whole_periods(self.whole.shape[2], self.sample_rate, self.trains[0].counted)

    @functools.cached_property
    @quietly()
    def hum(self) -> list[list[Hum | None]]:
        """Hum that is subtracted from each record; None if there is none."""
        found: list[list[Hum | None]] = [[None, None] for _ in self.recordings]
        suspect = humming(self.whole, self.noise, self.sample_rate, self.pulse_rate, *self.periods)
        for row, which in np.argwhere(suspect):
            known = self.whole[row, which], float(self.noise[row, which]), self.sample_rate
            found[row][which] = separated(*known, *self.periods)
        return found

    @functools.cached_property
    def quiet(self) -> Float[np.ndarray, "recording 2 time"]:
        """Voltages of all periods without hum between the harmonics [V]."""
        if all(hum is None for both in self.hum for hum in both):
            return self.whole
        quiet = self.whole.copy()
        for records, both in zip(quiet, self.hum, strict=True):
            for v, hum in zip(records, both, strict=True):
                if hum is not None:
                    v -= hum(v.size, self.sample_rate)
        return quiet

    @functools.cached_property
    def recorded_limits(self) -> Float[np.ndarray, "recording 2 limit"]:
        """Smallest and largest sample of each record in `whole` [V]."""
        return _limits(self.whole)

    @functools.cached_property
    def limits(self) -> Float[np.ndarray, "recording 2 limit"]:
        """Smallest and largest sample of each record in `quiet` [V]."""
        return self.recorded_limits if self.quiet is self.whole else _limits(self.quiet)

    @functools.cached_property
    def covariance(self) -> Float[np.ndarray, "recording 2 2"]:
        """Covariance of both voltages in `quiet` [V²]."""
        return covariance_of(self.quiet)

    @functools.cached_property
    def kept(self) -> list[Joint | None]:
        """The periods in use if some are left out or aligned; None if all are used as they are."""
        return [kept for kept, _ in self._periods]

    @functools.cached_property
    def shifts(self) -> list[Shifts | None]:
        """The shifts of the periods of `v_out` against those of `v_th`; None if there are none."""
        return [found for _, found in self._periods]

    @functools.cached_property
    @quietly()
    def _periods(self) -> list[tuple[Joint | None, Shifts | None]]:
        """`kept` and `shifts`."""
        found: list[tuple[Joint | None, Shifts | None]] = [(None, None)] * len(self.recordings)
        if self.mismatch:
            return found
        periods = self.periods[0]
        for spacing, rows in _alike(self.counted_spacing.tolist()).items():
            of = _part(self.quiet, rows), self.noise[rows], self.coarse[rows]
            for row in np.flatnonzero(uneven(*of, spacing, periods)):
                records, sigma, step = (part[[row]] for part in of)
                (bad,) = disturbed(records, sigma, step, spacing, periods)
                found[rows[row]] = kept(records[0], sigma[0], bad, spacing, self.sample_rate)
        return found

    @functools.cached_property
    @quietly()
    def lags(self) -> Float[np.ndarray, " recording"]:
        """Lags of `v_out` in `quiet` [samples]; NaN if misaligned or if the rates are wrong."""
        if self.mismatch:
            return np.full(len(self.recordings), np.nan)
        return lags_of(self.quiet, self.trains)

    @functools.cached_property
    def trusted(self) -> Float[np.ndarray, "recording 2"]:
        """`noise` as far as estimators trust it: not below the error of the interpolation."""
        return np.maximum(self.noise, floor(self.limits, self.step))

    @functools.cached_property
    @quietly()
    def apart(self) -> Float[np.ndarray, " recording"]:
        """Drift of `v_out` against its cause from the first pulse to the last [samples]."""
        return clocks_apart(self.quiet, self.noise, self.trains, self.lags)

    @functools.cached_property
    @quietly()
    def periodic(self) -> Bool[np.ndarray, " recording"]:
        """`faults.is_periodic` of each recording in `quiet`, with all its periods."""
        periods, samples = self.periods
        if periods == 0:
            return np.zeros(len(self.recordings), bool)
        rest = np.maximum(np.abs(periods * self.counted_spacing - samples), self._cut)
        found = faults.is_periodic(self.quiet, self.trusted, rest, samples)
        on_edge = ~faults.is_periodic(self.quiet, self.trusted, np.ones(rest.size), samples)
        # Jitter of the last pulse looks like another pulse rate.
        on_edge &= found & (self.counted_spacing != self.sample_rate / self.pulse_rate)
        for row in np.flatnonzero(on_edge):
            of = self.quiet[row], self.trusted[row], float(self.counted_spacing[row])
            found[row] = faults.begins_again(*of, samples)
        return found

    @functools.cached_property
    @quietly()
    def spans(self) -> Float[np.ndarray, "recording 2"]:
        """Peak-to-peak values in `quiet` [V]; infinite if they overflow."""
        return self.limits[..., 1] - self.limits[..., 0]

    @functools.cached_property
    def flat(self) -> Bool[np.ndarray, "recording 2"]:
        """Whether `v_th` and `v_out` carry no signal."""
        return faults.flat(self.spans, self.covariance, self.noise)

    @functools.cached_property
    def clocks_differ(self) -> Bool[np.ndarray, " recording"]:
        """Whether `v_out` drifts away from `v_th` from pulse to pulse."""
        return ~np.asarray(self.has_current) & (
            np.abs(self.apart) > largest_drift(self.sample_rate)
        )

    @functools.cached_property
    @quietly()
    def refused(self) -> list[str | None]:
        """Names of the verdicts that forbid any fit, the first that applies; None if it is allowed.

        Properties of a recording with one fault may have no meaning, and are not asked for.
        """
        names: list[str | None] = [None] * len(self.recordings)
        left = np.arange(len(names))
        for name, applies in _VERDICTS.items():
            if left.size:
                found = applies(self, left)
                for row in left[found]:
                    names[row] = name
                left = left[~found]
        return names

    @functools.cached_property
    @quietly()
    def noise_of_quiet(self) -> Noise:
        """The noise of `quiet`: at least the rounding and the error of the interpolation."""
        noise = self._of_whole if self.quiet is self.whole else self._noise(self.quiet)
        least = floor(self.limits, self.step)[..., None] ** 2 / self._shown[1]
        return noise._replace(power=np.maximum(noise.power, least))

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, "recording 2 harmonic"]:
        """`Noise.variance` of `noise_of_quiet`."""
        return np.asarray(self.noise_of_quiet.variance)

    @quietly()
    def cut(self, which: int) -> Periods:
        """The periods of `v_th` or of `v_out` in `quiet`, cut where the counted rate says."""
        if which not in self._cuts:
            at = self.counted_spacing[:, None] * np.arange(self.periods[0])
            period = self.sample_rate / self.pulse_rate
            self._cuts[which] = Periods.of(self.quiet[:, which], at, period)
        return self._cuts[which]

    @property
    def _rests(self) -> Bool[np.ndarray, " recording"]:
        """Whether the places are exact where the periods begin, and pulses are at rest there."""
        if self._cut > 0 or self.periods[0] < 2:
            return np.zeros(len(self.recordings), bool)
        middle = self.periods[1] // self.periods[0]
        at = np.abs(self.quiet[:, :, middle] - self.quiet.mean(-1))
        trained = [train.spacing is not None for train in self.trains]
        return np.array(trained) & (at < 0.1 * np.ptp(self.limits, axis=-1)).all(-1)

    @property
    def spectra(self) -> tuple[np.ndarray, ...]:
        """`etid.signals.harmonics.filled` of `quiet`."""
        return self._spectra[0]

    @property
    def differing(self) -> Differing:
        """The aliases that differ between the periods."""
        return self._spectra[1]

    @functools.cached_property
    def begins(self) -> Float[np.ndarray, "recording period"]:
        """Start of each period of `v_th` [samples]."""
        return self.differing.spacing[:, None] * np.arange(self.periods[0])

    @functools.cached_property
    @quietly()
    def _spectra(self) -> tuple[tuple[np.ndarray, ...], Differing]:
        periods, samples = self.periods
        found = np.asarray(harmonics(self.quiet, periods, samples))
        noise = self.noise_of_quiet
        power = self.variance.copy()
        differing = differing_aliases(
            found, power, self.periods, self.counted_spacing, self._rests, self.cut
        )
        place = np.arange(1.0, power.shape[-1] + 1) * (periods / samples)
        for row in np.flatnonzero(differing.rows):
            both, spacing = (
                (differing.of_cause.take(row), differing.of_out.take(row)),
                differing.spacing[row],
            )
            of = weights(spacing, periods, np.interp(PLACES, place, power[row, 0]), both[0])
            found[row] = weighted(self.quiet[row, :, :samples], spacing, of)
            power[row] *= np.interp(place, PLACES, periods * np.square(of).sum(-1))
            power[row] += [np.interp(place, PLACES, left(of, spacing, one)) for one in both]
        *fields, selected = filled(found, power, self.sample_rate, periods, samples)
        usable = np.repeat(selected[None], len(self.recordings), axis=0)
        of_ends = np.asarray(noise.of_ends).any(axis=1)
        coarse = np.any(self.coarse, axis=1, keepdims=True)  # its quiet parts say little
        usable[:, : power.shape[-1]] &= coarse | ~of_ends
        return (*map(np.asarray, fields), usable), differing


def together(recordings: Sequence[Recording]) -> list[tuple[Group, list[int]]]:
    """Groups of recordings with equal lengths and rates, and the places of their recordings."""
    every = Group(recordings)
    size, rate = every.whole.shape[2], every.sample_rate
    keys = [(one.mismatch != "", whole_periods(size, rate, one.counted)) for one in every.trains]
    alike = list(_alike(keys).values())
    return [(every if len(alike) == 1 else every.part(rows), rows) for rows in alike]


def _too_short(group: Group, rows: _Rows) -> _Holds:
    shortest = max(SHORTEST, rise_time(group.sample_rate) + 1)
    return np.full(rows.size, group.whole.shape[2] < shortest)


def _saturated(group: Group, rows: _Rows) -> _Holds:
    nothing = math.nan, math.nan
    ranges = [group.recordings[row].adc_range or nothing for row in rows]
    adc_range = np.repeat(np.array(ranges)[:, None], 2, axis=1)
    if group.has_current:
        adc_range[:, 0] = nothing  # it is one of volts
    records, limits = _part(group.whole, rows), group.recorded_limits[rows]
    sigma, step = group.noise[rows], group.step[rows]
    found = faults.saturated(records, limits, step, adc_range)
    if group.has_current:
        found[:, 0] &= ~faults.held(sigma[:, 0], step[:, 0], group.spans[rows, 0])
        return np.asarray(found.any(1))  # a stimulator that holds its voltage is no fault
    unit = np.maximum(np.maximum(sigma, step), group.coarse[rows])[:, 1]
    of = limits[:, 1], unit, group.lags[rows], group.sample_rate
    return found.any(1) | faults.limited(records, *of)


def _implausible(group: Group, rows: _Rows) -> _Holds:
    found = [group.has_current and not faults.is_plausible(*group.spans[row, ::-1]) for row in rows]
    return np.array(found, bool)


def _unconnected(group: Group, rows: _Rows) -> _Holds:
    if group.has_current:
        return np.zeros(rows.size, bool)
    of = group.covariance[rows], group.noise[rows], group.lags[rows]
    return faults.unconnected(_part(group.quiet, rows), *of)


def _misaligned(group: Group, rows: _Rows) -> _Holds:
    hopeless = [kept is None and found is not None for kept, found in group._periods]
    of_th, of_both, of_out = (group.covariance[rows, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    wrong = np.array(hopeless, bool)[rows]
    if group.has_current:
        return np.asarray(wrong | (of_both <= 0))  # a passive load takes power
    return np.asarray(wrong | (of_out > 1.01 * of_th) | np.isnan(group.lags[rows]))


_VERDICTS = {
    "too_short": _too_short,
    "nonfinite_samples": lambda group, rows: (
        ~(np.isfinite(group.limits[rows]).all((1, 2)) & np.isfinite(group.spans[rows]).all(1))
    ),
    "flat": lambda group, rows: group.flat[rows].any(1),
    "saturated": _saturated,
    "wrong_unit": _implausible,
    "unconnected": _unconnected,
    "rate_mismatch": lambda group, rows: group.mismatch | group.clocks_differ[rows],
    "misaligned": _misaligned,
}


def _records(recording: Recording) -> tuple[Samples, Samples]:
    """The cause of `v_out`, and `v_out`."""
    return recording.samples[recording.cause], recording.samples["v_out"]


def _alike(keys: Sequence[_Key]) -> dict[_Key, list[int]]:
    """The rows of each key."""
    rows: dict[_Key, list[int]] = {}
    for row, key in enumerate(keys):
        rows.setdefault(key, []).append(row)
    return rows


def _part(
    records: Float[np.ndarray, "recording 2 time"], rows: Sequence[int] | _Rows
) -> Float[np.ndarray, "row 2 time"]:
    """The rows of `records`; no copy if these are all."""
    return records if len(rows) == len(records) else records[np.asarray(rows)]


def _limits(v: Float[np.ndarray, "*record time"]) -> Float[np.ndarray, "*record limit"]:
    return np.stack([v.min(-1), v.max(-1)], axis=-1)
