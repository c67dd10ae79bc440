"""Pre-flight: faults of a recording that can be detected before a fit."""

import functools
import math

import numpy as np
from jaxtyping import Bool, Float

from etid.recordings.group import BY_CHANCE, Group, covariance_of
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.signals.aliases import aliases
from etid.signals.clipping import is_clipped, is_command
from etid.signals.disturbances import Joint, Shifts
from etid.signals.filtering import TAPS
from etid.signals.harmonics import ALIASED, joins_aliases
from etid.signals.mains import Hum
from etid.signals.pulse_train import PulseTrain, rise_time, shifted, whole_lag

SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit


class Inspected:
    """A recording and its properties that need no model; each is computed once, when it is used.

    An axis of length 2 holds `v_th` and `v_out`, as in `Group`. In a recording of a measured
    current, the current is in the place of `v_th`.

    Args:
        recording: The recording.
        group: Recordings that are inspected together with this one; only this one if not given.
        row: Number of the recording in the group.

    Attributes:
        recording: The recording.
    """

    def __init__(self, recording: Recording, group: Group | None = None, row: int = 0) -> None:
        self.recording = recording
        self._group = group or Group([recording])
        self._row = row

    @property
    def has_current(self) -> bool:
        """Whether the load is identified from the measured current."""
        return self.recording.cause == "current"

    @functools.cached_property
    def by_current(self) -> "Inspected | None":
        """The recording without `v_th`, with the current as the cause; None if it has not both."""
        of = self.recording
        both = not self.has_current and "current" in of.samples
        return Inspected(of.without_v_th()) if both else None

    @property
    def has_all(self) -> bool:
        """Whether `v_th`, `v_out` and the current have the same periods, all in use."""
        other = self.by_current
        if other is None or self.kept is not None or other.kept is not None:
            return False
        return self.periods == other.periods

    @property
    def v_th(self) -> Float[np.ndarray, " time"]:
        """Unloaded voltage [V] of the periods in use, without hum between the harmonics."""
        return self.quiet[0]

    @property
    def v_out(self) -> Float[np.ndarray, " time"]:
        """Loaded voltage [V] of the periods in use, without hum between the harmonics."""
        return self.quiet[1]

    @functools.cached_property
    def kept(self) -> Joint | None:
        """The pulse periods in use if some are left out or aligned; None if all are used."""
        return self._group.kept[self._row]

    @property
    def shifts(self) -> Shifts | None:
        """The shifts of the periods of `v_out` against those of `v_th`; None if there are none."""
        return self._group.shifts[self._row]

    @functools.cached_property
    def _used(self) -> Group:
        """A group with the periods in use."""
        return self._group if self.kept is None else self._group.joined(self._row, self.kept)

    @property
    def _place(self) -> int:
        """Number of the recording in `_used`."""
        return self._row if self.kept is None else 0

    @property
    def quiet(self) -> Float[np.ndarray, "2 time"]:
        """Voltages [V] of the periods in use, without hum between the harmonics."""
        return self._used.quiet[self._place]

    @property
    def recorded(self) -> Float[np.ndarray, "2 time"]:
        """Voltages [V] of the periods in use as they were recorded."""
        return self._used.whole[self._place]

    @property
    def begins(self) -> Float[np.ndarray, " period"]:
        """Start of each period of `v_th` [samples]."""
        return self.spacing * np.arange(self.periods[0]) if self.kept is None else self.kept.begins

    @property
    def coarse(self) -> Float[np.ndarray, "2"]:
        """Converter steps [V] that exceed the noise, else 0."""
        return self._group.coarse[self._row]

    @property
    def hum(self) -> list[Hum | None]:
        """Hum that is subtracted from each voltage; None if there is none."""
        return self._group.hum[self._row]

    @property
    def hums(self) -> bool:
        """Whether hum is subtracted from one of the voltages."""
        return any(hum is not None for hum in self.hum)

    def covered(self, frequency: Float[np.ndarray, " harmonic"]) -> Bool[np.ndarray, " harmonic"]:
        """Whether each harmonic is unusable because of hum or aliases.

        Hum covers a harmonic if the subtraction does not remove it there. Aliases cover the high
        harmonics of records with two periods or with periods left out. They are half as large as
        the aliases of a single period.
        """
        aliased = self.kept is not None or self.periods[0] == 2
        covered = aliased & (frequency > ALIASED * self.recording.sample_rate)
        for hum in self.hum:
            if hum is not None:
                covered = covered | hum.covers(frequency, self.whole_periods[0])
        return covered

    @property
    def step(self) -> Float[np.ndarray, "2"]:
        """Converter steps [V]; 0 if unknown."""
        return self._group.step[self._row]

    @property
    def sigma(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of the noise of a sample [V]."""
        return self._used.noise[self._place]

    @property
    def recorded_limits(self) -> Float[np.ndarray, "2 limit"]:
        """Smallest and largest sample of each voltage as it was recorded [V]."""
        return self._used.recorded_limits[self._place]

    @property
    def limits(self) -> Float[np.ndarray, "2 limit"]:
        """Smallest and largest sample of `v_th` and of `v_out` [V]."""
        return self._used.limits[self._place]

    @property
    def spans(self) -> Float[np.ndarray, "2"]:
        """Peak-to-peak values of `v_th` and of `v_out` [V]."""
        return self.limits[:, 1] - self.limits[:, 0]

    @property
    def is_flat(self) -> Bool[np.ndarray, "2"]:
        """Whether `v_th` and `v_out` carry no signal: eight standard deviations span them."""
        return (self.spans <= 8 * self.sigma) | (self.spans == 0)

    @property
    def covariance(self) -> Float[np.ndarray, "2 2"]:
        """Covariance of `v_th` and `v_out` [V²]."""
        return self._used.covariance[self._place]

    @property
    def trusted(self) -> Float[np.ndarray, "2"]:
        """`sigma` as far as estimators trust it: not below the error of the interpolation."""
        return self._used.trusted[self._place]

    @property
    def flickers(self) -> Bool[np.ndarray, "2"]:
        """Whether `v_th` and `v_out` may have 1/f noise."""
        return self._used.flickers[self._place]

    @property
    def remarks(self) -> Remark:
        """Remarks on how the recording is changed before a fit."""
        # A clock is not more than 300 ppm wrong.
        off = abs(self.train.counted / self.recording.pulse_rate - 1) > 3e-4
        found = Remark.mains_hum if self.hums else Remark(0)
        fewer = self.periods[0] < self.whole_periods[0]
        found |= Remark.periods_left_out if fewer else Remark(0)
        found |= Remark.periods_shifted if self.shifts is not None else Remark(0)
        found |= Remark.coarse_converter if self.coarse.any() else Remark(0)
        found |= Remark.aligned if self.lag or self.current_lag else Remark(0)
        return found | (Remark.pulse_rate_counted if off else Remark(0))

    @property
    def correlated(self) -> float | None:
        """Lag of `v_out` [samples]; the load may add up to one sample. None if misaligned."""
        return self._used.lags[self._place]

    @functools.cached_property
    def lag(self) -> int:
        """Lag of `v_out` in whole samples; `v_out` is shifted by it before a fit.

        It is 0 for a measured current: one instrument records both, and the voltage at a capacitor
        shows no edge where the current has one.
        """
        return 0 if self.has_current or self.correlated is None else whole_lag(self.correlated)

    @property
    def current_lag(self) -> int:
        """Lag of the current behind `v_th` [whole samples].

        It is that of `v_out`: one instrument records both. A fit finds what is left (`realign`).
        """
        return self.lag - (self.by_current.lag if self.by_current is not None else 0)

    def realign(self, v_out: int, current: int) -> None:
        """Add whole samples to the lags of `v_out` and of a current beside it."""
        if self.by_current is not None:
            self.by_current.lag += v_out - current
        self.lag += v_out

    @property
    def aligned(self) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
        """Both voltages [V] in their overlap after the shift by `lag`."""
        return shifted(self.v_th, self.v_out, self.lag)

    @property
    def train(self) -> PulseTrain:
        """Pulse train of `v_th`."""
        return self._group.trains[self._row]

    @functools.cached_property
    def pulse_rate(self) -> float:
        """Pulse rate [Hz], measured with the clock of the recording."""
        return self.train.counted

    @property
    def spacing(self) -> float:
        """Length of a pulse period [samples], from the measured pulse rate."""
        return self.recording.sample_rate / self.pulse_rate

    @property
    def whole_periods(self) -> tuple[int, int]:
        """Number of whole periods in the record, and their number of samples."""
        return self._group.whole_periods[self._row]

    @property
    def periods(self) -> tuple[int, int]:
        """Number of periods in use, and their number of samples."""
        return self._used.whole_periods[self._place]

    @property
    def spectrum(self) -> tuple[np.ndarray, ...]:
        """The fields of an `etid.signals.harmonics.Spectrum` of both voltages; white noise."""
        frequency, *of_rows, selected = self._used.spectra(*self.periods)
        return frequency, *(field[self._place] for field in of_rows), selected

    @property
    def is_aliased(self) -> bool:
        """Whether aliases of unknown size fall on the harmonics of `v_th`, above its noise."""
        if not joins_aliases(*self.periods):
            return False
        _, x, _, variance, *_ = self.spectrum
        return aliases(x, variance, *self.periods).are_unknown(variance)

    @property
    def is_periodic(self) -> bool:
        """Whether the record holds whole pulse periods, without a step from its end to its start.

        If periods are left out, each begins at a whole sample, up to one sample from its place.
        """
        return bool(self._used.periodic[self._place])


def preflight(inspected: Inspected, *, periodic: bool = False) -> str | None:
    """Name of the verdict that forbids a fit; None if a fit is allowed.

    Verdicts: `too_short`, `nonfinite_samples`, `flat`, `saturated`, `wrong_unit`, `unconnected`,
    `rate_mismatch`, `misaligned`, `not_periodic`.

    Args:
        inspected: The recording with its properties.
        periodic: Whether the fit needs whole pulse periods.
    """
    of = inspected.recording
    shortest = max(SHORTEST, rise_time(of.sample_rate) + 1)
    if of.samples["v_out"].stored.size < shortest or inspected.v_th.size < shortest:
        return "too_short"
    if not np.isfinite(inspected.limits).all():
        return "nonfinite_samples"
    if inspected.is_flat.any():
        return "flat"
    # A current source holds its current, so a flat top of the current is no fault without noise.
    held = inspected.has_current and is_command(
        float(inspected.sigma[0]), float(inspected.step[0]), float(inspected.spans[0])
    )
    may_clip = not held, True
    volts = None if inspected.has_current else of.adc_range, of.adc_range
    records = inspected.recorded, inspected.recorded_limits, inspected.step
    for checked, v, limits, step, adc_range in zip(may_clip, *records, volts, strict=True):
        if checked and _is_saturated(v, limits, step, adc_range):
            return "saturated"
    if inspected.has_current and not is_plausible(inspected.spans[1], inspected.spans[0]):
        return "wrong_unit"
    if not inspected.has_current and _is_unconnected(inspected):
        return "unconnected"
    if inspected.train.mismatch:
        return "rate_mismatch"
    if _is_misaligned(inspected) or (inspected.shifts is not None and inspected.kept is None):
        return "misaligned"
    if periodic and not inspected.is_periodic:
        return "not_periodic"
    return None


def is_plausible(voltage: float, current: float) -> bool:
    """Whether the peak-to-peak v_out [V] and current [A] are those of a load at an electrode.

    Stimulators of nerves and skin stay below 0.1 A in each direction. Electrodes in saline have
    100 Ω, patches of membrane in a pipette 10 GΩ.
    """
    return bool(current <= 0.25 and 1.0 <= voltage / current <= 1e12)


def _is_misaligned(inspected: Inspected) -> bool:
    if inspected.has_current:  # a passive load takes power
        return bool(inspected.covariance[0, 1] <= 0)
    covariance = inspected.covariance
    return bool(covariance[1, 1] > 1.01 * covariance[0, 0] or inspected.correlated is None)


def _is_saturated(
    v: Float[np.ndarray, " time"],
    limits: Float[np.ndarray, " limit"],
    step: float,
    adc_range: tuple[float, float] | None,
) -> bool:
    """Whether samples are at a limit of the converter, or at a rail if its range is unknown."""
    if adc_range is not None:
        low, high = adc_range
        return bool(limits[0] <= low + step / 2 or limits[1] >= high - step / 2)
    return is_clipped(v, step)


def _is_unconnected(inspected: Inspected) -> bool:
    """Whether v_out equals v_th, except for noise, an offset and a delay below one sample."""
    covariance = (
        covariance_of(np.stack(inspected.aligned)) if inspected.lag else inspected.covariance
    )
    squares = inspected.sigma**2
    variance, power = squares.sum(), covariance[0, 0] - squares[0]
    if power <= 0:  # nothing but noise; or squares that are too small for a number
        return False
    size = inspected.aligned[0].size
    limit = 1e-3 + BY_CHANCE * math.sqrt(variance / (size * power))
    if abs(covariance[0, 1] / power - 1) > limit:
        return False
    x, y = (v - v.mean() for v in inspected.aligned)
    slope = np.gradient(x)
    rest = y - x
    rest = rest - slope * ((slope @ rest) / (slope @ slope))
    # A delay of 0.1 sample leaves up to 0.5 % of the signal at the edges.
    return bool(rest @ rest <= size * (1.5 * variance + 5e-3**2 * power))
