"""Reading and inspection of recordings: which can be fitted, and why the others cannot.

During a fit, a thread reads the next recordings in chunks. A bad recording gets a verdict and a
note; the other recordings are not affected.
"""

import collections
import contextlib
import itertools
import operator
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from etid.estimators.element_limits import limited, of_circuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import AbstractLane
from etid.identify import changes
from etid.identify.fitting import FEWEST, Batch, Prepared, is_shared
from etid.identify.options import Options, plan
from etid.precision import in_float64
from etid.recordings.causes import why_implausible, why_misaligned, why_rates_differ
from etid.recordings.preflight import Inspected, inspected, preflight
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.remarks import Remark, texts
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit, IdentificationError, Support
from etid.results.instrument import Effects
from etid.results.verdicts import message, verdict

TOGETHER = 640_000  # samples that are inspected together; their arrays take tens of MB
ERRORS = (RecordingError, ValueError, IdentificationError)  # that a recording or a driver may raise
# Verdicts whose message says more of a recording.
EXPLAINED = (
    *("rate_mismatch", "misaligned", "wrong_unit", "flat", "nonfinite_samples", "saturated"),
    "biased",
)
T = TypeVar("T")

Load = Callable[[int], tuple[Recording, AbstractFeed]]
"""Reads the recording of a row, and its driver. Its error becomes the verdict of this row."""


class Refusal(NamedTuple):
    """A recording that cannot be fitted: the name of its verdict and a note."""

    name: str
    note: str

    @classmethod
    def of(cls, error: Exception) -> "Refusal":
        """The refusal of a recording that cannot be read, or whose driver failed."""
        if isinstance(error, IdentificationError):
            return cls("driver_failed", str(error))
        if isinstance(error, RecordingError):  # all recordings are of one file, so it is not said
            error = RecordingError(
                error.message, path=error.path, field=error.field, remedy=error.remedy
            )
        return cls("unreadable", str(error))


def prepared(
    load: Load, rows: Iterator[int], options: Options
) -> list[tuple[int, Prepared | Refusal]]:
    """The next recordings, or the reasons why they cannot be fitted.

    Recordings of equal length and rates are inspected together. At least `FEWEST` recordings are
    taken from `rows`, and up to 64 as long as they have no more than `TOGETHER` samples.

    Args:
        load: Reads a recording and its driver.
        rows: Numbers of the recordings; the order of the results may differ.
        options: What the caller asks for.
    """
    found: list[tuple[int, Prepared | Refusal]] = []
    loaded: dict[tuple[int, str, float, float], list[tuple[int, Recording, AbstractFeed]]] = {}
    held = 0
    for number, row in enumerate(itertools.islice(rows, 64), 1):
        try:
            of, driver = load(row)
        except ERRORS as error:
            found.append((row, Refusal.of(error)))
        else:
            key = of.samples["v_out"].stored.size, of.cause, of.sample_rate, of.pulse_rate
            loaded.setdefault(key, []).append((row, of, driver))
            held += key[0]
            if number >= FEWEST and held + key[0] > TOGETHER:
                break
    planned: dict[type[AbstractLane], list[tuple[int, tuple[Inspected, AbstractFeed, Any]]]] = {}
    for row, seen, driver in _inspected(loaded.values()):
        chosen = _planned(options, seen, driver)
        if isinstance(chosen, Refusal):
            found.append((row, chosen))
        else:
            planned.setdefault(chosen.lane_of(seen), []).append((row, (seen, driver, chosen)))
    for kind, alike in planned.items():
        lanes = kind.of_several([seen for _, (seen, *_) in alike])
        for (row, (seen, driver, estimator)), lane in zip(alike, lanes, strict=True):
            shared = is_shared(seen, driver)
            found.append((row, Prepared(seen, driver, estimator, lane, shared)))
    return found


def _planned(
    options: Options, seen: Inspected, driver: AbstractFeed
) -> AbstractEstimator | Refusal:
    """The estimator of a recording, or why it cannot be fitted."""
    try:
        estimator, name = plan(options, seen, driver)
    except ERRORS as error:
        return Refusal.of(error)
    if name is not None:
        return Refusal(name, explained(seen, name))
    return estimator


def _inspected(
    alike: Iterable[Sequence[tuple[int, Recording, AbstractFeed]]],
) -> Iterator[tuple[int, Inspected, AbstractFeed]]:
    """Recordings, each sequence of equal length and rates, with their properties."""
    for several in alike:
        together = max(1, TOGETHER // max(1, several[0][1].samples["v_out"].stored.size))
        for first in range(0, len(several), together):
            part = several[first : first + together]
            for (row, _, driver), seen in zip(
                part, inspected([of for _, of, _ in part]), strict=True
            ):
                yield row, seen, driver


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
    rows, chunks = iter(range(count)), -(-count // FEWEST)  # of which the last may be empty

    @in_float64  # the setting belongs to a thread, and this runs in another one
    def read(_: int) -> list[tuple[int, Prepared | Refusal]]:
        return prepared(load, rows, options)

    with (
        tqdm(total=count, unit="fit", disable=not progress) as bar,
        contextlib.closing(prefetch(read, chunks, ahead=2)) as found,
    ):
        for row, one in itertools.chain.from_iterable(chunk() for chunk in found):
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


def explained(seen: Inspected, name: str) -> str:
    """The message of a verdict of `etid.recordings.preflight`, with the numbers found."""
    found = ""
    if seen.by_current is not None and name in EXPLAINED and preflight(seen) != name:
        seen = seen.by_current  # the fault is in the current
    if name == "rate_mismatch":
        found = why_rates_differ(seen)
    elif name == "misaligned":
        found = why_misaligned(seen)
    elif name == "biased":
        found = " ".join(texts(seen.remarks & Remark.pulse_rate_counted))
    elif name == "wrong_unit":
        found = why_implausible(seen.by_current or seen)
    elif name == "saturated" and seen.has_current:
        return f"{message(name)} A current that is commanded may rest at its value: state `hold`."
    elif name in ("flat", "nonfinite_samples"):
        found = f"The fault is in {' and '.join(_faulty(seen, name))}."
    return f"{found} {message(name)}".strip()


def _faulty(seen: Inspected, name: str) -> list[str]:
    """Names of the records that are flat, or that hold numbers that are not finite."""
    records = seen.recording.cause, "v_out"
    if name == "flat":
        faults = seen.is_flat
    else:
        faults = [not np.isfinite(seen.recording.samples[one].values).all() for one in records]
    return [one for one, fault in zip(records, faults, strict=True) if fault]


def failed_fit(name: str, options: Options, method: str) -> Fit:
    """A fit without numbers, for a recording that was not fitted."""
    circuit = options.circuit
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    none = changes.unknown(size)
    fit = Fit(
        circuit=circuit.with_log_values(jnp.full(size, jnp.nan)),
        cov=nan,
        shared_cov=nan,
        rrse=np.asarray(np.nan),
        chi2=np.asarray(np.nan),
        result=verdict(name),
        steps=np.asarray(0),
        method=method,
        change=none.size,
        change_stderr=none.stderr,
        support=Support.unknown(size),
        limits=limited(circuit, of_circuit(options.bounds, circuit)),
        by_tolerance=Effects.unknown(size),
    )
    return jax.tree.map(np.asarray, fit)
