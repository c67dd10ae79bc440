"""Fits of many recordings: few by NumPy one after the other, many by a compiled function.

Recordings of one length share one compiled function. It takes up to `LANES` recordings, so that
memory is bounded. A CPU fits them one after the other: side by side (`vmap`) they take twice the
time, even with equal numbers of steps. Accelerators fit them side by side. During a fit, a thread
reads the next recordings in chunks. A bad recording gets a verdict and a note; the other recordings
are not affected.
"""

import collections
import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import AbstractLane, stacked, taken, unstacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.one import (
    Tried,
    is_shared,
    judged,
    known_of,
    note,
    notes_of,
    refined,
    skin,
    skin_lane,
)
from etid.identify.options import Options, check_default
from etid.identify.planning import (
    FEWEST,
    Planned,
    Refusal,
    calls,
    failed_fit,
    planned,
)
from etid.numpy_tier.tiers import program, worth_compiling
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.fits import joined
from etid.selection.common import common, deserves
from etid.selection.selection import Selection

LANES = 64  # lanes of one call; the last call is padded
HELD = 2**21  # samples of waiting recordings; above, a call has fewer lanes, but at least `FEWEST`
AHEAD = 2  # chunks that are read and inspected in advance
T = TypeVar("T")


@functools.partial(program, batch=True)
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


def concatenated(fits: Sequence[Fit]) -> Fit:
    """Fits of several parts; a batch has a single name of the method: all that were used.

    A recording that was refused has no χ².
    """
    used = [one.method for one in fits if np.isfinite(one.chi2).any()]
    name = joined(used or [one.method for one in fits])
    named = [one if one.method == name else dataclasses.replace(one, method=name) for one in fits]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *named)


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
    of_all: Iterable[tuple[int, Planned | Refusal]], candidates: Sequence[AbstractCircuit]
) -> list[tuple[int, _Prepared | Refusal]]:
    """The recordings of a chunk with their lanes, which those of one kind get together."""
    prepared: list[tuple[int, _Prepared | Refusal]] = []
    alike: dict[type[AbstractLane], list[tuple[int, Planned]]] = {}
    for row, found in of_all:
        if isinstance(found, Refusal):
            prepared.append((row, found))
            continue
        try:
            check_default(found.estimator, candidates)
        except ValueError as error:
            prepared.append((row, Refusal("not_periodic", str(error))))
        else:
            alike.setdefault(found.estimator.lane, []).append((row, found))
    for kind, several in alike.items():
        lanes = kind.of_several([found.seen for _, found in several])
        for (row, found), lane in zip(several, lanes, strict=True):
            shared = is_shared(found.seen, found.driver)
            prepared.append((row, _Prepared(found, lane, shared)))
    return prepared


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
        total: int,
    ) -> None:
        self.driver = driver
        self.known = known
        self.candidates = candidates
        self.estimator = estimator
        self.total = total  # recordings of all queues and calls
        self.rows: list[int] = []
        self.lanes: list[AbstractLane] = []
        self.seen: list[Inspected] = []
        self.held = 0

    def add(self, row: int, lane: AbstractLane, seen: Inspected) -> None:
        """Append a recording."""
        self.rows.append(row)
        self.lanes.append(lane)
        self.seen.append(seen)
        self.held += seen.recording.samples["v_out"].stored.size

    @property
    def full(self) -> bool:
        """Whether a call has its lanes, or the waiting recordings take much memory."""
        return len(self.rows) == LANES or (len(self.rows) >= FEWEST and self.held >= HELD)

    def run(self) -> "_Part":
        """Fit the waiting recordings and empty the queue."""
        rows, lanes, seen = self.rows, self.lanes, self.seen
        self.rows, self.lanes, self.seen, self.held = [], [], [], 0
        found = refined(lanes, seen, self._fits, self.driver, self.candidates)
        return _Part(rows, judged(found, self.driver, seen, self.estimator))

    def _fits(self, lanes: Sequence[AbstractLane], circuit: AbstractCircuit) -> Fit:
        of = self.driver, self.known, circuit, self.estimator
        if not worth_compiling(self.total * lanes[0].size):
            return stacked(jax.device_get([skin(lane, *of) for lane in lanes]))
        fits = jax.device_get(_chunk(filled(lanes), jnp.asarray(len(lanes)), *of))
        return taken(fits, np.arange(len(lanes)))  # without the padding


