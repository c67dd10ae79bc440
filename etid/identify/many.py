"""Identification of many recordings in chunks, and of whole studies.

Recordings of one length share one compiled function. It takes up to `LANES` recordings, so that
memory is bounded. A CPU fits them one after the other: side by side (`vmap`) they take twice the
time, even with equal numbers of steps. Accelerators fit them side by side. During a fit, a thread
reads the next recordings in chunks. A bad recording gets a verdict and a note; the other recordings
are not affected.
"""

import contextlib
import dataclasses
import itertools
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import AbstractLane, stacked, unstacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, Method
from etid.identify.arguments import (
    Asked,
    Circuit,
    asked_of,
    candidates_of,
    check_default,
    drift_of,
    driver_of,
    fed,
    order_of,
    require,
)
from etid.identify.arguments import recordings as several
from etid.identify.compiled import stored_jit
from etid.identify.driver import identify_driver
from etid.identify.one import (
    chosen_fits,
    failed_fit,
    is_shared,
    known_of,
    note,
    refined,
    skin_lane,
)
from etid.identify.planning import Planned, Refusal, planned
from etid.identify.prefetch import prefetch
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.repeats import repeats
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fits import Fit, Fits, IdentificationError, described, joined
from etid.results.provenance import Settings
from etid.results.study_fits import StudyFits
from etid.results.tried_orders import Order
from etid.selection.common import common, deserves
from etid.selection.selection import Selection

_Kind = TypeVar("_Kind", bound=AbstractCircuit)
LANES = 64  # lanes of one call; the last call is padded
READ = 16  # recordings of a chunk, which are read and inspected together
HELD = 2**21  # samples of waiting recordings; above, a call has fewer lanes, but at least a chunk
AHEAD = 2  # chunks that are read and inspected in advance
SAMPLE = 200  # recordings that choose the circuit of a study; a second of work


@stored_jit
def _chunk(
    lanes: Any,
    count: Int[Array, ""],
    driver: AbstractFeed,
    known: Any,
    circuit: AbstractCircuit,
    estimator: AbstractEstimator,
) -> Fit:
    return each(lambda lane: skin_lane(lane, driver, known, circuit, estimator), lanes, count)


def each(fit: Callable[[Any], Any], lanes: Any, count: int | Int[Array, ""]) -> Any:
    """Results of `fit` for the first `count` lanes; zeros for the others on a CPU."""
    if jax.default_backend() != "cpu":
        return jax.vmap(fit)(lanes)
    once = jax.jit(fit)  # so that the shapes and the calls need one trace only
    first = jax.tree.map(lambda leaf: leaf[0], lanes)
    shapes = jax.eval_shape(once, first)

    def nothing(_) -> Any:
        return jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes)

    def one(numbered: tuple[Int[Array, ""], Any]) -> Any:
        number, lane = numbered
        return jax.lax.cond(number < count, once, nothing, lane)

    size = jax.tree.leaves(lanes)[0].shape[0]
    return jax.lax.map(one, (jnp.arange(size), lanes))


def _of_one_method(fits: Sequence[Fit], used: Sequence[str]) -> list[Fit]:
    """The fits as numpy arrays, all with one method name: a batch has a single name.

    The name lists all methods that were used.
    """
    name = joined(used)
    arrays = [jax.tree.map(np.asarray, fit) for fit in fits]
    return [fit if fit.method == name else dataclasses.replace(fit, method=name) for fit in arrays]


