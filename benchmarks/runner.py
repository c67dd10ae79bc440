"""What all benchmarks share: options, tasks in processes, tables that grow, and targets.

A benchmark is a module with `OPTIONS` and `main(arguments)`, which returns whether every target is
met; the first line of its docstring is its help. One that measures time has `PINNED = True`.
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

import jax
import numpy as np
from tqdm import tqdm

from benchmarks.machine import RESULTS, ROOT, make_room, provenance, write_csv
from benchmarks.rates import Rate
from etid.identify import file as streaming
from etid.recordings.replacing import replacing

KEPT = ROOT / "results" / "kept"  # what tasks found

Option = Callable[[argparse.ArgumentParser], Any]


def option(*names: str, default: Any = None, **settings: Any) -> Option:
    """An option; its default tells its type: False makes a flag, a tuple several values."""
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
FOLDER = option("--folder", default=RESULTS, help="of tables and pictures")


def each(
    call: Callable[..., Any],
    tasks: Sequence[tuple],
    workers: int = 1,
    unit: str = "task",
    keep: str = "",
    first: Callable[..., Any] | None = None,
) -> Iterator[tuple[int, Any]]:
    """Results of a call with the numbers of their tasks, as they are done.

    `keep` names a folder in which they are kept for other runs of this commit with these versions;
    nothing is kept while the working tree is not that of a commit. Tasks with the smallest `first`
    are begun first.
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
        if first is not None:
            left.sort(key=lambda number: first(*tasks[number]))
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
    place = KEPT / f"{name}-{hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]}"
    for other in {*KEPT.glob(f"{name}-*")} - {place}:
        shutil.rmtree(other)
    return place


def _done(call: Callable[..., Any], *task: Any) -> Any:
    """A task in float64, in a worker process as well, and room for what the next one compiles."""
    with jax.enable_x64(True):
        found = call(*task)
    make_room()
    return found


def _called(
    call: Callable[..., Any], tasks: Mapping[int, tuple], workers: int
) -> Iterator[tuple[int, Any]]:
    if workers == 1 or len(tasks) < 2:
        yield from ((number, _done(call, *task)) for number, task in tasks.items())
        return
    with streaming.processes(workers) as executor:
        futures = {executor.submit(_done, call, *task): number for number, task in tasks.items()}
        for future in concurrent.futures.as_completed(futures):
            yield futures[future], future.result()


def tabled(
    path: pathlib.Path,
    rows: Callable[[dict[int, Any]], Sequence[Mapping[str, Any]]],
    call: Callable[..., Any],
    tasks: Sequence[tuple],
    **settings: Any,
) -> list[Any]:
    """Results in the order of the tasks; after each, the `rows` of what is done are written."""
    done: dict[int, Any] = {}
    for number, found in each(call, tasks, **settings):
        done[number] = found
        done = {i: done[i] for i in sorted(done)}
        write_csv(path, rows(done))
    return list(done.values())


def show(row: Mapping[str, Any], *names: str) -> None:
    """Print some columns of a row in a line, or all."""
    texts = {
        name: format(row[name], ".4g") if isinstance(row[name], float) else str(row[name])
        for name in names or row
    }
    tqdm.write("  ".join(f"{name} {text}" for name, text in texts.items() if text))


Limits = tuple[float, float]  # least and largest value that meet a target; NaN for none


def at_least(least: float) -> Limits:
    """Limits of a number that is to be large."""
    return least, np.nan


def at_most(most: float) -> Limits:
    """Limits of a number that is to be small."""
    return np.nan, most


class Target(NamedTuple):
    """A number that was measured, and its limits; NaN for none."""

    name: str  # what was measured
    value: float
    least: float = np.nan
    most: float = np.nan
    text: str = ""  # how it is printed, if not as the number
    interval: tuple[float, float] | None = None  # its scatter, if known; it excuses nothing

    @classmethod
    def of(
        cls,
        limits: Mapping[str, Limits],
        name: str,
        value: float | Rate,
        before: str = "",
        after: str = "",
        text: str = "",
        interval: tuple[float, float] | None = None,
    ) -> "Target":
        """A number or a rate with the limits that its name has, if any.

        What stands `before` or `after` the name says which of several numbers it is.
        """
        if isinstance(value, Rate):
            text, interval, value = str(value), (value.low, value.high), value.rate
        of = limits.get(name, (np.nan, np.nan))
        return cls(f"{before}{name}{after}", value, *of, text, interval)

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


def report(targets: Iterable[Target], path: pathlib.Path | None = None) -> bool:
    """Print numbers with their targets, and write them as CSV if asked; whether all are met."""
    every = list[Target]()
    for one in targets:
        print(one, flush=True)
        every.append(one)
    if path is not None:
        heads = ("quantity", "value", "least", "most")
        write_csv(path, [dict(zip(heads, one, strict=False)) for one in every])
    return all(one.met for one in every)
