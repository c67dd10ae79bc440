"""Pre-flight: faults of a recording that can be detected before a fit."""

import functools
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from etid.recordings.group import Group, together
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.signals.averaging import Aliases, exact_spacing
from etid.signals.disturbances import Joint, Shifts
from etid.signals.harmonics import ALIASED, aliases, have_ended, joins_aliases
from etid.signals.lags import shifted, whole_lag
from etid.signals.mains import Hum
from etid.signals.noise import Noise
from etid.signals.pulse_train import PulseTrain


def _recorded(name: str) -> Any:
    """Property of `Group` for this recording, from its whole record."""
    return property(lambda self: getattr(self._group, name)[self._row])


def _in_use(name: str) -> Any:
    """Property of `Group` for this recording, from the periods in use."""
    return property(lambda self: getattr(self.used, name)[self.place])


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
    clocks_differ: bool = _recorded("clocks_differ")
    # From here on, of the periods in use, if some are left out or aligned.
    recorded: Float[np.ndarray, "2 time"] = _in_use("whole")
    quiet: Float[np.ndarray, "2 time"] = _in_use("quiet")
    sigma: Float[np.ndarray, "2"] = _in_use("noise")
    trusted: Float[np.ndarray, "2"] = _in_use("trusted")
    recorded_limits: Float[np.ndarray, "2 limit"] = _in_use("recorded_limits")
    limits: Float[np.ndarray, "2 limit"] = _in_use("limits")
    covariance: Float[np.ndarray, "2 2"] = _in_use("covariance")
    spans: Float[np.ndarray, "2"] = _in_use("spans")
    is_flat: Bool[np.ndarray, "2"] = _in_use("flat")
    begins: Float[np.ndarray, " period"] = _in_use("begins")
    refused: str | None = _in_use("refused")

    def __init__(self, recording: Recording, group: Group | None = None, row: int = 0) -> None:
        self.recording = recording
        self._group = group or Group([recording])
        self._row = row

    @functools.cached_property
    def kept(self) -> Joint | None:
        """The pulse periods in use if some are left out or aligned; None if all are used."""
        return self._group.kept[self._row]

    @functools.cached_property
    def used(self) -> Group:
        """A group with the periods in use."""
        return self._group if self.kept is None else self._group.joined(self._row, self.kept)

    @property
    def place(self) -> int:
        """Number of the recording in `_used`."""
        return self._row if self.kept is None else 0

    @property
    def whole_periods(self) -> tuple[int, int]:
        """Number of whole periods of the record, and their number of samples."""
        return self._group.periods

    @property
    def periods(self) -> tuple[int, int]:
        """The same of the periods in use."""
        return self.used.periods

    @property
    def correlated(self) -> float | None:
        """Lag of `v_out` [samples]; None if misaligned or if the rates are wrong."""
        lag = float(self.used.lags[self.place])
        return lag if math.isfinite(lag) else None

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
        if self.train.spacing is None or self.periods[0] < 2:
            return self.spacing
        of = self.used.cut(0).take(np.array([self.place]))
        return float(exact_spacing(of, self.used.counted_spacing[[self.place]])[0])

    @property
    def spectrum(self) -> tuple[np.ndarray, ...]:
        """The fields of an `etid.signals.harmonics.Spectrum` of both voltages."""
        frequency, *of_rows = self.used.spectra
        return frequency, *(field[self.place] for field in of_rows)

    @property
    def aliases(self) -> tuple[Aliases, Aliases] | None:
        """Aliases of both voltages that differ between the periods; None if there are none."""
        of = self.used.differing
        if not of.rows[self.place]:
            return None
        return of.of_cause.take(self.place), of.of_out.take(self.place)

    @property
    def noise(self) -> Noise:
        """The noise of both voltages at each harmonic; less than a period is taken for one."""
        return Noise(*(of[self.place] for of in self.used.noise_of_quiet))

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
        return bool(self.used.periodic[self.place])


def preflight(inspected: Inspected, *, periodic: bool = False) -> str | None:
    """Name of the verdict that forbids a fit; None if a fit is allowed.

    Args:
        inspected: The recording with its properties.
        periodic: Whether the fit needs whole pulse periods.
    """
    name = inspected.refused
    return "not_periodic" if name is None and periodic and not inspected.is_periodic else name


def inspected(recordings: Sequence[Recording]) -> list[Inspected]:
    """Recordings of equal length and rates, inspected together."""
    found: dict[int, Inspected] = {}
    for group, rows in together(recordings):
        for place, row in enumerate(rows):
            found[row] = Inspected(recordings[row], group, place)
    return [found[row] for row in range(len(recordings))]
