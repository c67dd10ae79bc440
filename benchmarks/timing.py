"""How times are measured: on one core, medians, compilation apart."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

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


def median_time(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time [s] after a first call."""
    runs = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        runs.append(time.perf_counter() - start)
    return float(np.median(runs[1:]))
