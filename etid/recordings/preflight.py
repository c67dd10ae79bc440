"""Pre-flight: faults of a recording that can be detected before a fit."""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from etid.recordings.group import BY_CHANCE, Group, covariance_of
from etid.recordings.recording import Recording, quietly
from etid.recordings.remarks import Remark
from etid.signals.averaging import Aliases
from etid.signals.clipping import is_clipped, is_command, is_limited
from etid.signals.disturbances import Joint, Shifts
from etid.signals.filtering import TAPS
from etid.signals.harmonics import ALIASED, aliases, have_ended, joins_aliases
from etid.signals.mains import Hum
from etid.signals.noise import Noise
from etid.signals.pulse_train import (
    PulseTrain,
    exact_spacing,
    largest_drift,
    rise_time,
    shifted,
    whole_lag,
)

SHORTEST = 4 * TAPS + 104  # [samples] edges of the interpolation, and 104 samples for the fit


def _recorded(name: str) -> Any:
    """Property of `Group` for this recording, from its whole record."""
    return property(lambda self: getattr(self._group, name)[self._row])


def _in_use(name: str) -> Any:
    """Property of `Group` for this recording, from the periods in use."""
    return property(lambda self: getattr(self._used, name)[self._place])


class Inspected:
    """One recording of a `Group`: its row of the group's properties, and what needs only it.

    An axis of length 2 holds `v_th` and `v_out`, as in `Group`. In a recording of a measured
    current, the current is in the place of `v_th`.

    Args:
        recording: The recording.
        group: Recordings that are inspected together with this one; only this one if not given.
        row: Number of the recording in the group.
    """

    train: PulseTrain = _recorded("trains")
    step: Float[np.ndarray, "2"] = _recorded("step")
    coarse: Float[np.ndarray, "2"] = _recorded("coarse")
    hum: list[Hum | None] = _recorded("hum")
    shifts: Shifts | None = _recorded("shifts")
    apart: float = _recorded("apart")
    whole_periods: tuple[int, int] = _recorded("whole_periods")
    # From here on, of the periods in use, if some are left out or aligned.
    recorded: Float[np.ndarray, "2 time"] = _in_use("whole")
    quiet: Float[np.ndarray, "2 time"] = _in_use("quiet")
    sigma: Float[np.ndarray, "2"] = _in_use("noise")
    trusted: Float[np.ndarray, "2"] = _in_use("trusted")
    recorded_limits: Float[np.ndarray, "2 limit"] = _in_use("recorded_limits")
    limits: Float[np.ndarray, "2 limit"] = _in_use("limits")
    covariance: Float[np.ndarray, "2 2"] = _in_use("covariance")
    correlated: float | None = _in_use("lags")
    periods: tuple[int, int] = _in_use("whole_periods")

    def __init__(self, recording: Recording, group: Group | None = None, row: int = 0) -> None:
        self.recording = recording
        self._group = group or Group([recording])
        self._row = row

    @functools.cached_property
    def kept(self) -> Joint | None:
        """The pulse periods in use if some are left out or aligned; None if all are used."""
        return self._group.kept[self._row]

    @functools.cached_property
    def _used(self) -> Group:
        """A group with the periods in use."""
        return self._group if self.kept is None else self._group.joined(self._row, self.kept)

    @property
    def _place(self) -> int:
        """Number of the recording in `_used`."""
        return self._row if self.kept is None else 0

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

    @property
    def begins(self) -> Float[np.ndarray, " period"]:
        """Start of each period of `v_th` [samples]."""
        if self.kept is not None:
            return self.kept.begins
        return self._group.spacing(self._row) * np.arange(self.periods[0])

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

    @functools.cached_property
    def spans(self) -> Float[np.ndarray, "2"]:
        """Peak-to-peak values of `v_th` and of `v_out` [V]; infinite if they overflow."""
        with quietly():
            return self.limits[:, 1] - self.limits[:, 0]

    @property
    def is_flat(self) -> Bool[np.ndarray, "2"]:
        """Whether `v_th` and `v_out` carry no signal: eight standard deviations span them.

        Noise spans more in a long record, but its variance is then known better.
        """
        noise = np.diagonal(self.covariance) <= 1.2 * self.sigma**2
        return (self.spans <= 8 * self.sigma) | noise | (self.spans == 0)

    @property
    def clocks_differ(self) -> bool:
        """Whether `v_out` drifts away from `v_th` from pulse to pulse."""
        largest = largest_drift(self.recording.sample_rate)
        return not self.has_current and bool(abs(self.apart) > largest)

    @property
    def remarks(self) -> Remark:
        """Remarks on how the recording is changed before a fit."""
        counted = abs(self.train.counted / self.recording.pulse_rate - 1)
        found = {
            Remark.mains_hum: self.hums,
            Remark.periods_left_out: self.periods[0] < self.whole_periods[0],
            Remark.periods_shifted: self.shifts is not None,
            Remark.coarse_converter: self.coarse.any(),
            Remark.aligned: self.lag or self.current_lag,
            Remark.pulse_rate_counted: counted > 3e-4,  # a clock is not more than 300 ppm wrong
        }
        return functools.reduce(operator.or_, (r for r, holds in found.items() if holds), Remark(0))

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

    @functools.cached_property
    def pulse_rate(self) -> float:
        """Pulse rate [Hz], measured with the clock of the recording."""
        return self.train.counted

    @property
    def spacing(self) -> float:
        """Length of a pulse period [samples], from the measured pulse rate."""
        return self.recording.sample_rate / self.pulse_rate

    @property
    def exact_spacing(self) -> float:
        """`spacing`, or the length that the phases of the pulses in use surely have [samples]."""
        if self.train.spacing is None:
            return self.spacing
        known = int(self.train.edges[0]), self.spacing, self.periods[0]
        return float(exact_spacing(self.v_th[None], *known)[0])

    @property
    def spectrum(self) -> tuple[np.ndarray, ...]:
        """The fields of an `etid.signals.harmonics.Spectrum` of both voltages."""
        frequency, *of_rows = self._used.spectra(*self.periods)
        return frequency, *(field[self._place] for field in of_rows)

    @property
    def aliases(self) -> tuple[Aliases, Aliases] | None:
        """Aliases of both voltages that differ between the periods; None if there are none."""
        return self._used.aliases(self._place)

    @property
    def noise(self) -> Noise:
        """The noise of both voltages at each harmonic; less than a period is taken for one."""
        periods, samples = self.periods if self.periods[0] else (1, self.quiet.shape[1])
        return Noise(*(of[self._place] for of in self._used.noise_of_quiet(periods, samples)))

    @property
    def is_aliased(self) -> bool:
        """Whether aliases of unknown size fall on the harmonics of `v_th`, above its noise."""
        if not joins_aliases(*self.periods) or self.has_no_aliases:
            return False
        _, x, _, variance, *_ = self.spectrum
        return aliases(x, variance, *self.periods).are_unknown(variance)

    @property
    def has_no_aliases(self) -> bool:
        """Whether the spectra of a current and of `v_out` surely end below half the sample rate."""
        _, x, y, variance_x, variance_y, _ = self.spectrum
        return self.has_current and have_ended((x, y), (variance_x, variance_y), *self.periods)

    @property
    def is_periodic(self) -> bool:
        """Whether the record holds whole pulse periods, without a step from its end to its start.

        If periods are left out, each begins at a whole sample, up to one sample from its place.
        """
        return bool(self._used.periodic[self._place])


