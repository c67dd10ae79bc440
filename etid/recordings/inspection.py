"""What is found in recordings of equal length and equal rates before a fit."""

import functools
import math
from collections.abc import Hashable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.recordings import faults
from etid.recordings.faults import covariance_of
from etid.recordings.recording import Recording, Samples, quietly
from etid.recordings.remarks import Remark
from etid.signals.averaging import Differing, differing_aliases, exact_spacing, without_aliases
from etid.signals.bins import are_coherent
from etid.signals.disturbances import Joint, Shifts, disturbed, kept
from etid.signals.drift import clocks_apart, largest_drift
from etid.signals.harmonics import (
    ALIASED,
    aliases,
    filled,
    harmonics,
    have_ended,
    joins_aliases,
    whole_periods,
)
from etid.signals.lags import lags_of, whole_lag
from etid.signals.mains import Hum, separated
from etid.signals.noise import Noise, floor, noise_of
from etid.signals.periods import Periods
from etid.signals.pulse_train import PulseTrain, pulse_trains
from etid.signals.quick_looks import humming, shows_few, uneven
from etid.signals.rounding import COARSE, VISIBLE, is_coarse, step_of, white_variance

_Key = TypeVar("_Key", bound=Hashable)


class Inspection:
    """What is found in recordings before a fit; they have equal lengths, rates, and periods.

    Each property has one row for each recording and is computed once, when it is used. An axis of
    length 2 holds `v_th` and `v_out`. In recordings of a measured current, the current is in the
    place of `v_th`, here and below, and its unit is the ampere.

    Args:
        recordings: The recordings; `together` finds those that are alike.
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
    def recorded(self) -> Float[np.ndarray, "recording 2 time"]:
        """Voltages of all periods as they were recorded [V]."""
        size = self.recordings[0].samples["v_out"].stored.size
        recorded = np.empty((len(self.recordings), 2, size))
        for records, one in zip(recorded, self.recordings, strict=True):
            for v, record in zip(records, _records(one), strict=True):
                record.write_to(v)
        recorded.flags.writeable = False
        return recorded

    def part(self, rows: Sequence[int]) -> "Inspection":
        """Some of the recordings."""
        part = Inspection([self.recordings[row] for row in rows])
        vars(part).update(recorded=self.recorded[rows], train=[self.train[row] for row in rows])
        return part

    def in_use(self, row: int) -> tuple["Inspection", int]:
        """An inspection of the periods of a recording that are in use, and its row there."""
        plan, shifts = self._periods[row]
        if plan is None:
            return self, row
        joined = self.part([row])
        recorded = plan(self.recorded[row])[None]
        quiet = recorded if self.quiet is self.recorded else plan(self.quiet[row])[None]
        vars(joined).update(
            recorded=recorded,
            quiet=quiet,
            whole_periods=self.whole_periods,
            periods=(plan.first.size, recorded.shape[2]),
            begins=plan.begins[None],
            coarse=self.coarse[[row]],
            hum=[self.hum[row]],
            apart=self.apart[[row]],
            _periods=[(plan, shifts)],
            _cut=1.0,  # each period begins at a whole sample
        )
        return joined, 0

    @functools.cached_property
    @quietly()
    def _few(self) -> Bool[np.ndarray, "recording 2"]:
        return shows_few(self.recorded)

    @functools.cached_property
    @quietly()
    def step(self) -> Float[np.ndarray, "recording 2"]:
        """Converter steps [V], stated or seen in the values; 0 if unknown."""
        stated = [[v.resolution or 0.0 for v in _records(one)] for one in self.recordings]
        step = np.array(stated)
        few = (step == 0) & self._few
        few[self.held, 0] = False  # a command has the values that it has
        few &= not self.has_current  # one of both may be a command that was not measured
        for at in map(tuple, np.argwhere(few)):
            step[at] = step_of(self.recorded[at])
        return step

    @functools.cached_property
    @quietly()
    def sigma(self) -> Float[np.ndarray, "recording 2"]:
        """Standard deviations of the noise of a sample of `recorded` [V]; see `Noise.std`."""
        of, samples = self._of_whole, self._shown[1]
        if self.mismatch and self.periods[0]:
            samples = self.recorded.shape[2]
            of = noise_of(self.recorded, 1, samples, whole=False)
        return np.maximum(of.std(samples), self.step / math.sqrt(12.0))

    @property
    def _shown(self) -> tuple[int, int]:
        """`periods`; less than a period is taken for one."""
        return self.periods if self.periods[0] else (1, self.recorded.shape[2])

    @functools.cached_property
    def _of_whole(self) -> Noise:
        """The noise of `recorded` at each harmonic."""
        return self._noise(self.recorded)

    def _noise(self, records: Float[np.ndarray, "recording 2 time"]) -> Noise:
        periods, samples = self._shown
        rest = periods * self.spacing - samples
        of_both = np.repeat(rest[:, None], 2, axis=1)
        return noise_of(records, periods, samples, of_both, self.periods[0] > 0)

    @functools.cached_property
    @quietly()
    def coarse(self) -> Float[np.ndarray, "recording 2"]:
        """Converter steps [V] that exceed the noise, else 0."""
        found = np.zeros(self.step.shape)
        spans = np.ptp(self.recorded_limits, axis=-1)
        visible = (self.step > VISIBLE * spans) | ((self.step == 0) & self._few)
        for at in map(tuple, np.argwhere(visible)):
            step = float(self.step[at]) or step_of(self.recorded[at])
            found[at] = step if is_coarse(self.recorded[at], step) else 0.0
        found[self.held, 0] = 0.0  # a command has the values that it has
        return found

    @functools.cached_property
    def held(self) -> Bool[np.ndarray, " recording"]:
        """Whether a converter holds the cause of `v_out` between its samples."""
        return np.array([one.hold is not None for one in self.recordings])

    @functools.cached_property
    def train(self) -> list[PulseTrain]:
        """Pulse trains of `v_th`."""
        return pulse_trains(self.recorded[:, 0], self.sample_rate, self.pulse_rate)

    @property
    def mismatch(self) -> bool:
        """Whether the pulses contradict the rates."""
        return self.train[0].mismatch != ""

    @functools.cached_property
    def counted(self) -> Float[np.ndarray, " recording"]:
        """Pulse rates [Hz], measured with the clocks of the recordings."""
        return np.array([train.counted for train in self.train])

    @functools.cached_property
    def spacing(self) -> Float[np.ndarray, " recording"]:
        """Length of a pulse period, from the measured pulse rate [samples]."""
        return self.sample_rate / self.counted

    @functools.cached_property
    def whole_periods(self) -> tuple[int, int]:
        """Number of whole periods of each recording, and their number of samples."""
        return whole_periods(self.recorded.shape[2], self.sample_rate, self.train[0].counted)

    @functools.cached_property
    def periods(self) -> tuple[int, int]:
        """The same of the periods in use."""
        return self.whole_periods

    @functools.cached_property
    @quietly()
    def hum(self) -> list[list[Hum | None]]:
        """Hum that is subtracted from each record; None if there is none."""
        found: list[list[Hum | None]] = [[None, None] for _ in self.recordings]
        suspect = humming(
            self.recorded, self.sigma, self.sample_rate, self.pulse_rate, *self.periods
        )
        for row, which in np.argwhere(suspect):
            known = self.recorded[row, which], float(self.sigma[row, which]), self.sample_rate
            found[row][which] = separated(*known, *self.periods)
        return found

    @functools.cached_property
    def hums(self) -> Bool[np.ndarray, " recording"]:
        """Whether hum is subtracted from one of the records."""
        return np.array([any(hum is not None for hum in both) for both in self.hum])

    @functools.cached_property
    def quiet(self) -> Float[np.ndarray, "recording 2 time"]:
        """Voltages of all periods without hum between the harmonics [V]."""
        if not self.hums.any():
            return self.recorded
        quiet = self.recorded.copy()
        for records, both in zip(quiet, self.hum, strict=True):
            for v, hum in zip(records, both, strict=True):
                if hum is not None:
                    v -= hum(v.size, self.sample_rate)
        return quiet

    @functools.cached_property
    def recorded_limits(self) -> Float[np.ndarray, "recording 2 limit"]:
        """Smallest and largest sample of each record in `recorded` [V]."""
        return _limits(self.recorded)

    @functools.cached_property
    def limits(self) -> Float[np.ndarray, "recording 2 limit"]:
        """Smallest and largest sample of each record in `quiet` [V]."""
        return self.recorded_limits if self.quiet is self.recorded else _limits(self.quiet)

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
        for spacing, rows in _alike(self.spacing.tolist()).items():
            of = faults.part(self.quiet, rows), self.sigma[rows], self.coarse[rows]
            for row in np.flatnonzero(uneven(*of, spacing, periods)):
                records, sigma, step = (part[[row]] for part in of)
                (bad,) = disturbed(records, sigma, step, spacing, periods)
                found[rows[row]] = kept(records[0], sigma[0], bad, spacing, self.sample_rate)
        return found

    @functools.cached_property
    @quietly()
    def correlated(self) -> Float[np.ndarray, " recording"]:
        """Lags of `v_out` in `quiet` [samples]; NaN if misaligned or if the rates are wrong."""
        if self.mismatch:
            return np.full(len(self.recordings), np.nan)
        return lags_of(self.quiet, self.train)

    @functools.cached_property
    def lag(self) -> Int[np.ndarray, " recording"]:
        """Lags of `v_out` to be removed before a fit [whole samples]; 0 where none is known.

        They are 0 for a measured current: one instrument records both, and the voltage at a
        capacitor shows no edge where the current has one.
        """
        known = np.isfinite(self.correlated) & (not self.has_current)
        late = zip(self.correlated.tolist(), known.tolist(), strict=True)
        return np.array([whole_lag(lag) if holds else 0 for lag, holds in late])

    @functools.cached_property
    def trusted(self) -> Float[np.ndarray, "recording 2"]:
        """`sigma` as far as estimators trust it: not below the error of the interpolation."""
        return np.maximum(self.sigma, floor(self.limits, self.step))

    @functools.cached_property
    @quietly()
    def apart(self) -> Float[np.ndarray, " recording"]:
        """Drift of `v_out` against its cause from the first pulse to the last [samples]."""
        return clocks_apart(self.quiet, self.sigma, self.train, self.correlated)

    @functools.cached_property
    @quietly()
    def is_periodic(self) -> Bool[np.ndarray, " recording"]:
        """Whether each recording holds whole periods, without a step from its end to its start.

        If periods are left out, each begins at a whole sample, up to one sample from its place.
        """
        if self.periods[0] == 0:
            return np.zeros(len(self.recordings), bool)
        period = self.sample_rate / self.pulse_rate
        of = self.quiet, self.trusted, self.spacing
        return faults.is_periodic(*of, *self.periods, self._cut, self.spacing != period)

    @functools.cached_property
    @quietly()
    def spans(self) -> Float[np.ndarray, "recording 2"]:
        """Peak-to-peak values in `quiet` [V]; infinite if they overflow."""
        return self.limits[..., 1] - self.limits[..., 0]

    @functools.cached_property
    def is_flat(self) -> Bool[np.ndarray, "recording 2"]:
        """Whether `v_th` and `v_out` carry no signal."""
        found = faults.flat(self.spans, self.covariance, self.sigma)
        for row in np.flatnonzero(found.any(1) & (self.spans > 0).all(1)):
            found[row] &= not are_coherent(self.recorded[row])
        return found

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
        return faults.refused(self)

    @functools.cached_property
    @quietly()
    def noise(self) -> Noise:
        """The noise of `quiet`: at least the rounding and the error of the interpolation."""
        noise = self._of_whole if self.quiet is self.recorded else self._noise(self.quiet)
        periods, samples = self._shown
        least = floor(self.limits, self.step) ** 2
        for at in map(tuple, np.argwhere(self.step > COARSE * self._of_whole.std(samples))):
            rounding = white_variance(self.recorded[at], float(self.step[at]), periods)
            least[at] = max(least[at], rounding)
        least = least[..., None] / samples
        return noise._replace(power=np.maximum(noise.power, least))

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, "recording 2 harmonic"]:
        """`Noise.variance` of `noise`."""
        return np.asarray(self.noise.variance)

    @quietly()
    def cut(self, which: int) -> Periods:
        """The periods of `v_th` or of `v_out` in `quiet`, cut where the counted rate says."""
        if which not in self._cuts:
            at = self.spacing[:, None] * np.arange(self.periods[0])
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
        trained = [train.spacing is not None for train in self.train]
        return np.array(trained) & (at < 0.1 * np.ptp(self.limits, axis=-1)).all(-1)

    @property
    def spectrum(self) -> tuple[np.ndarray, ...]:
        """`etid.signals.harmonics.filled` of `quiet`: frequencies, and fields with rows."""
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
        found, noise = np.asarray(harmonics(self.quiet, *self.periods)), self.noise
        of = self.variance, self.periods, self.spacing
        differing = differing_aliases(found, *of, self._rests, self.cut)
        found, power = without_aliases(self.quiet, found, self.variance, differing, *self.periods)
        *fields, selected = filled(found, power, self.sample_rate, *self.periods)
        usable = np.repeat(selected[None], len(self.recordings), axis=0)
        of_ends = np.asarray(noise.of_ends).any(axis=1)
        coarse = np.any(self.coarse, axis=1, keepdims=True)  # its quiet parts say little
        usable[:, : power.shape[-1]] &= coarse | ~of_ends
        return (*map(np.asarray, fields), usable), differing

    @functools.cached_property
    def exact_spacing(self) -> Float[np.ndarray, " recording"]:
        """`spacing`, or the length that the phases of the pulses in use surely have [samples]."""
        exact = self.spacing.copy()
        trained = np.flatnonzero([train.spacing is not None for train in self.train])
        if trained.size and self.periods[0] > 1:
            exact[trained] = exact_spacing(self.cut(0).take(trained), exact[trained])
        return exact

    @functools.cached_property
    def covered(self) -> Bool[np.ndarray, "recording harmonic"]:
        """Whether each harmonic of `spectrum` is unusable because of hum or aliases.

        Hum covers a harmonic if the subtraction does not remove it there. Aliases cover the high
        harmonics of records with two periods or with periods left out. They are half as large as
        the aliases of a single period.
        """
        frequency, periods = self.spectrum[0], self.whole_periods[0]
        aliased = np.array([kept is not None for kept in self.kept]) | (self.periods[0] == 2)
        covered = aliased[:, None] & (frequency > ALIASED * self.sample_rate)
        for row in np.flatnonzero(self.hums):
            for hum in filter(None, self.hum[row]):
                covered[row] |= hum.covers(frequency, periods)
        return covered

    @functools.cached_property
    @quietly()
    def has_no_aliases(self) -> Bool[np.ndarray, " recording"]:
        """Whether the spectra of a current and of `v_out` surely end below half the sample rate."""
        if not self.has_current:
            return np.zeros(len(self.recordings), bool)
        _, x, y, variance_x, variance_y, _ = self.spectrum
        return have_ended((x, y), (variance_x, variance_y), *self.periods)

    @functools.cached_property
    @quietly()
    def is_aliased(self) -> Bool[np.ndarray, " recording"]:
        """Whether aliases of unknown size fall on the harmonics of `v_th`, above its noise."""
        if not joins_aliases(*self.periods):
            return np.zeros(len(self.recordings), bool)
        _, x, _, variance, *_ = self.spectrum
        unknown = aliases(x, variance, *self.periods).are_unknown(variance)
        return unknown & ~self.has_no_aliases

    @functools.cached_property
    def remarks(self) -> Int[np.ndarray, " recording"]:
        """Remarks on how recordings are changed before a fit, but for `Remark.aligned`."""
        found = {
            Remark.mains_hum: self.hums,
            Remark.periods_left_out: self.periods[0] < self.whole_periods[0],
            Remark.periods_shifted: np.array([shifts is not None for shifts in self.shifts]),
            Remark.coarse_converter: self.coarse.any(1),
            # A clock is not more than 300 ppm wrong.
            Remark.pulse_rate_counted: np.abs(self.counted / self.pulse_rate - 1) > 3e-4,
        }
        return np.asarray(sum(int(remark) * holds for remark, holds in found.items()))


def together(recordings: Sequence[Recording]) -> list[tuple[Inspection, list[int]]]:
    """Inspections of recordings of equal lengths and rates, and the places of their rows."""
    every = Inspection(recordings)
    size, rate = every.recorded.shape[2], every.sample_rate
    keys = [(one.mismatch != "", whole_periods(size, rate, one.counted)) for one in every.train]
    alike = list(_alike(keys).values())
    return [(every if len(alike) == 1 else every.part(rows), rows) for rows in alike]


def _records(recording: Recording) -> tuple[Samples, Samples]:
    """The cause of `v_out`, and `v_out`."""
    return recording.samples[recording.cause], recording.samples["v_out"]


def _alike(keys: Sequence[_Key]) -> dict[_Key, list[int]]:
    """The rows of each key."""
    rows: dict[_Key, list[int]] = {}
    for row, key in enumerate(keys):
        rows.setdefault(key, []).append(row)
    return rows


def _limits(v: Float[np.ndarray, "*record time"]) -> Float[np.ndarray, "*record limit"]:
    return np.stack([v.min(-1), v.max(-1)], axis=-1)
