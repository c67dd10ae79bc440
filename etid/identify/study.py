"""Identification of whole studies: every driver from its calibrations, every loaded recording."""

import dataclasses
import functools
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from etid.estimators.registry import Method
from etid.identify.arguments import require
from etid.identify.batches import choices, of_one_circuit
from etid.identify.driver import calibrated
from etid.identify.options import Circuit, Interval, Options, candidates_of
from etid.identify.planning import Load
from etid.precision import in_float64
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fit import Fit, IdentificationError
from etid.results.fits import Fits
from etid.results.fits_columns import described
from etid.results.instrument import Instrument
from etid.results.provenance import PLAUSIBLE
from etid.results.study_fits import StudyFits
from etid.results.tried_orders import Order
from etid.selection.common import common

SAMPLE = 200  # recordings that choose the circuit of a study; a second of work


@in_float64
def identify_study(
    study: Study,
    *,
    order: Order = 5,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    driver_drift: float = 0.0,
    instrument: Instrument | None = None,
    plausible: tuple[float, float] = PLAUSIBLE,
    progress: bool = False,
) -> StudyFits:
    """Identify every driver of a study from its calibrations, then every loaded recording.

    If a recording names no calibration, the only calibration of the study is used. If the study
    has several, the recording gets the verdict `unreadable`. Recordings that cannot be read
    (`study.problems`) come last and get this verdict too.

    Args:
        study: Calibrations and loaded recordings.
        order: As in `identify_driver`.
        circuit: As in `identify_skins`.
        method: As in `identify_skin`.
        fixed: As in `identify_skin`, for all recordings.
        prior: As in `identify_skin`, for all recordings.
        bounds: As in `identify_skin`, for all recordings.
        driver_drift: As in `identify_driver`.
        instrument: As in `identify_driver`.
        plausible: As in `identify_driver`.
        progress: Show a progress bar.

    Returns:
        One fit for each loaded recording, and the drivers.

    Raises:
        ValueError: There is no loaded recording, or the method cannot use this circuit.
    """
    require("study", study, Study)
    options = Options.of(
        candidates_of(circuit),
        method=method,
        fixed=fixed,
        prior=prior,
        bounds=bounds,
        order=order,
        driver_drift=driver_drift,
        instrument=instrument,
        plausible=plausible,
    )
    drivers = Drivers(study, options)
    count = len(drivers.paths)
    options = common_first(drivers, options)
    fits = identify_part(drivers, drivers.paths, options, count, progress)
    return StudyFits(fits, drivers.found, drivers.failures, options.settings(study, count))


def common_first(drivers: "Drivers", options: Options) -> Options:
    """The options; the first circuit is the common one of a sample of the recordings."""
    circuits, paths = options.circuits, drivers.paths
    if len(circuits) == 1:
        return options
    step = -(-len(paths) // SAMPLE)
    sample = paths[::step]
    found, _ = choices(len(sample), drivers.loader(sample), options, False, len(paths))
    first = circuits[common(found, circuits)]
    others = (one for one in circuits if one is not first)
    return dataclasses.replace(options, circuits=(first, *others))


def identify_part(
    drivers: "Drivers", paths: Sequence[str], options: Options, total: int, progress: bool = False
) -> Fits:
    """Fits of some of `total` recordings of a study, with the first of the circuits."""
    load = drivers.loader(paths)
    fit, notes = of_one_circuit(len(paths), load, options, progress, total, chosen=0)
    return table([fields_of(drivers.study, path) for path in paths], fit, notes)


def table(fields: Sequence[Mapping[str, Any]], fit: Fit, notes: Sequence[str]) -> Fits:
    """Fits, stacked, with the fields of their recordings."""
    return Fits(fit, described(fields), np.array(notes, dtype=str))


def fields_of(study: Study, path: str) -> dict[str, Any]:
    """The fields of a recording; only its path if it cannot be read."""
    try:
        return vars(study.metadata(path))
    except RecordingError:
        return {"path": path}


class Drivers:
    """The drivers of a study; each is identified when its first recording needs it.

    Attributes:
        found: The identified drivers. The keys are the paths of their calibrations.
        failures: Reasons why a driver could not be identified. The keys are the paths of its
            calibrations.
    """

    def __init__(self, study: Study, options: Options) -> None:
        self.study = study
        self.options = options
        self.calibrations = tuple(study.calibrations)
        self.found: dict[tuple[str, ...], Driver] = {}
        self.failures: dict[tuple[str, ...], str] = {}
        self._one_at_a_time = threading.Lock()

    @functools.cached_property
    def paths(self) -> list[str]:
        """Paths of all loaded recordings, then of all recordings that cannot be read.

        Raises:
            ValueError: There is none.
        """
        if paths := [*self.study.loaded, *self.study.problems]:
            return paths
        raise ValueError("the study has no loaded recording")

    def loader(self, paths: Sequence[str]) -> Load:
        """A function that reads the recordings of these paths, as in `fed`."""
        return lambda row: self.fed(self.study[paths[row]])

    def fed(self, recording: Recording) -> tuple[Recording, AbstractFeed]:
        """A recording and its driver; or its measured current, if it has no calibration.

        Raises:
            RecordingError: As in `of`.
            IdentificationError: As in `of`.
        """
        calibrated = recording.calibration or self.calibrations
        if recording.cause == "current" or ("current" in recording.samples and not calibrated):
            return recording.without_v_th(), MEASURED_CURRENT
        return recording, self.found[self.of(recording)]

    def of(self, recording: Recording) -> tuple[str, ...]:
        """Paths of the calibrations of a recording; their driver is then in `found`.

        Raises:
            RecordingError: The recording names no calibration, and the study does not have exactly
                one.
            IdentificationError: The driver could not be identified.
        """
        names = recording.calibration or self.calibrations
        if not recording.calibration and len(self.calibrations) != 1:
            raise RecordingError(
                f"names no calibration and the study has {len(self.calibrations)}",
                path=recording.path,
                field="calibration",
                remedy="Write the path of its calibration into the attribute 'calibration'"
                if self.calibrations
                else "Add a recording of a known resistor: etid import --calibration FILE OHM",
            )
        with self._one_at_a_time:
            if names not in self.found and names not in self.failures:
                self._identify(names)
        if names in self.failures:
            raise IdentificationError(self.failures[names], None)
        return names

    def _identify(self, names: tuple[str, ...]) -> None:
        try:
            records = [self.study[name] for name in names]
            self.found[names] = calibrated(records, self.options, throw=False)
        except (IdentificationError, ValueError, KeyError) as error:
            self.failures[names] = str(error)
