"""Pre-flight: what a fit asks of one recording, and the fault that forbids it."""

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from etid.recordings.inspection import Inspection, together
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.signals.averaging import Aliases
from etid.signals.bins import Bins, bins
from etid.signals.lags import shifted
from etid.signals.noise import Noise, floor


class Inspected:
    """A recording and its row of an `Inspection`: it has all properties of the inspection there.

    A fit may correct the lags, so each recording has its own.

    Args:
        inspection: Recordings that are inspected together with this one.
        row: Its row there.
        by_current: The same without `v_th`, with the current as the cause; None if it has not both.
    """

    def __init__(
        self, inspection: Inspection, row: int = 0, by_current: "Inspected | None" = None
    ) -> None:
        self.inspection, self.row, self.by_current = inspection, row, by_current
        self.recording = inspection.recordings[row]

    @classmethod
    def of(cls, recording: Recording) -> "Inspected":
        """A recording that is inspected alone."""
        (seen,) = inspected([recording])
        return seen

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.inspection, name)[self.row]
        return found.item() if isinstance(found, np.generic) else found

    @property
    def whole_periods(self) -> tuple[int, int]:
        """Number of whole periods of the record, and their number of samples."""
        return self.inspection.whole_periods

    @property
    def periods(self) -> tuple[int, int]:
        """The same of the periods in use."""
        return self.inspection.periods

    @property
    def has_current(self) -> bool:
        """Whether the load is identified from the measured current."""
        return self.inspection.has_current

    @property
    def has_all(self) -> bool:
        """Whether `v_th`, `v_out` and the current have the same periods, all in use."""
        other = self.by_current
        if other is None or self.kept is not None or other.kept is not None:
            return False
        if self.recording.filters is not None:
            return False  # V_th, which V_out has its filter in common with, has another one
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
    def remarks(self) -> Remark:
        """Remarks on how the recording is changed before a fit."""
        aligned = Remark.aligned if self.lag or self.current_lag else 0
        return Remark(self.inspection.remarks[self.row].item() | aligned)

    @functools.cached_property
    def lag(self) -> int:
        """Lag of `v_out` in whole samples; `v_out` is shifted by it before a fit."""
        return self.inspection.lag[self.row].item()

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
        vars(self).pop("bins", None)

    @property
    def aligned(self) -> tuple[Float[np.ndarray, " overlap"], Float[np.ndarray, " overlap"]]:
        """Both voltages [V] in their overlap after the shift by `lag`."""
        return shifted(self.v_th, self.v_out, self.lag)

    @functools.cached_property
    def bins(self) -> Bins:
        """Both voltages at the bins of their overlap."""
        return self.bins_of_first(self.aligned[0].size)

    def bins_of_first(self, samples: int) -> Bins:
        """The same of the first samples of their overlap."""
        periods, (v_th, v_out) = self.periods, self.aligned
        return bins(
            np.stack([v_th[:samples], v_out[:samples]]),
            self.recording.sample_rate,
            (self.noise, *periods) if periods[0] > 1 else None,
            np.asarray(floor(self.limits, self.inspection.step[self.row])),
            np.asarray(self.coarse),
            self.is_held or (periods[0] > 0 and self.has_no_aliases),
            self.has_current,
            self.is_held,
        )

    @property
    def is_held(self) -> bool:
        """Whether a converter holds the cause of `v_out` between its samples."""
        return bool(self.inspection.held[self.row])

    @property
    def is_whole(self) -> bool:
        """Whether the recording holds whole periods whose aliases are known."""
        known = self.is_periodic and not self.is_held
        return known and (self.periods[0] > 1 or self.has_no_aliases)

    @property
    def spectrum(self) -> tuple[np.ndarray, ...]:
        """The fields of an `etid.signals.harmonics.Spectrum` of both voltages."""
        frequency, *of_rows = self.inspection.spectrum
        return frequency, *(field[self.row] for field in of_rows)

    @property
    def aliases(self) -> tuple[Aliases, Aliases] | None:
        """Aliases of both voltages that differ between the periods; None if there are none."""
        of = self.inspection.differing
        if not of.rows[self.row]:
            return None
        return of.of_cause.take(self.row), of.of_out.take(self.row)

    @property
    def noise(self) -> Noise:
        """The noise of both voltages at each harmonic; less than a period is taken for one."""
        return Noise(*(of[self.row] for of in self.inspection.noise))


def preflight(seen: Inspected, *, periodic: bool = False) -> str | None:
    """Name of the verdict that forbids a fit; None if a fit is allowed.

    Args:
        seen: The recording with its properties.
        periodic: Whether the fit needs whole pulse periods.
    """
    name = seen.refused
    return "not_periodic" if name is None and periodic and not seen.is_periodic else name


def inspected(recordings: Sequence[Recording]) -> list[Inspected]:
    """Recordings of equal length and rates, inspected together."""
    both = [
        row
        for row, one in enumerate(recordings)
        if one.cause != "current" and "current" in one.samples
    ]
    currents = inspected([recordings[row].without_v_th() for row in both]) if both else []
    by_current = dict(zip(both, currents, strict=True))
    found: dict[int, Inspected] = {}
    for inspection, rows in together(recordings):
        for place, row in enumerate(rows):
            found[row] = Inspected(*inspection.in_use(place), by_current.get(row))
    return [found[row] for row in range(len(recordings))]
