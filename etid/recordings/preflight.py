"""Pre-flight: faults of a recording that can be detected before a fit."""

import functools
import math

import numpy as np
from jaxtyping import Bool, Float

from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.signals.disturbances import Joint, disturbed, joint, of_source
from etid.signals.filtering import TAPS
from etid.signals.harmonics import ALIASED, whole_periods
from etid.signals.mains import Hum, separated
from etid.signals.noise import is_coarse, noise_std, step_of, trusted
from etid.signals.pulse_train import (
    CLOCK,
    PulseTrain,
    find_pulses,
    lag_of,
    rise_time,
    shifted,
    whole_lag,
)

SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit
# [standard deviations] peak-to-peak value that noise alone hardly exceeds; a signal must exceed it
FLAT = 8.0
RAIL = 3  # equal extreme samples in a row; a noisy or sloping signal does not produce them
JUMP = 8.0  # [converter steps] a clipped signal reaches and leaves its rail in larger jumps
POWER = 1.01  # largest variance of v_out relative to v_th: a passive load takes power
EQUAL = 1e-3  # largest relative difference of the amplitudes if no load is connected
SAME = 1.5  # largest variance of their difference then, relative to the noise
LATE = 5e-3  # fraction of the signal that a delay of 0.1 sample may leave at the edges
SEAM = 3  # samples on each side of the joint between two periods
STEP = 4.0  # [standard deviations] largest difference there; also allowed in addition to EQUAL