class _Prepared(NamedTuple):
    """A recording that waits for a chunk, its lane, and whether `is_shared` holds."""

    planned: Planned
    lane: AbstractLane
    shared: bool

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for recordings that can be fitted in one chunk."""
        seen, driver, estimator = self.planned
        rates = seen.recording.sample_rate, seen.recording.pulse_rate
        return id(driver), estimator, self.lane.shapes, self.shared, rates


def _prepared(
    found: Planned | Refusal, candidates: Sequence[AbstractCircuit]
) -> _Prepared | Refusal:
    if isinstance(found, Refusal):
        return found
    try:
        check_default(found.estimator, candidates)
    except ValueError as error:
        return Refusal("not_periodic", str(error))
    lane = found.estimator.lane.of(found.seen)
    return _Prepared(found, lane, is_shared(found.seen, found.driver))


def chunked(count: int) -> Iterator[range]:
    """The numbers of `count` recordings, in chunks of `READ`."""
    return (range(first, min(first + READ, count)) for first in range(0, count, READ))


def filled(lanes: Sequence[AbstractLane]) -> AbstractLane:
    """`LANES` lanes, padded with copies of the last lane."""
    return stacked([*lanes, *[lanes[-1]] * (LANES - len(lanes))])


class _Queue:
    """Recordings that wait for a call; they share a compiled function and a driver."""

    def __init__(
        self,
        driver: AbstractFeed,
        known: Any,
        candidates: Sequence[AbstractCircuit],
        estimator: AbstractEstimator,
    ) -> None:
        self.driver = driver
        self.known = known
        self.candidates = candidates
        self.estimator = estimator
        self.rows: list[int] = []
        self.lanes: list[AbstractLane] = []
        self.seen: list[Inspected] = []

    def add(self, row: int, lane: AbstractLane, seen: Inspected) -> None:
        """Append a recording."""
        self.rows.append(row)
        self.lanes.append(lane)
        self.seen.append(seen)

    @property
    def full(self) -> bool:
        """Whether a call has its lanes, or the waiting recordings take much memory."""
        held = sum(one.recording.samples["v_out"].stored.size for one in self.seen)
        return len(self.rows) == LANES or (len(self.rows) >= READ and held >= HELD)

    def run(self) -> Iterator[tuple[int, Selection]]:
        """Fit the waiting recordings and empty the queue."""
        rows, lanes, seen = self.rows, self.lanes, self.seen
        self.rows, self.lanes, self.seen = [], [], []
        found = refined(lanes, seen, self._fits, self.driver, self.candidates)
        remarks = [int(one.remarks) for one in seen]
        of_all = chosen_fits(found, self.driver, remarks, repeats(seen))
        for row, (fits, chosen) in zip(rows, of_all, strict=True):
            yield row, Selection.of(fits, chosen, self.candidates)

    def _fits(self, lanes: Sequence[AbstractLane], circuit: AbstractCircuit) -> list[Fit]:
        of = self.driver, self.known, circuit, self.estimator
        fits = jax.device_get(_chunk(filled(lanes), jnp.asarray(len(lanes)), *of))
        return unstacked(fits)[: len(lanes)]  # without the padding


def choices(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    candidates: Sequence[AbstractCircuit],
    asked: Asked,
    progress: bool,
) -> tuple[list[Selection], list[str], list[str]]:
    """A choice for each recording alone, notes, and names of the methods that were used.

    Args:
        count: Number of recordings.
        load: Recording and driver of a row. Its error becomes the verdict of this row.
        candidates: Circuits to choose from.
        asked: The requested estimator.
        progress: Show a progress bar.
    """
    found: dict[int, Selection] = {}
    notes = [""] * count
    used: list[str] = []
    otherwise = str(asked.estimator or MAXIMUM_LIKELIHOOD)
    queues: dict[tuple, _Queue] = {}

    chunks = tuple(chunked(count))

    def read(number: int) -> list[tuple[int, _Prepared | Refusal]]:
        with jax.enable_x64(True):  # the setting belongs to a thread, and this runs in another one
            of_all = planned(load, chunks[number], asked)
            return [(row, _prepared(of, candidates)) for row, of in of_all]

    with (
        tqdm(total=count, unit="fit", disable=not progress) as bar,
        contextlib.closing(prefetch(read, len(chunks), AHEAD)) as recordings,
    ):

        def run(queue: _Queue) -> None:
            for row, selection in queue.run():
                found[row] = selection
                used.append(selection.fit.method)
                notes[row] = note(selection.fit)
                bar.update()

        for row, prepared in itertools.chain.from_iterable(chunk() for chunk in recordings):
            if isinstance(prepared, Refusal):
                fit = failed_fit(prepared.name, candidates[0], otherwise)
                found[row] = Selection.of({0: fit}, 0, candidates)
                notes[row] = prepared.note
                bar.update()
                continue
            key = prepared.key
            if key not in queues:
                _, driver, estimator = prepared.planned
                known = known_of(prepared.lane, driver, prepared.shared, estimator)
                queues[key] = _Queue(driver, known, candidates, estimator)
            queue = queues[key]
            queue.add(row, prepared.lane, prepared.planned.seen)
            if queue.full:
                run(queue)
        for queue in queues.values():
            if queue.rows:
                run(queue)
    return [found[row] for row in range(count)], notes, used or [otherwise]


def _of_one_circuit(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    candidates: Sequence[AbstractCircuit],
    asked: Asked,
    progress: bool,
    fixed: int | None = None,
) -> tuple[list[Fit], list[str]]:
    """Fits and notes of recordings, all with the same circuit.

    Args:
        count: Number of recordings.
        load: Recording and driver of a row.
        candidates: Circuits to choose from, by joint evidence.
        asked: What the caller asks for.
        progress: Show a progress bar.
        fixed: Number of the circuit, if it is chosen already. The other candidates then serve to
            find the recordings that deserve another circuit.
    """
    found, notes, used = choices(count, load, candidates, asked, progress)
    chosen = common(found, candidates) if fixed is None else fixed
    others = [row for row, one in enumerate(found) if one.chosen != chosen]
    if others:
        of_others = [candidates[chosen]], asked, False
        again, texts, _ = choices(len(others), lambda i: load(others[i]), *of_others)
        for row, one, text in zip(others, again, texts, strict=True):
            found[row], notes[row] = _otherwise(found[row], one.fit, text, chosen, candidates)
    return _of_one_method([one.fit for one in found], used), notes


def _otherwise(
    found: Selection, fit: Fit, text: str, chosen: int, candidates: Sequence[AbstractCircuit]
) -> tuple[Selection, str]:
    """The choice and the note of a recording whose common circuit is not its own choice."""
    if not math.isfinite(float(fit.chi2)):  # it was refused
        return Selection.of({chosen: fit}, chosen, candidates), text
    found = Selection.of({**found.fits, chosen: fit}, chosen, candidates)
    return found, " ".join(filter(None, (text, deserves(found, chosen))))


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    progress: bool = False,
) -> Fits[SkinRC]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    progress: bool = False,
) -> Fits[_Kind]: ...


@overload
def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: Literal["auto"],
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    progress: bool = False,
) -> Fits[AbstractCircuit]: ...


def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
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
        progress: Show a progress bar.

    Returns:
        One fit for each recording, in the order of the recordings. Each fit has a verdict. The
        name of the method lists all methods that were used.

    Raises:
        ValueError: There is no recording, or the method cannot use this circuit.
    """
    driver = driver_of(driver)
    candidates = candidates_of(circuit)
    asked = asked_of(method, candidates, fixed, prior)
    if isinstance(recordings, Study):
        study, paths = recordings, [*recordings, *recordings.problems]
        known = [_known(study, path) for path in paths]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(study[paths[row]], driver)
    else:
        records = several("recordings", recordings)
        if driver is None and not any("current" in record.samples for record in records):
            for record in records[:1]:
                record.without_v_th()  # raises an error, because there is no current
        known = [vars(record.metadata) for record in records]

        def load(row: int) -> tuple[Recording, AbstractFeed]:
            return fed(records[row], driver)

    if not known:
        raise ValueError("there is no recording to identify")
    fits, notes = _of_one_circuit(len(known), load, candidates, asked, progress)
    return Fits(stacked(fits), described(known), np.array(notes, dtype=str))


