"""What all benchmarks share: how they are asked, tasks in processes, and targets.

A benchmark is a module with `OPTIONS` and `main(arguments)`, which returns whether every target is
met. The first line of its docstring is its help. One that measures time has `PINNED = True`.
"""

import argparse
import concurrent.futures
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.provenance import RESULTS
from etid.identify import file as streaming

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
    call: Callable[..., Any], tasks: Sequence[tuple], workers: int, unit: str = "task"
) -> Iterator[tuple[int, Any]]:
    """Results of a call with their numbers, as they are done, in `workers` processes."""
    with tqdm(total=len(tasks), unit=unit, disable=None) as bar:
        if workers == 1:
            for number, task in enumerate(tasks):
                yield number, call(*task)
                bar.update()
            return
        with streaming.processes(workers) as executor:
            futures = {executor.submit(call, *task): i for i, task in enumerate(tasks)}
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
                bar.update()


class Target(NamedTuple):
    """A number that was measured, and its limits; NaN for none.

    Attributes:
        name: What was measured.
        value: The number that must keep to the limits.
        least: Smallest value that meets the target.
        most: Largest one.
        text: How it is printed, if not as the number.
    """

    name: str
    value: float
    least: float = np.nan
    most: float = np.nan
    text: str = ""

    @property
    def met(self) -> bool:
        """Whether no limit is missed; a number that could not be had misses its limits."""
        above = np.isnan(self.least) or self.value >= self.least
        return bool(above and (np.isnan(self.most) or self.value <= self.most))

    def __str__(self) -> str:
        signs = ((">=", self.least), ("<=", self.most))
        limits = " and ".join(f"{sign} {of:.4g}" for sign, of in signs if not np.isnan(of))
        said = f"   target {limits}{'' if self.met else ', missed'}" if limits else ""
        return f"{self.name:<58} {self.text or format(self.value, '.4g')}{said}"


def report(targets: Iterable[Target]) -> bool:
    """Print numbers with their targets; whether all are met."""
    every = list(targets)
    for one in every:
        print(one, flush=True)
    return all(one.met for one in every)
