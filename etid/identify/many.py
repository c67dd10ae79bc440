"""Identification of many recordings in chunks, and of whole studies.

Recordings of one length share one compiled function. It takes a chunk of `LANES` recordings, so
that memory is bounded. A CPU fits the recordings of a chunk one after the other: side by side
(`vmap`), all would take as many steps as the slowest, which costs 50 % more time. Accelerators fit
them side by side. During the fit of a chunk, a thread reads the recordings of the next chunk. A bad
recording gets a verdict and a note; the other recordings are not affected.
"""

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import AbstractLane, stacked, unstacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, Method
from etid.identify.arguments import (
    check_default,
    circuit_of,
    drift_of,
    estimator_of,
    order_of,
    plan,
    require,
)
from etid.identify.arguments import recordings as several
from etid.identify.compiled import stored_jit
from etid.identify.driver import identify_driver
from etid.identify.one import (
    concluded,
    explained,
    failed_fit,
    is_shared,
    known_of,
    note,
    refined,
    skin_lane,
)
from etid.identify.prefetch import prefetch
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.repeats import repeats
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.fits import Fit, Fits, IdentificationError, described, joined
from etid.results.provenance import Settings
from etid.results.study_fits import StudyFits
from etid.results.tried_orders import Order
from etid.results.verdicts import message

LANES = 16  # lanes of one chunk; the last chunk is padded
AHEAD = 2 * LANES  # recordings that are read and inspected in advance