@quietly()
def preflight(inspected: Inspected, *, periodic: bool = False) -> str | None:
    """Name of the verdict that forbids a fit; None if a fit is allowed.

    Args:
        inspected: The recording with its properties.
        periodic: Whether the fit needs whole pulse periods.
    """
    for verdict, applies in _VERDICTS.items():
        if (periodic or verdict != "not_periodic") and applies(inspected):
            return verdict
    return None


def _is_too_short(inspected: Inspected) -> bool:
    of = inspected.recording
    shortest = max(SHORTEST, rise_time(of.sample_rate) + 1)
    return of.samples["v_out"].stored.size < shortest or inspected.v_th.size < shortest


def _is_implausible(inspected: Inspected) -> bool:
    return inspected.has_current and not is_plausible(inspected.spans[1], inspected.spans[0])


def is_plausible(voltage: float, current: float) -> bool:
    """Whether the peak-to-peak v_out [V] and current [A] are those of a load at an electrode.

    Stimulators of nerves and skin stay below 0.1 A and 500 V in each direction. Electrodes in
    saline have 100 Ω, patches of membrane in a pipette 10 GΩ.
    """
    return bool(current <= 0.25 and voltage <= 2e3 and 1.0 <= voltage / current <= 1e12)


def _is_misaligned(inspected: Inspected) -> bool:
    if inspected.shifts is not None and inspected.kept is None:
        return True
    covariance = inspected.covariance
    if inspected.has_current:  # a passive load takes power
        return bool(covariance[0, 1] <= 0)
    return bool(covariance[1, 1] > 1.01 * covariance[0, 0] or inspected.correlated is None)


def _is_saturated(inspected: Inspected) -> bool:
    """Whether samples are at a limit of the converter, or at a rail of unknown place."""
    # A current source holds its current, so a flat top of the current is no fault without noise.
    held = inspected.has_current and is_command(
        float(inspected.sigma[0]), float(inspected.step[0]), float(inspected.spans[0])
    )
    for which, (v, (lowest, highest), step) in enumerate(
        zip(inspected.recorded, inspected.recorded_limits, inspected.step, strict=True)
    ):
        adc_range = inspected.recording.adc_range
        if which == 0 and inspected.has_current:
            adc_range = None  # it is one of volts
        if which == 0 and held:
            continue
        if adc_range is None:
            if is_clipped(v, step):
                return True
        elif lowest <= adc_range[0] + step / 2 or highest >= adc_range[1] - step / 2:
            return True
    return _is_limited(inspected)


def _is_limited(inspected: Inspected) -> bool:
    """Whether v_out stays at a level while v_th moves.

    A measured current shows no such thing: a stimulator that holds its voltage is no fault.
    """
    if inspected.has_current or inspected.correlated is None:
        return False
    unit = float(max(inspected.sigma[1], inspected.step[1], inspected.coarse[1]))
    v_th, v_out = inspected.recorded
    v_th, v_out = shifted(v_th, v_out, inspected.lag)
    return unit > 0 and is_limited(v_th, v_out, unit, inspected.recording.sample_rate)


def _is_unconnected(inspected: Inspected) -> bool:
    """Whether v_out equals v_th, except for noise, an offset and a delay below one sample."""
    if inspected.has_current:
        return False
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


# The first that applies is given.
_VERDICTS: dict[str, Callable[[Inspected], bool]] = {
    "too_short": _is_too_short,
    "nonfinite_samples": lambda of: not np.isfinite([*of.limits, of.spans]).all(),
    "flat": lambda of: bool(of.is_flat.any()),
    "saturated": _is_saturated,
    "wrong_unit": _is_implausible,
    "unconnected": _is_unconnected,
    "rate_mismatch": lambda of: of.train.mismatch != "" or of.clocks_differ,
    "misaligned": _is_misaligned,
    "not_periodic": lambda of: not of.is_periodic,
}
