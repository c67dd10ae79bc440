"""Identification of many recordings behind one driver, and of whole studies."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, Unpack, overload

import numpy as np

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.registry import Method
from etid.identify.arguments import driver_of, fed, require
from etid.identify.arguments import recordings as several
from etid.identify.batches import choices, of_one_circuit
from etid.identify.options import Circuit, FitOptions, Interval, Options, candidates_of
from etid.identify.study_drivers import Drivers
from etid.precision import in_float64
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.fits import Fits
from etid.results.fits_columns import described
from etid.results.instrument import Instrument
from etid.results.provenance import PLAUSIBLE
from etid.results.study_fits import StudyFits
from etid.results.tried_orders import Order
from etid.selection.common import common

_Kind = TypeVar("_Kind", bound=AbstractCircuit)
SAMPLE = 200  # recordings that choose the circuit of a study; a second of work


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[SkinRC]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[_Kind]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: str,
    progress: bool = False,
    **options: Unpack[FitOptions],
) -> Fits[AbstractCircuit]: ...


@in_float64
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    progress: bool = False,
) -> Fits:
    """Identify many recordings that were made with one driver.

    Args:
        recordings: Recordings, or a study of loaded recordings. Lengths and sample rates may
            differ.
        driver: Identified driver. Without a driver the loads are identified from the currents that
            the recordings measured.
        circuit: As in `identify_skin`. With `"auto"` all recordings get one circuit, chosen by
            their joint evidence. The note of a recording that deserves another circuit says which.
        method: As in `identify_skin`.
        fixed: As in `identify_skin`, for all recordings.
        prior: As in `identify_skin`, for all recordings.
        bounds: As in `identify_skin`, for all recordings.
        progress: Show a progress bar.

    Returns:
        One fit for each recording, in the order of the recordings. Each fit has a verdict. The
        name of the method lists all methods that were used.

    Raises:
        ValueError: There is no recording, or the method cannot use this circuit.
    """
    driver = driver_of(driver)
    options = Options.of(
        candidates_of(circuit), method=method, fixed=fixed, prior=prior, bounds=bounds
    )
    if isinstance(recordings, Study):
        study, paths = recordings, [*recordings, *recordings.problems]
        known = [_known(study, path) for path in paths]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(study[paths[row]], driver)
    else:
        records = several("recordings", recordings)
        if records and driver is None and not any("current" in one.samples for one in records):
            records[0].without_v_th()  # raises an error, because there is no current
        known = [vars(record.metadata) for record in records]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(records[row], driver)

    if not known:
        raise ValueError("there is no recording to identify")
    fit, notes = of_one_circuit(len(known), load, options, progress, len(known))
    return Fits(fit, described(known), np.array(notes, dtype=str))


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
    paths = to_identify(study)
    options = common_first(drivers, paths, options)
    fits = identify_part(drivers, paths, options, len(paths), progress)
    return StudyFits(fits, drivers.found, drivers.failures, options.settings(study, len(paths)))


def to_identify(study: Study) -> list[str]:
    """Paths of all loaded recordings, then of all recordings that cannot be read."""
    return [*study.loaded, *study.problems]


def common_first(drivers: Drivers, paths: Sequence[str], options: Options) -> Options:
    """The options; the first circuit is the common one of a sample of the recordings."""
    circuits = options.circuits
    if len(circuits) == 1 or not paths:
        return options
    step = -(-len(paths) // SAMPLE)
    sample = paths[::step]
    found, _ = choices(len(sample), _loader(drivers, sample), options, False, len(paths))
    first = circuits[common(found, circuits)]
    others = (one for one in circuits if one is not first)
    return dataclasses.replace(options, circuits=(first, *others))


def identify_part(
    drivers: Drivers, paths: Sequence[str], options: Options, total: int, progress: bool = False
) -> Fits:
    """Fits of some of `total` recordings of a study, with the first of the circuits."""
    if not paths:
        raise ValueError("the study has no loaded recording")
    load = _loader(drivers, paths)
    fit, notes = of_one_circuit(len(paths), load, options, progress, total, chosen=0)
    return table(drivers.study, paths, fit, notes)


def _loader(
    drivers: Drivers, paths: Sequence[str]
) -> Callable[[int], tuple[Recording, AbstractFeed]]:
    return lambda row: drivers.fed(drivers.study[paths[row]])


def table(study: Study, paths: Sequence[str], fit: Fit, notes: Sequence[str]) -> Fits:
    """Fits of some recordings of a study, stacked, with their labels."""
    known = [_known(study, path) for path in paths]
    return Fits(fit, described(known), np.array(notes, dtype=str))


def _known(study: Study, path: str) -> dict[str, Any]:
    """The fields of a recording; only its path if it cannot be read."""
    try:
        return vars(study.metadata(path))
    except RecordingError:
        return {"path": path}
