"""Batches of many recordings, read ahead of the fits, and one circuit for all recordings.

During a fit, a thread reads the next recordings in chunks. A bad recording gets a verdict and a
note; the other recordings are not affected.
"""

import collections
import contextlib
import dataclasses
import itertools
import math
import operator
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import numpy as np
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.lanes import stacked, taken, unstacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.fitting import Batch, CandidateFits, Prepared, notes_of
from etid.identify.options import Options
from etid.identify.planning import Load, Refusal, calls, failed_fit, prepared
from etid.precision import in_float64
from etid.results.fit import Fit
from etid.results.fits import concatenated
from etid.selection.common import common, deserves
from etid.selection.selection import Selection

AHEAD = 2  # chunks that are read and inspected in advance
T = TypeVar("T")


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


def batches(
    count: int,
    load: Load,
    options: Options,
    progress: bool = False,
    key: Callable[[Prepared], tuple[Any, ...]] = operator.attrgetter("key"),
) -> Iterator[tuple[int, Refusal] | Batch]:
    """All recordings in batches, and those that cannot be fitted.

    Args:
        count: Number of recordings.
        load: Reads a recording and its driver.
        options: What the caller asks for.
        progress: Show a progress bar.
        key: Equal for recordings of one batch.
    """
    waiting: dict[tuple[Any, ...], Batch] = {}
    rows = iter(range(count))

    @in_float64  # the setting belongs to a thread, and this runs in another one
    def read(_: int) -> list[tuple[int, Prepared | Refusal]]:
        return prepared(load, rows, options)

    with (
        tqdm(total=count, unit="fit", disable=not progress) as bar,
        contextlib.closing(prefetch(read, len(calls(count)), AHEAD)) as chunks,
    ):
        for row, one in itertools.chain.from_iterable(chunk() for chunk in chunks):
            if isinstance(one, Refusal):
                yield row, one
                bar.update()
                continue
            batch = waiting.setdefault(key(one), Batch(one))
            batch.add(row, one)
            if batch.full:
                bar.update(len(batch.rows))
                yield waiting.pop(key(one))
        for batch in waiting.values():
            bar.update(len(batch.rows))
            yield batch


class _Part(NamedTuple):
    """Fits of some recordings, and why they were refused if they were."""

    rows: list[int]
    found: CandidateFits
    note: str = ""


def _parts(count: int, load: Load, options: Options, progress: bool, total: int) -> Iterator[_Part]:
    """Fits of all recordings, in parts; arguments as in `choices`."""
    otherwise = str(options.estimator or MAXIMUM_LIKELIHOOD)
    for batch in batches(count, load, options, progress):
        if isinstance(batch, Batch):
            yield _Part(batch.rows, batch.fitted(options.circuits, total))
        else:
            row, refusal = batch
            fit = failed_fit(refusal.name, options, otherwise)
            yield _Part([row], CandidateFits(stacked([fit])), refusal.note)


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
            notes[row] = part.note or found[row].fit.note
    return [found[row] for row in range(count)], notes


def _fits(
    count: int, load: Load, options: Options, progress: bool, total: int
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
    load: Load,
    options: Options,
    progress: bool,
    total: int,
    chosen: int | None = None,
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
