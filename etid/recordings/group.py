"""Recordings of equal length and equal rates, inspected together."""

import functools
import math
from collections.abc import Hashable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.recordings.recording import Recording, Samples, quietly
from etid.signals.averaging import PLACES, SURE, Aliases, Periods, left, weighted, weights
from etid.signals.disturbances import (
    Joint,
    Shifts,
    disturbed,
    enough,
    joint,
    of_source,
    shifts,
)
from etid.signals.harmonics import (
    COHERENT,
    filled,
    harmonics,
    separates_aliases,
    whole_periods,
)
from etid.signals.mains import Hum, separated
from etid.signals.noise import Noise, floor, noise_of
from etid.signals.pulse_train import (
    PulseTrain,
    clocks_apart,
    lags_of,
    pulse_trains,
    rise_time,
)
from etid.signals.quick_looks import humming, shows_few, uneven
from etid.signals.rounding import VISIBLE, is_coarse, step_of

_Key = TypeVar("_Key", bound=Hashable)
SEAM = 3  # samples on each side of the joint between two periods
MOVED = 0.05  # [samples] of the last period, from which on its place matters without aliases
LEAK = 0.1  # part of the noise that aliases on a harmonic may have
BY_CHANCE = 4.0  # [standard deviations] largest difference that noise makes


