"""Identification of whole studies: every driver from its calibrations, every loaded recording."""

import dataclasses
import functools
import itertools
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from etid.estimators.lanes import stacked, taken, unstacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, Method
from etid.identify.arguments import require
from etid.identify.driver import calibrated
from etid.identify.fitting import Batch, CandidateFits, notes_of, with_driver
from etid.identify.options import Circuit, FitOptions, Interval, Options, candidates_of
from etid.identify.planning import Load, batches, failed_fit
from etid.precision import in_float64
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.columns import described
from etid.results.driver import Driver, Order
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fit import Fit, IdentificationError
from etid.results.fits import Fits, concatenated
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE, StudyFits
from etid.selection.common import common, deserves
from etid.selection.selection import Selection


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
    accept: float | None = None,
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
        accept: As in `identify_skin`.
        instrument: As in `identify_driver`.
        plausible: As in `identify_driver`.
        progress: Show a progress bar.

    Returns:
        One fit for each loaded recording, and the drivers.

    Raises:
        ValueError: There is no loaded recording, or the method cannot use this circuit.
    """
    require("study", study, Study)
    of_fit = FitOptions(method=method, fixed=fixed, prior=prior, bounds=bounds, accept=accept)
    options = Options.of(
        candidates_of(circuit), order=order, instrument=instrument, plausible=plausible, **of_fit
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
    sample = paths[:: -(-len(paths) // 200)]  # so many take a second
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
        self.calibrations = tuple(study.calibrations) or tuple(study.named.calibrations)
        self.found: dict[tuple[str, ...], Driver] = {}
        self.failures: dict[tuple[str, ...], str] = {}
        self._one_at_a_time = threading.Lock()

    @functools.cached_property
    def paths(self) -> list[str]:
        """Paths of all loaded recordings, then of all recordings that cannot be read.

        Raises:
            RecordingError: There is none.
        """
        if paths := [*self.study.loaded, *self.study.problems]:
            return paths
        raise RecordingError(
            "there is no loaded recording",
            file=self.study.file,
            remedy="Import one, or merge its file with this one: etid import, etid merge",
        )

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
                f"names no calibration and the study has {len(self.calibrations) or 'none'}",
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
            records = [self.study.named[name] for name in names]
            self.found[names] = calibrated(records, self.options, throw=False)
        except (IdentificationError, ValueError, KeyError) as error:
            self.failures[names] = str(error)


class _Part(NamedTuple):
    """Fits of some recordings and what fed them, or why they were refused."""

    rows: list[int]
    found: CandidateFits
    feed: AbstractFeed | None = None
    note: str = ""


def _parts(count: int, load: Load, options: Options, progress: bool, total: int) -> Iterator[_Part]:
    """Fits of all recordings, in parts; arguments as in `choices`."""
    otherwise = str(options.estimator or MAXIMUM_LIKELIHOOD)
    for batch in batches(count, load, options, progress):
        if isinstance(batch, Batch):
            yield _Part(batch.rows, batch.fitted(options.circuits), batch.like.driver)
        else:
            row, refusal = batch
            fit = failed_fit(refusal.name, options, otherwise)
            yield _Part([row], CandidateFits(stacked([fit])), note=refusal.note)


def choices(
    count: int, load: Load, options: Options, progress: bool, total: int
) -> tuple[list[Selection], list[str]]:
    """A choice for each recording alone, and notes.

    Args:
        count: Number of recordings.
        load: Reads a recording and its driver.
        options: What the caller asks for.
        progress: Show a progress bar.
        total: Number of recordings that are fitted in this way, here and in other calls.
    """
    found: dict[int, Selection] = {}
    notes = [""] * count
    for part in _parts(count, load, options, progress, total):
        for number, row in enumerate(part.rows):
            found[row] = Selection.of(
                part.found[number], part.found.chosen(number), options.circuits
            )
            notes[row] = part.note or with_driver(found[row].fit.note, part.feed)
    return [found[row] for row in range(count)], notes


def _fits(
    count: int, load: Load, options: Options, progress: bool, total: int
) -> tuple[Fit, list[str]]:
    """The fit of the only circuit to each recording, stacked, and notes; see `choices`."""
    parts = list(_parts(count, load, options, progress, total))
    of_parts = [
        [part.note] if part.feed is None else notes_of(part.found.only, part.feed) for part in parts
    ]
    order = np.argsort([row for part in parts for row in part.rows])
    fits = taken(concatenated([part.found.only for part in parts]), order)
    texts = list(itertools.chain.from_iterable(of_parts))
    return fits, [texts[place] for place in order]


def of_one_circuit(
    count: int, load: Load, options: Options, progress: bool, total: int, chosen: int | None = None
) -> tuple[Fit, list[str]]:
    """Fits, stacked, and notes of recordings, all with the same circuit.

    Args:
        count: Number of recordings.
        load: Reads a recording and its driver.
        options: What the caller asks for; joint evidence chooses the circuit.
        progress: Show a progress bar.
        total: As in `choices`.
        chosen: Number of the circuit, if it is chosen already. The other circuits then serve to
            find the recordings that deserve another circuit.
    """
    circuits = options.circuits
    if len(circuits) == 1:
        return _fits(count, load, options, progress, total)
    found, notes = choices(count, load, options, progress, total)
    chosen = common(found, circuits) if chosen is None else chosen
    others = [row for row, one in enumerate(found) if one.chosen != chosen]
    if others:
        single = dataclasses.replace(options, circuits=(circuits[chosen],))
        again, texts = _fits(len(others), lambda i: load(others[i]), single, False, total)
        for row, one, text in zip(others, unstacked(again), texts, strict=True):
            refused = not math.isfinite(float(one.chi2))
            fits = {chosen: one} if refused else {**found[row].fits, chosen: one}
            found[row] = Selection.of(fits, chosen, circuits)
            deserved = "" if refused else deserves(found[row], chosen)
            notes[row] = " ".join(filter(None, (text, deserved)))
    return concatenated([stacked([one.fit]) for one in found]), notes