def prefetch(
    load: Callable[[int], T], count: int, ahead: int
) -> Generator[Callable[[], T], None, None]:
    """Call `load(0)`, `load(1)`, … in another thread, in this order and one at a time.

    Close the iterator to stop early: the running call finishes, the others do not start.

    Args:
        load: A function that spends its time outside Python, in file access or numpy.
        count: Number of calls.
        ahead: Largest number of calls in advance of the caller.

    Yields:
        For each call a function that waits for the result and returns it, or raises its error.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="prefetch") as thread:
        waiting = collections.deque(thread.submit(load, row) for row in range(min(ahead, count)))
        try:
            for row in range(count):
                loaded = waiting.popleft()
                if row + ahead < count:
                    waiting.append(thread.submit(load, row + ahead))
                yield loaded.result
        finally:
            for future in waiting:
                future.cancel()


class _Part(NamedTuple):
    """Fits of some recordings, and why they were refused if they were."""

    rows: list[int]
    found: Tried
    note: str = ""


def _parts(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    options: Options,
    progress: bool,
    total: int,
) -> Iterator[_Part]:
    """Fits of all recordings, in parts; arguments as in `choices`."""
    otherwise = str(options.estimator or MAXIMUM_LIKELIHOOD)
    queues: dict[tuple, _Queue] = {}
    rows = iter(range(count))

    @in_float64  # the setting belongs to a thread, and this runs in another one
    def read(_: int) -> list[tuple[int, _Prepared | Refusal]]:
        return _prepared(planned(load, rows, options), options.circuits)

    with (
        tqdm(total=count, unit="fit", disable=not progress) as bar,
        contextlib.closing(prefetch(read, len(calls(count)), AHEAD)) as recordings,
    ):
        for row, prepared in itertools.chain.from_iterable(chunk() for chunk in recordings):
            if isinstance(prepared, Refusal):
                fit = failed_fit(prepared.name, options, otherwise)
                yield _Part([row], Tried(stacked([fit])), prepared.note)
                bar.update()
                continue
            key = prepared.key
            if key not in queues:
                _, driver, estimator = prepared.planned
                known = known_of(prepared.lane, driver, prepared.shared, estimator)
                queues[key] = _Queue(driver, known, options.circuits, estimator, total)
            queue = queues[key]
            queue.add(row, prepared.lane, prepared.planned.seen)
            if queue.full:
                bar.update(len(queue.rows))
                yield queue.run()
        for queue in queues.values():
            if queue.rows:
                bar.update(len(queue.rows))
                yield queue.run()


def choices(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    options: Options,
    progress: bool,
    total: int,
) -> tuple[list[Selection], list[str]]:
    """A choice for each recording alone, and notes.

    Args:
        count: Number of recordings.
        load: Recording and driver of a row. Its error becomes the verdict of this row.
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
            notes[row] = part.note or note(found[row].fit)
    return [found[row] for row in range(count)], notes


def _fits(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    options: Options,
    progress: bool,
    total: int,
) -> tuple[Fit, list[str]]:
    """The fit of the only circuit to each recording, stacked, and notes; see `choices`."""
    parts = list(_parts(count, load, options, progress, total))
    of_parts = [[part.note] if part.note else notes_of(part.found.only) for part in parts]
    order = np.argsort([row for part in parts for row in part.rows])
    fits = taken(concatenated([part.found.only for part in parts]), order)
    texts = list(itertools.chain.from_iterable(of_parts))
    return fits, [texts[place] for place in order]


def of_one_circuit(
    count: int,
    load: Callable[[int], tuple[Recording, AbstractFeed]],
    options: Options,
    progress: bool,
    total: int,
    chosen: int | None = None,
) -> tuple[Fit, list[str]]:
    """Fits, stacked, and notes of recordings, all with the same circuit.

    Args:
        count: Number of recordings.
        load: Recording and driver of a row.
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
            found[row], notes[row] = _otherwise(found[row], one, text, chosen, circuits)
    return concatenated([stacked([one.fit]) for one in found]), notes


def _otherwise(
    found: Selection, fit: Fit, text: str, chosen: int, candidates: Sequence[AbstractCircuit]
) -> tuple[Selection, str]:
    """The choice and the note of a recording whose common circuit is not its own choice."""
    if not math.isfinite(float(fit.chi2)):  # it was refused
        return Selection.of({chosen: fit}, chosen, candidates), text
    found = Selection.of({**found.fits, chosen: fit}, chosen, candidates)
    return found, " ".join(filter(None, (text, deserves(found, chosen))))