class Group:
    """Recordings of equal length and equal rates, inspected together to save time.

    Each property has one entry for each recording and is computed once, when it is used. An axis of
    length 2 holds `v_th` and `v_out`. In recordings of a measured current, the current is in the
    place of `v_th`, here and below, and its unit is the ampere.

    Args:
        recordings: The recordings.
        cut: Largest error of the places at which their periods begin [samples].
    """

    def __init__(self, recordings: Sequence[Recording], cut: float = 0.0) -> None:
        self.recordings = recordings
        self._cut = cut
        self.sample_rate = recordings[0].sample_rate
        self.pulse_rate = recordings[0].pulse_rate
        self._spectra: dict[tuple[int, int], tuple[np.ndarray, ...]] = {}
        self._exact: dict[int, float] = {}
        self._aliases: dict[int, tuple[Aliases, Aliases]] = {}
        self._noises: dict[tuple[bool, int, int], Noise] = {}
        self._floored: dict[tuple[int, int], Noise] = {}

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

    def joined(self, row: int, plan: Joint) -> "Group":
        """One of the recordings with the periods of a plan, as a group of its own."""
        joined = Group([self.recordings[row]], cut=1.0)  # each period begins at a whole sample
        whole = plan(self.whole[row])[None]
        quiet = whole if self.quiet is self.whole else plan(self.quiet[row])[None]
        periods = plan.first.size, whole.shape[2]
        vars(joined).update(
            whole=whole, quiet=quiet, trains=[self.trains[row]], whole_periods=[periods]
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
        found = np.zeros((len(self.recordings), 2))
        whole = 1, self.whole.shape[2]
        known = [
            of if of[0] and not train.mismatch else whole
            for of, train in zip(self.whole_periods, self.trains, strict=True)
        ]
        for (periods, samples), rows in _alike(known).items():
            found[rows] = self._noise(self.whole, periods, samples).std(samples)[rows]
        return np.maximum(found, self.step / math.sqrt(12.0))

    def _noise(
        self, records: Float[np.ndarray, "recording 2 time"], periods: int, samples: int
    ) -> Noise:
        """The noise of `whole` or of `quiet`."""
        key = records is self.whole, periods, samples
        if key not in self._noises:
            lengths = [self.sample_rate / train.counted for train in self.trains]
            rest = np.repeat(periods * np.array(lengths)[:, None] - samples, 2, axis=1)
            self._noises[key] = noise_of(records, periods, samples, rest)
        return self._noises[key]

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

    @functools.cached_property
    def whole_periods(self) -> list[tuple[int, int]]:
        """Numbers of whole periods in each recording, and their number of samples."""
        size = self.whole.shape[2]
        return [whole_periods(size, self.sample_rate, train.counted) for train in self.trains]

    @functools.cached_property
    @quietly()
    def hum(self) -> list[list[Hum | None]]:
        """Hum that is subtracted from each record; None if there is none."""
        found: list[list[Hum | None]] = [[None, None] for _ in self.recordings]
        rates = self.sample_rate, self.pulse_rate
        for of, rows in _alike(self.whole_periods).items():
            suspect = humming(_part(self.whole, rows), self.noise[rows], *rates, *of)
            for number, which in np.argwhere(suspect):
                row = rows[number]
                known = self.whole[row, which], float(self.noise[row, which]), self.sample_rate
                found[row][which] = separated(*known, *of)
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

    @property
    def kept(self) -> list[Joint | None]:
        """The periods in use if some are left out or aligned; None if all are used as they are."""
        return [kept for kept, _ in self._periods]

    @property
    def shifts(self) -> list[Shifts | None]:
        """The shifts of the periods of `v_out` against those of `v_th`; None if there are none."""
        return [found for _, found in self._periods]

    @functools.cached_property
    @quietly()
    def _periods(self) -> list[tuple[Joint | None, Shifts | None]]:
        """`kept` and `shifts`."""
        found: list[tuple[Joint | None, Shifts | None]] = [(None, None)] * len(self.recordings)
        of_all = [
            None if train.mismatch else (train.counted, periods)
            for train, (periods, _) in zip(self.trains, self.whole_periods, strict=True)
        ]
        for key, rows in _alike(of_all).items():
            if key is None:
                continue
            counted, periods = key
            of = _part(self.quiet, rows), self.noise[rows], self.coarse[rows]
            spacing = self.sample_rate / counted
            for row in np.flatnonzero(uneven(*of, spacing, periods)):
                records, sigma, step = (part[[row]] for part in of)
                (bad,) = disturbed(records, sigma, step, spacing, periods)
                found[rows[row]] = _kept(records[0], sigma[0], bad, spacing, self.sample_rate)
        return found

    @functools.cached_property
    @quietly()
    def lags(self) -> list[float | None]:
        """Lags of `v_out` in `quiet` [samples]; None if misaligned or if the rates are wrong."""
        lags: list[float | None] = [None] * len(self.recordings)
        rows = [row for row, train in enumerate(self.trains) if not train.mismatch]
        if rows:
            found = lags_of(_part(self.quiet, rows), [self.trains[row] for row in rows])
            for row, lag in zip(rows, found, strict=True):
                lags[row] = lag
        return lags

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
        """`is_periodic` of each recording in `quiet`, with all its periods."""
        found = np.zeros(len(self.recordings), bool)
        for (periods, samples), rows in _alike(self.whole_periods).items():
            if periods == 0:
                continue
            counted = np.array([self.trains[row].counted for row in rows])
            rest = np.abs(periods * self.sample_rate / counted - samples)
            rest = np.maximum(rest, self._cut)
            records, sigma = _part(self.quiet, rows), self.trusted[rows]
            found[rows] = is_periodic(records, sigma, rest, samples)
            on_edge = ~is_periodic(records, sigma, np.ones(len(rows)), samples)
            # Jitter of the last pulse looks like another pulse rate.
            on_edge &= found[rows] & (counted != self.pulse_rate)
            for row in np.flatnonzero(on_edge):
                spacing = self.sample_rate / counted[row]
                found[rows[row]] = _repeats(records[row], sigma[row], spacing, samples)
        return found

    @quietly()
    def noise_of_quiet(self, periods: int, samples: int) -> Noise:
        """The noise of `quiet`: at least the rounding and the error of the interpolation."""
        if (periods, samples) not in self._floored:
            noise = self._noise(self.quiet, periods, samples)
            least = floor(self.limits, self.step)[..., None] ** 2 / samples
            power = np.maximum(noise.power, least)
            self._floored[periods, samples] = noise._replace(power=power)
        return self._floored[periods, samples]

    @quietly()
    def spectra(self, periods: int, samples: int) -> tuple[np.ndarray, ...]:
        """`etid.signals.harmonics.filled` for `quiet` and numbers from `whole_periods`."""
        if (periods, samples) not in self._spectra:
            found = np.asarray(harmonics(self.quiet, periods, samples))
            noise = self.noise_of_quiet(periods, samples)
            power = np.array(noise.variance)
            self._find_aliases(found, power, periods, samples)
            for row, both in self._aliases.items():
                if self.whole_periods[row] != (periods, samples):
                    continue
                spacing = self.spacing(row)
                place = np.arange(1.0, power.shape[-1] + 1) * (periods / samples)
                of_cause = np.interp(PLACES, place, power[row, 0])
                of = weights(spacing, periods, of_cause, both[0])
                found[row] = weighted(self.quiet[row, :, :samples], spacing, of)
                power[row] *= np.interp(place, PLACES, periods * np.square(of).sum(-1))
                rest = [left(of, spacing, aliases) for aliases in both]
                power[row] += [np.interp(place, PLACES, one) for one in rest]
            *fields, selected = filled(found, power, self.sample_rate, periods, samples)
            usable = np.repeat(selected[None], len(self.recordings), axis=0)
            of_ends = np.asarray(noise.of_ends).any(axis=1)
            coarse = np.any(self.coarse, axis=1, keepdims=True)  # its quiet parts say little
            usable[:, : power.shape[-1]] &= coarse | ~of_ends
            self._spectra[periods, samples] = *map(np.asarray, fields), usable
        return self._spectra[periods, samples]

    def spacing(self, row: int) -> float:
        """Length of a period [samples]; by the phases of its pulses if aliases need it."""
        known = self.sample_rate / self.trains[row].counted
        return self._exact.get(row, known)

    def aliases(self, row: int) -> tuple[Aliases, Aliases] | None:
        """Aliases of both records that differ between their periods; None if there are none."""
        self.spectra(*self.whole_periods[row])
        return self._aliases.get(row)

    def _find_aliases(
        self,
        coefficients: Complex[np.ndarray, "recording 2 harmonic"],
        power: Float[np.ndarray, "recording 2 harmonic"],
        periods: int,
        samples: int,
    ) -> None:
        """Find the aliases that leak into the harmonics, and the exact length of their periods."""
        if periods < 3 or not separates_aliases(periods, samples) or self._cut > 0:
            return
        top = coefficients[:, 0, coefficients.shape[-1] * 9 // 10 :]  # aliases are as large there
        loud = np.square(np.abs(top)).mean(-1) / power[:, 0, -top.shape[-1] :].mean(-1) - 1
        middle = samples // periods  # a joint, where pulses must be at rest
        at = np.abs(self.quiet[:, :, middle] - self.quiet.mean(-1))
        rests = (at < 0.1 * np.ptp(self.limits, axis=-1)).all(-1)
        surely = SURE / math.sqrt(top.shape[-1])
        for row in np.flatnonzero(rests & (loud > surely)).tolist():
            if self.trains[row].spacing is None or self.whole_periods[row] != (periods, samples):
                continue
            v, known = self.quiet[row, :, :samples], self.spacing(row)
            of_cause = Periods.of(v[0], known, periods)
            spacing = known + of_cause.longer()
            of_cause = of_cause._replace(spacing=spacing)
            if abs(spacing - known) * periods > MOVED:
                self._exact[row] = spacing
            # At most, aliases are as large as the signal where they meet it.
            kept = np.square(np.abs(of_cause.turns.mean(1))).sum()
            if 2 * COHERENT * spacing * loud[row] * kept < LEAK:
                continue
            found = of_cause.aliases(power[row, 0])
            if found is None:
                continue
            plain = np.full((PLACES.size, periods), 1 / periods)
            place = np.arange(1.0, power.shape[-1] + 1) * (periods / samples)
            of_noise = np.interp(PLACES, place, power[row, 0])
            if (left(plain, spacing, found) > LEAK * of_noise).any():
                other = Periods.of(v[1], spacing, periods).aliases(power[row, 1], found)
                self._aliases[row] = found, other or found
                self._exact[row] = spacing


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
    records: Float[np.ndarray, "recording 2 time"], rows: Sequence[int]
) -> Float[np.ndarray, "row 2 time"]:
    """The rows of `records`; no copy if these are all."""
    return records if len(rows) == len(records) else records[np.asarray(rows)]


def _limits(v: Float[np.ndarray, "*record time"]) -> Float[np.ndarray, "*record limit"]:
    return np.stack([v.min(-1), v.max(-1)], axis=-1)


@quietly()
def covariance_of(v: Float[np.ndarray, "*recording 2 time"]) -> Float[np.ndarray, "*recording 2 2"]:
    """Covariance of both voltages of each recording."""
    mean, square = v.mean(-1), np.zeros((*v.shape[:-1], 2))
    for first in range(0, v.shape[-1], 8192):  # longer products start BLAS threads
        part = v[..., first : first + 8192]
        square += np.vecdot(part[..., :, None, :], part[..., None, :, :])
    return square / v.shape[-1] - mean[..., :, None] * mean[..., None, :]


def is_periodic(
    records: Float[np.ndarray, "*recording 2 time"],
    sigma: Float[np.ndarray, "*recording 2"],
    rest: Float[np.ndarray, "*recording"],
    samples: int,
) -> Bool[np.ndarray, "*recording"]:
    """Whether whole periods have no step from their end to their start.

    Their length differs by `rest` from `samples`, up to half a sample. This makes a step if the
    signal is steep at the joint.
    """
    joint = np.concatenate([records[..., samples - SEAM : samples], records[..., :SEAM]], axis=-1)
    step = rest[..., None] * np.abs(np.diff(joint)).max(-1)
    return np.asarray(~(step > BY_CHANCE * sigma).any(-1))


def _repeats(
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


def _kept(
    records: Float[np.ndarray, "2 time"],
    sigma: Float[np.ndarray, "2"],
    bad: Bool[np.ndarray, " period"],
    spacing: float,
    sample_rate: float,
) -> tuple[Joint | None, Shifts | None]:
    """The plan to leave disturbed periods out and to align shifted ones, and their shifts.

    Fewer than half of the periods may be left out: the others must show the shape of an undisturbed
    period.
    """
    rise = rise_time(sample_rate)
    if not enough(bad) or (bad.any() and any(of_source(v, bad, spacing, rise) for v in records)):
        bad = np.zeros_like(bad)
    found = shifts(records, sigma, spacing, bad.size, rise)
    late = np.zeros(bad.size, int) if found is None else found.late
    bad = bad if found is None else bad | found.bad
    if not (bad.any() or late.any()) or not enough(bad):
        return None, found
    return joint(~bad, late, spacing, records.shape[1]), found