@stored_jit
def _chunk(
    lanes: Any,
    count: Int[Array, ""],
    driver: Driver,
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


class Refusal(Exception):
    """A recording cannot be fitted; holds the name of its verdict and a note."""

    def __init__(self, name: str, note: str = "") -> None:
        super().__init__(name)
        self.name = name
        self.note = note or message(name)


def planned(
    load: Callable[[], tuple[Recording, Driver]], asked: AbstractEstimator | None
) -> tuple[Inspected, Driver, AbstractEstimator]:
    """The inspected recording, its driver and its estimator.

    Raises:
        Refusal: One of these steps failed, or pre-flight refused the recording.
    """
    try:
        recording, driver = load()
        seen = Inspected(recording)
        estimator, name = plan(asked, seen, driver)
    except (RecordingError, ValueError) as error:
        raise Refusal("unreadable", str(error)) from error
    except IdentificationError as error:
        raise Refusal("driver_failed", str(error)) from error
    if name is not None:
        raise Refusal(name, explained(seen, name))
    return seen, driver, estimator


def filled(lanes: Sequence[AbstractLane]) -> AbstractLane:
    """A chunk of `LANES` lanes, padded with copies of the last lane."""
    return stacked([*lanes, *[lanes[-1]] * (LANES - len(lanes))])


class _Queue:
    """Recordings that wait until a chunk is full; they share a compiled function and a driver."""

    def __init__(
        self, driver: Driver, known: Any, circuit: AbstractCircuit, estimator: AbstractEstimator
    ) -> None:
        self.driver = driver
        self.known = known
        self.circuit = circuit
        self.estimator = estimator
        self.rows: list[int] = []
        self.lanes: list[AbstractLane] = []
        self.seen: list[Inspected] = []

    def add(self, row: int, lane: AbstractLane, seen: Inspected) -> None:
        """Append a recording."""
        self.rows.append(row)
        self.lanes.append(lane)
        self.seen.append(seen)

    def run(self) -> Iterator[tuple[int, Fit]]:
        """Fit the waiting recordings and empty the queue."""
        rows, lanes, seen = self.rows, self.lanes, self.seen
        self.rows, self.lanes, self.seen = [], [], []
        fits = refined(lanes, seen, self._fits, self.driver)
        remarks = [int(one.remarks) for one in seen]
        yield from zip(rows, concluded(fits, self.driver, remarks, repeats(seen)), strict=True)

    def _fits(self, lanes: Sequence[AbstractLane]) -> list[Fit]:
        of = self.driver, self.known, self.circuit, self.estimator
        fits = jax.device_get(_chunk(filled(lanes), jnp.asarray(len(lanes)), *of))
        return unstacked(fits)[: len(lanes)]  # without the padding


def _identify(
    count: int,
    load: Callable[[int], tuple[Recording, Driver]],
    circuit: AbstractCircuit,
    asked: AbstractEstimator | None,
    progress: bool,
) -> tuple[list[Fit], list[str]]:
    """Fits and notes of `count` recordings. An error of `load(row)` becomes the verdict of row."""
    fits: dict[int, Fit] = {}
    notes = [""] * count
    used: list[str] = []
    otherwise = str(asked or MAXIMUM_LIKELIHOOD)
    queues: dict[tuple, _Queue] = {}

    def read(
        row: int,
    ) -> tuple[Driver, AbstractLane, Inspected, AbstractEstimator, bool, tuple]:
        with jax.enable_x64(True):  # the setting belongs to a thread, and this runs in another one
            seen, driver, estimator = planned(functools.partial(load, row), asked)
            try:
                check_default(estimator, circuit)
            except ValueError as error:
                raise Refusal("not_periodic", str(error)) from error
        rates = seen.recording.sample_rate, seen.recording.pulse_rate
        waiting, shared = estimator.lane.of(seen), is_shared(seen, driver)
        key = id(driver), estimator, waiting.size, shared, rates
        return driver, waiting, seen, estimator, shared, key

    with (
        tqdm(total=count, unit="fit", disable=not progress) as bar,
        contextlib.closing(prefetch(read, count, AHEAD)) as recordings,
    ):

        def run(queue: _Queue) -> None:
            for row, fit in queue.run():
                fits[row] = fit
                used.append(fit.method)
                notes[row] = note(fit)
                bar.update()

        for row, prepared in enumerate(recordings):
            try:
                driver, waiting, seen, estimator, shared, key = prepared()
            except Refusal as refusal:
                fits[row] = failed_fit(refusal.name, circuit, otherwise)
                notes[row] = refusal.note
                bar.update()
                continue
            if key not in queues:
                known = known_of(waiting, driver, shared, estimator)
                queues[key] = _Queue(driver, known, circuit, estimator)
            queue = queues[key]
            queue.add(row, waiting, seen)
            if len(queue.rows) == LANES:
                run(queue)
        for queue in queues.values():
            if queue.rows:
                run(queue)
    ordered = [fits[row] for row in range(count)]
    return _of_one_method(ordered, used or [otherwise]), notes


def identify_skins(
    recordings: Iterable[Recording] | Study,
    driver: Driver,
    *,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
    progress: bool = False,
) -> Fits:
    """Identify many recordings that were made with one driver.

    Args:
        recordings: Recordings, or a study of loaded recordings. Lengths and sample rates may
            differ.
        driver: Identified driver.
        circuit: As in `identify_skin`.
        method: As in `identify_skin`.
        progress: Show a progress bar.

    Returns:
        One fit for each recording, in the order of the recordings. Each fit has a verdict. The
        name of the method lists all methods that were used.

    Raises:
        ValueError: There is no recording, or the method cannot use this circuit.
    """
    require("driver", driver, Driver)
    circuit = circuit_of(circuit)
    asked = estimator_of(method, circuit)
    if isinstance(recordings, Study):
        study, paths = recordings, [*recordings, *recordings.problems]
        known = [_known(study, path) for path in paths]
        fits, notes = _identify(
            len(paths), lambda row: (study[paths[row]], driver), circuit, asked, progress
        )
    else:
        records = several("recordings", recordings)
        known = [vars(record.metadata) for record in records]
        fits, notes = _identify(
            len(records), lambda row: (records[row], driver), circuit, asked, progress
        )
    if not fits:
        raise ValueError("there is no recording to identify")
    return Fits(stacked(fits), described(known), np.array(notes, dtype=str))


def identify_study(
    study: Study,
    *,
    order: Order = 5,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
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
        circuit: As in `identify_skin`.
        method: As in `identify_skin`.
        driver_drift: As in `identify_driver`.
        progress: Show a progress bar.

    Returns:
        One fit for each loaded recording, and the drivers.

    Raises:
        ValueError: There is no loaded recording, or the method cannot use this circuit.
    """
    require("study", study, Study)
    order = order_of(order)
    circuit = circuit_of(circuit)
    asked = estimator_of(method, circuit)
    drivers = Drivers(study, order, asked, driver_drift)
    paths = to_identify(study)
    fits = identify_part(study, paths, drivers, circuit, asked, progress)
    settings = Settings.of(
        study, len(paths), order, str(asked or ""), circuit, driver_drift=driver_drift
    )
    return StudyFits(fits, drivers.found, drivers.failures, settings)


def to_identify(study: Study) -> list[str]:
    """Paths of all loaded recordings, then of all recordings that cannot be read."""
    return [*study.loaded, *study.problems]


def identify_part(
    study: Study,
    paths: Sequence[str],
    drivers: "Drivers",
    circuit: AbstractCircuit,
    asked: AbstractEstimator | None,
    progress: bool = False,
) -> Fits:
    """Fits of some recordings of a study, with its drivers."""

    def load(row: int) -> tuple[Recording, Driver]:
        recording = study[paths[row]]
        return recording, drivers.found[drivers.of(recording)]

    fits, notes = _identify(len(paths), load, circuit, asked, progress)
    return table(study, paths, fits, notes)


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
