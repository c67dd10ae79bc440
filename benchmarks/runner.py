"""What all benchmarks share: options, tasks in processes, tables that grow, and targets.

A benchmark is a module with `OPTIONS` and `main(arguments)`, which returns whether every target is
met. The first line of its docstring is its help. One that measures time has `PINNED = True`.

A question over many cells is asked in four steps: the tasks (what is drawn in a cell, with which
seeds), `tabled` (does them in processes and writes the table after each), rates of events with
their intervals (`benchmarks.rates`), and the targets, which stand in one table at the head of the
file. What a task found is kept as long as the commit is the same: the same command goes on where
it was interrupted.
"""

import argparse
import concurrent.futures
import hashlib
import json
import pathlib
import pickle
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.machine import RESULTS, ROOT, provenance, write_csv
from benchmarks.rates import Rate
from etid.identify import file as streaming
from etid.recordings.replacing import replacing

KEPT = ROOT / "results" / "kept"  # what tasks found

Option = Callable[[argparse.ArgumentParser], Any]


def option(*names: str, default: Any = None, **settings: Any) -> Option:
    """An option of a benchmark; its default tells its type.

    Args:
        names: As argparse takes them.
        default: False makes a flag, a tuple an option with several values.
        settings: As argparse takes them.
    """
    if default is False:
        settings = {"action": "store_true", **settings}
    elif isinstance(default, tuple):
        settings = {"nargs": "+", "type": type(default[0]), "default": default, **settings}
    else:
        of = {} if default is None else {"type": type(default)}
        settings = {"default": default, **of, **settings}
    return lambda parser: parser.add_argument(*names, **settings)


QUICK = option("--quick", default=False, help="few cases and draws, in a minute or two")
WORKERS = option("--workers", default=2, help="processes, each on a core of its own")
FOLDER = option("--folder", default=RESULTS, type=pathlib.Path, help="of tables and pictures")


def each(
    call: Callable[..., Any],
    tasks: Sequence[tuple],
    workers: int = 1,
    unit: str = "task",
    keep: str = "",
) -> Iterator[tuple[int, Any]]:
    """Results of a call with their numbers, as they are done.

    Args:
        call: What is called with each task.
        tasks: Arguments of the calls.
        workers: Processes; 1 is this one.
        unit: What a task is called.
        keep: Name under which the results are kept, for other runs of this commit with these
            versions; none for an empty name, or while the working tree is not that of a commit.
    """
    folder = _kept(keep) if keep else None

    def place(number: int) -> pathlib.Path:
        assert folder is not None
        name = hashlib.sha256(pickle.dumps((call.__qualname__, tasks[number]))).hexdigest()
        return folder / f"{name[:32]}.pickle"

    with tqdm(total=len(tasks), unit=unit, disable=None) as bar:
        done = {i for i in range(len(tasks)) if folder and place(i).exists()}
        for number in sorted(done):
            yield number, pickle.loads(place(number).read_bytes())
            bar.update()
        left = [number for number in range(len(tasks)) if number not in done]
        for number, found in _called(call, {number: tasks[number] for number in left}, workers):
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                with replacing(place(number)) as partial:
                    partial.write_bytes(pickle.dumps(found))
            yield number, found
            bar.update()


def _kept(name: str) -> pathlib.Path | None:
    """Folder of what was found before; what another commit found is deleted."""
    source = provenance()
    if source["commit"] == "unknown" or source["commit"].endswith("+"):
        return None
    place = hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]
    for other in KEPT.glob(f"{name}-*"):
        if other.name != f"{name}-{place}":
            shutil.rmtree(other)
    return KEPT / f"{name}-{place}"


def _called(
    call: Callable[..., Any], tasks: Mapping[int, tuple], workers: int
) -> Iterator[tuple[int, Any]]:
    if workers == 1 or len(tasks) < 2:
        yield from ((number, call(*task)) for number, task in tasks.items())
        return
    with streaming.processes(workers) as executor:
        futures = {executor.submit(call, *task): number for number, task in tasks.items()}
        for future in concurrent.futures.as_completed(futures):
            yield futures[future], future.result()


def tabled(
    path: pathlib.Path,
    rows: Callable[[dict[int, Any]], Sequence[Mapping[str, Any]]],
    call: Callable[..., Any],
    tasks: Sequence[tuple],
    **settings: Any,
) -> list[Any]:
    """Results in the order of the tasks; the table is written after each.

    Args:
        path: CSV to write.
        rows: Rows of the table of what is done so far, by the number of the task.
        call: What is called with each task.
        tasks: Arguments of the calls.
        settings: Others of `each`.
    """
    done: dict[int, Any] = {}
    for number, found in each(call, tasks, **settings):
        done[number] = found
        done = {i: done[i] for i in sorted(done)}
        write_csv(path, rows(done))
    return list(done.values())


Limits = tuple[float, float]
"""Least and largest value that meet a target; NaN for none."""


def at_least(least: float) -> Limits:
    """Limits of a number that is to be large."""
    return least, np.nan


def at_most(most: float) -> Limits:
    """Limits of a number that is to be small."""
    return np.nan, most


class Target(NamedTuple):
    """A number that was measured, and its limits; NaN for none.

    Attributes:
        name: What was measured.
        value: The number that must keep to the limits.
        least: Smallest value that meets the target.
        most: Largest one.
        text: How it is printed, if not as the number.
        interval: What its scatter allows, if that is known; it excuses nothing.
    """

    name: str
    value: float
    least: float = np.nan
    most: float = np.nan
    text: str = ""
    interval: tuple[float, float] | None = None

    @classmethod
    def of(cls, name: str, value: Rate, limits: Limits = (np.nan, np.nan)) -> "Target":
        """A rate, with its interval."""
        return cls(name, value.rate, *limits, str(value), (value.low, value.high))

    @property
    def met(self) -> bool:
        """Whether no limit is missed; a number that could not be had misses its limits."""
        above = np.isnan(self.least) or self.value >= self.least
        return bool(above and (np.isnan(self.most) or self.value <= self.most))

    def __str__(self) -> str:
        signs = ((">=", self.least), ("<=", self.most))
        limits = " and ".join(f"{sign} {of:.4g}" for sign, of in signs if not np.isnan(of))
        missed = "" if self.met else ", missed"
        if missed and self.interval is not None:
            low, high = self.interval
            if not (high < self.least or low > self.most):
                missed += " within scatter"
        said = f"   target {limits}{missed}" if limits else ""
        return f"{self.name:<58} {self.text or format(self.value, '.4g')}{said}"


def report(targets: Iterable[Target]) -> bool:
    """Print numbers with their targets; whether all are met."""
    every = list(targets)
    for one in every:
        print(one, flush=True)
    return all(one.met for one in every)