def identify_study(
    study: Study,
    *,
    order: Order = 5,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    driver_drift: float = 0.0,
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
        driver_drift: As in `identify_driver`.
        progress: Show a progress bar.

    Returns:
        One fit for each loaded recording, and the drivers.

    Raises:
        ValueError: There is no loaded recording, or the method cannot use this circuit.
    """
    require("study", study, Study)
    order = order_of(order)
    candidates = candidates_of(circuit)
    asked = asked_of(method, candidates, fixed, prior)
    drivers = Drivers(study, order, asked.estimator, driver_drift)
    paths = to_identify(study)
    candidates = common_first(study, paths, drivers, candidates, asked)
    fits = identify_part(study, paths, drivers, candidates, asked, progress)
    settings = Settings.of(
        study, len(paths), order, str(asked.estimator or ""), candidates, driver_drift=driver_drift
    )
    return StudyFits(fits, drivers.found, drivers.failures, settings)


def to_identify(study: Study) -> list[str]:
    """Paths of all loaded recordings, then of all recordings that cannot be read."""
    return [*study.loaded, *study.problems]


def common_first(
    study: Study,
    paths: Sequence[str],
    drivers: "Drivers",
    candidates: Sequence[AbstractCircuit],
    asked: Asked,
) -> tuple[AbstractCircuit, ...]:
    """The candidates; the first one is the common circuit of a sample of the recordings."""
    if len(candidates) == 1 or not paths:
        return tuple(candidates)
    step = -(-len(paths) // SAMPLE)
    sample = paths[::step]
    load = _loader(study, sample, drivers)
    found, *_ = choices(len(sample), load, candidates, asked, progress=False)
    chosen = common(found, candidates)
    return candidates[chosen], *(one for n, one in enumerate(candidates) if n != chosen)


def identify_part(
    study: Study,
    paths: Sequence[str],
    drivers: "Drivers",
    candidates: Sequence[AbstractCircuit],
    asked: Asked,
    progress: bool = False,
) -> Fits:
    """Fits of some recordings of a study, with its drivers and the first of the candidates."""
    if not paths:
        raise ValueError("the study has no loaded recording")
    load = _loader(study, paths, drivers)
    fits, notes = _of_one_circuit(len(paths), load, candidates, asked, progress, fixed=0)
    return table(study, paths, fits, notes)


def _loader(
    study: Study, paths: Sequence[str], drivers: "Drivers"
) -> Callable[[int], tuple[Recording, AbstractFeed]]:
    def load(row: int) -> tuple[Recording, AbstractFeed]:
        return drivers.fed(study[paths[row]])

    return load


def table(study: Study, paths: Sequence[str], fits: Sequence[Fit], notes: Sequence[str]) -> Fits:
    """Fits of some recordings of a study, with their labels.

    Raises:
        ValueError: There is no fit.
    """
    if not fits:
        raise ValueError("the study has no loaded recording")
    known = [_known(study, path) for path in paths]
    return Fits(stacked(fits), described(known), np.array(notes, dtype=str))


class Drivers:
    """The drivers of a study; each is identified when its first recording needs it.

    Attributes:
        found: The identified drivers. The keys are the paths of their calibrations.
        failures: Reasons why a driver could not be identified. The keys are the paths of its
            calibrations.
    """

    def __init__(
        self,
        study: Study,
        order: Order,
        asked: AbstractEstimator | None,
        driver_drift: float = 0.0,
    ) -> None:
        self.study = study
        self.driver_drift = drift_of(driver_drift, asked)
        self.order: Order = order
        self.asked = asked
        self.calibrations = tuple(study.calibrations)
        self.found: dict[tuple[str, ...], Driver] = {}
        self.failures: dict[tuple[str, ...], str] = {}
        self._one_at_a_time = threading.Lock()

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
                remedy="Write the path of its calibration into the attribute 'calibration'",
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
            self.found[names] = identify_driver(
                records,
                order=self.order,
                method=self.asked,
                driver_drift=self.driver_drift,
                throw=False,
            )
        except (IdentificationError, ValueError, KeyError) as error:
            self.failures[names] = str(error)


def _known(study: Study, path: str) -> dict[str, Any]:
    """The fields of a recording; only its path if it cannot be read."""
    try:
        return vars(study.metadata(path))
    except RecordingError:
        return {"path": path}