class Inspected:
    """A recording and its properties that need no model; each is computed once, when it is used.

    Attributes:
        recording: The recording.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    @functools.cached_property
    def v_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded voltage [V] of the periods in use, without hum between the harmonics."""
        return self._joined(self.quiet_th)

    @functools.cached_property
    def v_out(self) -> Float[np.ndarray, " time"]:
        """Loaded voltage [V] of the periods in use, without hum between the harmonics."""
        return self._joined(self.quiet_out)

    @functools.cached_property
    def recorded_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded voltage of the periods in use as it was recorded [V]."""
        return self._joined(self.whole_th)

    @functools.cached_property
    def recorded_out(self) -> Float[np.ndarray, " time"]:
        """Loaded voltage of the periods in use as it was recorded [V]."""
        return self._joined(self.whole_out)

    @functools.cached_property
    def whole_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded voltage of all periods as it was recorded [V]."""
        return self.recording.v_th

    @functools.cached_property
    def whole_out(self) -> Float[np.ndarray, " time"]:
        """Loaded voltage of all periods as it was recorded [V]."""
        return self.recording.v_out

    @functools.cached_property
    def quiet_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded voltage of all periods without hum [V]."""
        return self._without(self.hum_th, self.whole_th)

    @functools.cached_property
    def quiet_out(self) -> Float[np.ndarray, " time"]:
        """Loaded voltage of all periods without hum [V]."""
        return self._without(self.hum_out, self.whole_out)

    @functools.cached_property
    def kept(self) -> Joint | None:
        """The pulse periods in use if disturbed periods are left out; None if all are in use.

        Fewer than half of the periods may be left out: the others must show the shape of an
        undisturbed period.
        """
        if self.train.mismatch:
            return None
        bad = disturbed(
            (self.quiet_th, self.quiet_out),
            (float(self.noise_th), float(self.noise_out)),
            (self.coarse_th, self.coarse_out),
            self.spacing,
            self.whole_periods[0],
        )
        left = np.count_nonzero(~bad)
        if not max(2, bad.size // 2 + 1) <= left < bad.size:
            return None
        rise = rise_time(self.recording.sample_rate)
        if any(of_source(v, bad, self.spacing, rise) for v in (self.quiet_th, self.quiet_out)):
            return None
        return joint(~bad, self.spacing, self.whole_out.size)

    def _joined(self, v: Float[np.ndarray, " time"]) -> Float[np.ndarray, " kept"]:
        return v if self.kept is None else self.kept(v)

    @property
    def begins(self) -> Float[np.ndarray, " period"]:
        """Start of each period of `v_th` [samples]."""
        return self.spacing * np.arange(self.periods[0]) if self.kept is None else self.kept.begins

    @functools.cached_property
    def coarse_th(self) -> float:
        """Converter step [V] of `v_th` if it exceeds the noise, else 0."""
        return self._coarse(self.whole_th, self.step_th)

    @functools.cached_property
    def coarse_out(self) -> float:
        """Converter step [V] of `v_out` if it exceeds the noise, else 0."""
        return self._coarse(self.whole_out, self.step_out)

    def _coarse(self, v: Float[np.ndarray, " time"], told: float) -> float:
        step = told or step_of(v)
        return step if is_coarse(v, step) else 0.0

    @functools.cached_property
    def hum_th(self) -> Hum | None:
        """Hum that is subtracted from `v_th`; None if there is none."""
        return self._hum(self.whole_th, self.noise_th)

    @functools.cached_property
    def hum_out(self) -> Hum | None:
        """Hum that is subtracted from `v_out`; None if there is none."""
        return self._hum(self.whole_out, self.noise_out)

    def _hum(self, v: Float[np.ndarray, " time"], sigma: Float[np.ndarray, ""]) -> Hum | None:
        of = self.recording
        return separated(v, sigma, of.sample_rate, of.pulse_rate, *self.whole_periods)

    def _without(self, hum: Hum | None, v: Float[np.ndarray, " time"]) -> np.ndarray:
        return v if hum is None else v - hum(v.size, self.recording.sample_rate)

    def covered(self, frequency: Float[np.ndarray, " harmonic"]) -> Bool[np.ndarray, " harmonic"]:
        """Whether each harmonic is unusable because of hum or aliases.

        Hum covers a harmonic if the subtraction does not remove it there. Aliases cover the high
        harmonics of records with two periods or with periods left out. They are half as large as
        the aliases of a single period.
        """
        aliased = self.kept is not None or self.periods[0] == 2
        none = aliased & (frequency > ALIASED * self.recording.sample_rate)
        found = [hum for hum in (self.hum_th, self.hum_out) if hum is not None]
        return sum((hum.covers(frequency, self.whole_periods[0]) for hum in found), start=none)

    @property
    def step_th(self) -> float:
        """Converter step [V] of `v_th`; 0 if it is unknown."""
        return self.recording.samples["v_th"].resolution or 0.0

    @property
    def step_out(self) -> float:
        """Converter step [V] of `v_out`; 0 if it is unknown."""
        return self.recording.samples["v_out"].resolution or 0.0

    @functools.cached_property
    def noise_th(self) -> Float[np.ndarray, ""]:
        """Standard deviation of the noise of a sample of `whole_th` [V]."""
        return np.asarray(noise_std(self.whole_th, self.step_th))

    @functools.cached_property
    def noise_out(self) -> Float[np.ndarray, ""]:
        """Standard deviation of the noise of a sample of `whole_out` [V]."""
        return np.asarray(noise_std(self.whole_out, self.step_out))

    @functools.cached_property
    def sigma_th(self) -> Float[np.ndarray, ""]:
        """Standard deviation of the noise of a sample of `v_th` [V]."""
        if self.kept is None:
            return self.noise_th
        return np.asarray(noise_std(self.recorded_th, self.step_th))

    @functools.cached_property
    def sigma_out(self) -> Float[np.ndarray, ""]:
        """Standard deviation of the noise of a sample of `v_out` [V]."""
        if self.kept is None:
            return self.noise_out
        return np.asarray(noise_std(self.recorded_out, self.step_out))

    @functools.cached_property
    def trusted_th(self) -> Float[np.ndarray, ""]:
        """`sigma_th` as far as estimators trust it: not below the error of the interpolation."""
        return np.asarray(trusted(self.v_th, self.sigma_th))

    @functools.cached_property
    def trusted_out(self) -> Float[np.ndarray, ""]:
        """`sigma_out` as far as estimators trust it: not below the error of the interpolation."""
        return np.asarray(trusted(self.v_out, self.sigma_out))

    @property
    def remarks(self) -> Remark:
        """Remarks on how the recording is changed before a fit."""
        hum = self.hum_th is not None or self.hum_out is not None
        coarse = self.coarse_th > 0 or self.coarse_out > 0
        off = abs(self.train.counted / self.recording.pulse_rate - 1) > CLOCK
        found = Remark.mains_hum if hum else Remark(0)
        found |= Remark.periods_left_out if self.kept is not None else Remark(0)
        found |= Remark.coarse_converter if coarse else Remark(0)
        found |= Remark.aligned if self.lag else Remark(0)
        return found | (Remark.pulse_rate_counted if off else Remark(0))

    @functools.cached_property
    def correlated(self) -> float | None:
        """Lag of `v_out` [samples]; the load may add up to one sample. None if misaligned."""
        return lag_of(self.v_th, self.v_out, self.train)

    @functools.cached_property
    def lag(self) -> int:
        """Lag of `v_out` in whole samples; `v_out` is shifted by it before a fit."""
        return 0 if self.correlated is None else whole_lag(self.correlated)

    @property
    def aligned(self) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
        """Both voltages [V] in their overlap after the shift by `lag`."""
        return shifted(self.v_th, self.v_out, self.lag)

    @functools.cached_property
    def train(self) -> PulseTrain:
        """Pulse train of `v_th`."""
        return find_pulses(self.whole_th, self.recording.sample_rate, self.recording.pulse_rate)

    @functools.cached_property
    def pulse_rate(self) -> float:
        """Pulse rate [Hz], measured with the clock of the recording."""
        return self.train.counted

    @property
    def spacing(self) -> float:
        """Length of a pulse period [samples], from the measured pulse rate."""
        return self.recording.sample_rate / self.pulse_rate

    @functools.cached_property
    def whole_periods(self) -> tuple[int, int]:
        """Number of whole periods in the record, and their number of samples."""
        return whole_periods(self.whole_out.size, self.recording.sample_rate, self.pulse_rate)

    @property
    def periods(self) -> tuple[int, int]:
        """Number of periods in use, and their number of samples."""
        return self.whole_periods if self.kept is None else (self.kept.first.size, self.v_out.size)

    @functools.cached_property
    def is_periodic(self) -> bool:
        """Whether the record holds whole pulse periods, without a step from its end to its start.

        The length of the periods differs from whole samples by up to half a sample. This makes a
        step if the signal is steep at the joint.
        """
        periods, samples = self.periods
        if periods == 0:
            return False
        rest = abs(periods * self.spacing - samples) if self.kept is None else 1.0
        for v, sigma in ((self.v_th, self.trusted_th), (self.v_out, self.trusted_out)):
            joint = np.concatenate([v[samples - SEAM : samples], v[:SEAM]])
            if rest * np.abs(np.diff(joint)).max() > STEP * sigma:
                return False
        return True


def preflight(seen: Inspected, *, periodic: bool = False) -> str | None:
    """Name of the verdict that forbids a fit; None if a fit is allowed.

    Verdicts: `too_short`, `nonfinite_samples`, `flat`, `saturated`, `unconnected`,
    `rate_mismatch`, `misaligned`, `not_periodic`.

    Args:
        seen: The recording with its properties.
        periodic: Whether the fit needs whole pulse periods.
    """
    v_th, v_out, of = seen.v_th, seen.v_out, seen.recording
    if v_th.size < SHORTEST:
        return "too_short"
    if not (np.isfinite(v_th).all() and np.isfinite(v_out).all()):
        return "nonfinite_samples"
    if _is_flat(v_th, seen.sigma_th) or _is_flat(v_out, seen.sigma_out):
        return "flat"
    if _is_saturated(seen.recorded_th, seen.step_th, of):
        return "saturated"
    if _is_saturated(seen.recorded_out, seen.step_out, of):
        return "saturated"
    if _is_unconnected(seen):
        return "unconnected"
    if seen.train.mismatch:
        return "rate_mismatch"
    if np.var(v_out) > POWER * np.var(v_th) or seen.correlated is None:
        return "misaligned"
    if periodic and not seen.is_periodic:
        return "not_periodic"
    return None


def _is_flat(v: Float[np.ndarray, " time"], sigma: Float[np.ndarray, ""]) -> bool:
    span = np.ptp(v)
    return bool(span <= FLAT * sigma or span == 0)


def _is_saturated(v: Float[np.ndarray, " time"], step: float, recording: Recording) -> bool:
    """Whether samples are at a limit of the converter, or a flat top begins and ends in jumps."""
    if recording.adc_range is not None:
        low, high = recording.adc_range
        return bool((v <= low + step / 2).any() or (v >= high - step / 2).any())
    for extreme in (v.max(), v.min()):
        at_rail = v == extreme
        edges = np.flatnonzero(np.diff(np.concatenate([[0], at_rail.astype(np.int8), [0]])))
        for start, stop in edges.reshape(-1, 2):
            inside = start > 0 and stop < v.size
            if stop - start < RAIL or not inside:
                continue
            floor = step if step > 0 else np.ptp(v) / 2**16
            jump = min(abs(v[start - 1] - extreme), abs(v[stop] - extreme))
            if jump > JUMP * floor:
                return True
    return False


def _is_unconnected(seen: Inspected) -> bool:
    """Whether v_out equals v_th, except for noise, an offset and a delay below one sample."""
    x, y = (v - v.mean() for v in seen.aligned)
    variance = seen.sigma_th**2 + seen.sigma_out**2
    power = x @ x - x.size * seen.sigma_th**2
    if abs((x @ y) / power - 1) > EQUAL + STEP * math.sqrt(variance / power):
        return False
    late = np.gradient(x)
    rest = y - x
    rest = rest - late * ((late @ rest) / (late @ late))
    return bool(rest @ rest <= x.size * SAME * variance + LATE**2 * power)
