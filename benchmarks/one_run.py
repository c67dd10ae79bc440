"""One measurement in a process of its own, whose peak memory is the measurement's.

`python -m benchmarks.one_run JOB` with a JSON object; prints another.
"""

import contextlib
import json
import pathlib
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import h5py
import jax

import etid
from etid.identify import file as streaming


def by_h5py(file: str, whole_stacks: bool) -> None:
    """Read all samples with h5py alone, one recording after the other or a stack at once."""

    def visit(_: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and (item.ndim == 1 or whole_stacks):
            item[()]
        elif isinstance(item, h5py.Dataset):
            for row in range(item.shape[0]):
                item[row]

    with h5py.File(file) as opened:
        opened.visititems(visit)


def by_etid(file: str) -> None:
    """Load all recordings."""
    with etid.read(file) as study:
        for _ in study.recordings():
            pass


READERS: dict[str, Callable[[str], None]] = {
    "h5py": lambda file: by_h5py(file, False),
    "h5py, whole stacks": lambda file: by_h5py(file, True),
    "etid": by_etid,
}


def fit(job: dict[str, Any]) -> dict[str, Any]:
    """Fit a file; the same with a small one before, so that compilation is apart."""
    arguments: dict[str, Any] = {"method": job["method"]}
    with contextlib.ExitStack() as stack:
        if job["workers"] > 1:
            arguments["executor"] = stack.enter_context(streaming.processes(job["workers"]))
        start = 0.0
        if job["warm"]:
            target = pathlib.Path(job["target"]).with_suffix(".warm.h5")
            streaming.PART = job["warm_part"]
            start = _timed(lambda: streaming.fit_file(job["warm"], target, **arguments))[1]
            target.unlink()
        streaming.PART = job["part"]
        if job["log"]:
            _log_parts(job["log"])
        arguments["resume"], before = job["resume"], time.process_time()
        outcome, seconds = _timed(
            lambda: streaming.fit_file(job["file"], job["target"], **arguments)
        )
        cpu = time.process_time() - before
    # Of workers, which have ended here, it contains their start.
    workers = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu += workers.ru_utime + workers.ru_stime
    return {"start": start, "seconds": seconds, "cpu": cpu, "verdicts": outcome.fits.counts()}


def _log_parts(log: str) -> None:
    """Note each part when it is begun."""
    real = streaming.identify_part

    def logged(drivers, paths, *rest):
        with open(log, "a") as file:
            file.write(f"{paths[0]}\n")
        return real(drivers, paths, *rest)

    streaming.identify_part = logged


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.perf_counter()
    found = call()
    return found, time.perf_counter() - begin


def main(job: dict[str, Any]) -> dict[str, Any]:
    """Do a job; seconds, and peak memory of this process and of its largest child [B]."""
    if job["what"] == "fit":
        found = fit(job)
    else:
        found = {"seconds": _timed(lambda: READERS[job["what"]](job["file"]))[1]}
    own, children = (
        1024 * resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return {**found, "memory": own, "worker_memory": children}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(main(json.loads(sys.argv[1]))))
