"""Import, first call and warm time of one fit and of a batch: medians, compilation apart."""

import argparse
import contextlib
import functools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

import etid
from benchmarks.runner import option
from etid.estimators.registry import names

OPTIONS = (option("--lanes", default=98, help="of the batch"),)
REPEATS = 7
IMPORTS = 3


def pin() -> None:
    """One core for this process, before JAX counts them."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@contextlib.contextmanager
def cores(count: int) -> Iterator[None]:
    """So many cores, if there are, for the processes that begin here."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(own)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)


def interpreter() -> dict[str, str]:
    """Environment of an interpreter that keeps its bytecode, as users' interpreters do."""
    return {name: of for name, of in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def import_time(module: str) -> float:
    """Wall time [s] of importing a module in a fresh interpreter, median after a first one."""
    code = f"import time; t = time.perf_counter(); {module}; print(time.perf_counter() - t)"
    command = [sys.executable, "-c", code]
    runs = [
        subprocess.run(command, env=interpreter(), capture_output=True, check=True).stdout
        for _ in range(1 + IMPORTS)
    ]
    return float(np.median(np.array(runs[1:], float)))


def first_and_warm(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Wall time [s] of the first call and the median of the next ones."""
    runs = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        runs.append(time.perf_counter() - start)
    return runs[0], float(np.median(runs[1:]))


def median_time(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time [s] after a first call."""
    return first_and_warm(call, repeats)[1]


def main(arguments: argparse.Namespace) -> bool:
    """Print the table."""
    lanes = arguments.lanes
    base, own = import_time("import jax, optimistix"), import_time("import etid")
    print(f"import jax + optimistix {base:.2f} s, import etid {own:.2f} s, ratio {own / base:.2f}")
    study = etid.scenes.paper_dry().simulate(seed=0)
    calibration = next(iter(study.calibrations.recordings()))
    recordings = list(study.loaded.recordings())
    many = (recordings * (lanes // len(recordings) + 1))[:lanes]
    first, warm = first_and_warm(lambda: etid.identify_driver(calibration, throw=False), 3)
    print(f"driver, first call           {first:8.2f} s   warm {warm:.3f} s")
    driver = etid.identify_driver(calibration, throw=False)
    for method in names():
        given: dict[str, Any] = {"driver": driver, "method": method}
        fit = functools.partial(etid.identify_skin, recordings[0], throw=False, **given)
        first, warm = first_and_warm(fit, REPEATS)
        print(f"skin {method:<27} first {first:8.2f} s   warm {1e3 * warm:.1f} ms")
        fits = functools.partial(etid.identify_skins, many, **given)
        first, warm = first_and_warm(lambda fits=fits: fits().chi2, 3)
        each = 1e3 * warm / lanes
        print(f"  batch of {lanes:<21} first {first:8.2f} s   warm {each:.1f} ms per fit")
    return True
