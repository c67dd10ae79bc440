"""The machine: where numbers come from, how times are measured, and room for compiled programs.

Beside every row of a CSV stand commit, machine and versions. Times are medians of processor time on
one core, which other work on the machine does not lengthen by much, compilation apart.
"""

import contextlib
import csv
import importlib.metadata
import os
import pathlib
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

import etid

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"  # of the last full run, which the README shows
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy", "h5py")
IMPORTS = 3
MAPPINGS = 30_000  # half of what Linux allows; one test file needs a few thousand


def provenance() -> dict[str, str]:
    return {
        "commit": _commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        "etid": etid.__version__,
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def _commit() -> str:
    """The commit, with a + if the working tree differs from it, other than by results of a run."""
    results = RESULTS.relative_to(ROOT)  # `:!/…` would mean something else to git
    changed = ["git", "diff", "--name-only", "HEAD", "--", ".", f":!{results}"]
    try:
        commit, names = (
            subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
            for command in (["git", "rev-parse", "--short=12", "HEAD"], changed)
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.strip() + "+" * bool(names)


def _processor() -> str:
    described = pathlib.Path("/proc/cpuinfo")
    if described.exists():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_csv(path: pathlib.Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows, each with `provenance` unless it has one of an earlier run; no file if none."""
    if not rows:
        return path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    source = provenance()
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(dict.fromkeys([*rows[0], *source])))
        writer.writeheader()
        writer.writerows({**source, **row} for row in rows)
    return None


def read_csv(path: pathlib.Path) -> list[dict[str, Any]]:
    """Rows of `write_csv`, with numbers as numbers; none if there is no file."""
    if not path.exists():
        return []
    words = {*provenance()}  # a commit may look like a number
    with path.open(newline="") as file:
        return [
            {name: text if name in words else _value(text) for name, text in row.items()}
            for row in csv.DictReader(file)
        ]


def _value(text: str) -> Any:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


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
    """Processor time [s] to import a module in a fresh interpreter, median after a first one."""
    code = f"import time; t = time.process_time(); {module}; print(time.process_time() - t)"
    command = [sys.executable, "-c", code]
    runs = [
        subprocess.run(command, env=interpreter(), capture_output=True, check=True).stdout
        for _ in range(1 + IMPORTS)
    ]
    return float(np.median(np.array(runs[1:], float)))


def median_time(call: Callable[[], Any], repeats: int) -> float:
    """Median processor time [s] after a first call."""
    times = [timed(call, time.process_time)[1] for _ in range(repeats + 1)]
    return float(np.median(times[1:]))


def timed(
    call: Callable[[], Any], clock: Callable[[], float] = time.perf_counter
) -> tuple[Any, float]:
    """What a call gives, and how long it takes [s]."""
    begin = clock()
    found = jax.block_until_ready(call())
    return found, clock() - begin


def make_room() -> None:
    """Forget what was compiled before the process runs out of mappings.

    XLA maps memory for every executable, and beyond the 65 530 mappings that Linux allows a process
    the compiler crashes: one process would, that runs all tests, or all cells of a map.
    """
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MAPPINGS:
        jax.clear_caches()
