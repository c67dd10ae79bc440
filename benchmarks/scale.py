"""A file of 10^5 recordings: how long reading and fitting take, in how much memory, and `kill -9`.

Every measurement is a job in a process of its own, whose peak memory is the job's, on as many cores
as it has workers: `python -m benchmarks.scale JOB` with a JSON object prints another. The file lies
in the page cache, which flatters reading. Compilation is in no time but `start` and the CPU time of
workers, which tells of other work on the machine.
"""

import argparse
import collections
import contextlib
import json
import os
import pathlib
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np

import etid
from benchmarks.large_file import LAYOUTS, large_file
from benchmarks.machine import ROOT, cores, timed, write_csv
from benchmarks.runner import QUICK, Target, at_least, at_most, option, report, show
from etid.identify import file as streaming

FILES = pathlib.Path(tempfile.gettempdir()) / "etid-scale"
# Of the last method in contiguous datasets.
TARGETS = {
    "microseconds a recording, read and fitted on one core": at_most(200.0),
    "two workers, times as fast as one": at_least(1.9),
    "peak memory [MB]": at_most(1200.0),
    "parts lost or done twice by a killed run": at_most(0),
}
KILLS = 3
SEED = 9
WORKERS = (1, 2)  # 1 is the process itself
WARM = 8  # recordings that make every process compile
PATIENCE = 0.002  # [s] between two looks at a run that is to be killed

METHODS = (None, "steiglitz_mcbride(iterations=1)")  # None is the default one
OPTIONS = (
    QUICK,
    option("--recordings", default=100_000),
    option("--folder", default=FILES, help="of the files it makes"),
    option("-o", "--output", type=pathlib.Path, help="CSV to write"),
)


def _by_h5py(file: str, whole_stacks: bool) -> None:
    def visit(_: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and (item.ndim == 1 or whole_stacks):
            item[()]
        elif isinstance(item, h5py.Dataset):
            for row in range(item.shape[0]):
                item[row]

    with h5py.File(file) as opened:
        opened.visititems(visit)


def _by_etid(file: str) -> None:
    with etid.read(file) as study:
        for _ in study.recordings():
            pass


READERS: dict[str, Callable[[str], None]] = {
    "h5py": lambda file: _by_h5py(file, False),
    "h5py, whole stacks": lambda file: _by_h5py(file, True),
    "etid": _by_etid,
}


def _fit(job: dict[str, Any]) -> dict[str, Any]:
    """Fit a file; the same with a small one before, so that compilation is apart."""
    arguments: dict[str, Any] = {"method": job["method"]}
    with contextlib.ExitStack() as stack:
        if job["workers"] > 1:
            arguments["executor"] = stack.enter_context(streaming.processes(job["workers"]))
        start = 0.0
        if job["warm"]:
            target = pathlib.Path(job["target"]).with_suffix(".warm.h5")
            streaming.PART = job["warm_part"]
            start = timed(lambda: streaming.fit_file(job["warm"], target, **arguments))[1]
            target.unlink()
        streaming.PART = job["part"]
        if job["log"]:
            _log_parts(job["log"])
        arguments["resume"], before = job["resume"], time.process_time()
        outcome, seconds = timed(
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


def done(job: dict[str, Any]) -> dict[str, Any]:
    """Do a job; seconds, and peak memory of this process and of its largest child [B]."""
    if job["what"] == "fit":
        found = _fit(job)
    else:
        found = {"seconds": timed(lambda: READERS[job["what"]](job["file"]))[1]}
    own, children = (
        1024 * resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return {**found, "memory": own, "worker_memory": children}


class Plan(NamedTuple):
    """What to measure."""

    folder: pathlib.Path  # where the files are or will be
    recordings: int  # how many in a file
    part: int  # how many are written at once
    methods: Sequence[str | None]  # the last is killed, and run in all layouts


def _start(folder: pathlib.Path, job: dict[str, Any]) -> subprocess.Popen[bytes]:
    """A process that does a job; compilations are shared, or each would need half a minute more."""
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(folder.absolute() / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, "-m", "benchmarks.scale", json.dumps(job)]
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | cache, stdout=subprocess.PIPE)


def measured(folder: pathlib.Path, job: dict[str, Any]) -> dict[str, Any]:
    with cores(job.get("workers", 1)), _start(folder, job) as process:
        said, _ = process.communicate()
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    return json.loads(said)


def fit_job(plan: Plan, layout: str, method: str | None, workers: int) -> dict[str, Any]:
    return {
        "what": "fit",
        "file": str(large_file(plan.folder, plan.recordings, layout).absolute()),
        "target": str(plan.folder.absolute() / "fits.h5"),
        "warm": str(large_file(plan.folder, WARM, layout).absolute()),
        "warm_part": WARM // workers,
        "part": plan.part,
        "method": method,
        "workers": workers,
        "resume": False,
        "log": "",
    }


def _row(plan: Plan, name: str, layout: str, workers: int, found: dict[str, Any]) -> dict[str, Any]:
    return {
        "what": name,
        "layout": layout,
        "workers": workers,
        "recordings": plan.recordings,
        "seconds": found["seconds"],
        "cpu_seconds": found.get("cpu", 0.0),
        "us_per_recording": 1e6 * found["seconds"] / plan.recordings,
        "start_seconds": found.get("start", 0.0),
        "memory_mb": found["memory"] / 1e6,
        "worker_memory_mb": found["worker_memory"] / 1e6 if workers > 1 else 0.0,
        "successful": found.get("verdicts", {}).get("successful", 0),
    }


def rows(plan: Plan) -> Iterator[dict[str, Any]]:
    """Reading in all layouts, fitting by all methods; one row each."""
    for layout in LAYOUTS:
        file = str(large_file(plan.folder, plan.recordings, layout).absolute())
        for what in READERS:
            found = measured(plan.folder, {"what": what, "file": file})
            yield _row(plan, f"read: {what}", layout, 1, found)
        usual = layout == "contiguous"
        for method in plan.methods if usual else plan.methods[-1:]:
            for workers in WORKERS if usual or layout == "groups" else (1,):
                found = measured(plan.folder, fit_job(plan, layout, method, workers))
                yield _row(plan, f"fit: {method or 'default'}", layout, workers, found)


def resume(plan: Plan) -> bool:
    """Kill a run at seeded moments, resume it, and compare with a run that was left alone.

    Whether the file is the same, and no part was done again but those that a kill interrupted.
    """
    job = fit_job(plan, "contiguous", plan.methods[-1], 1) | {"warm": ""}
    whole, target = (plan.folder.absolute() / f"{name}.h5" for name in ("whole", "resumed"))
    log = target.with_suffix(".log")
    log.unlink(missing_ok=True)
    alone = measured(plan.folder, job | {"target": str(whole)})
    parts = -(-plan.recordings // plan.part)
    draws = np.random.default_rng(SEED)
    # A kill when so many parts are there, and some part of the time of one later.
    moments = np.sort(draws.choice(np.arange(1, parts), KILLS, replace=False))
    delays = draws.uniform(0, alone["seconds"] / parts, KILLS)
    again = job | {"target": str(target), "log": str(log), "resume": True}
    folder = target.with_name(target.name + ".parts")
    killed_at, interrupted = [], []
    for moment, delay in zip(moments, delays, strict=True):
        with _start(plan.folder, again) as process:
            while len(list(folder.glob("*.h5"))) < moment and process.poll() is None:
                time.sleep(PATIENCE)
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
        killed_at.append(len(list(folder.glob("*.h5"))))
        interrupted.append(log.read_text().splitlines()[-1])
    measured(plan.folder, again)
    begun = collections.Counter(log.read_text().splitlines())
    once = begun <= collections.Counter(begun.keys()) + collections.Counter(interrupted)
    same = _same(whole, target)
    for path in (whole, target, log):
        path.unlink()
    print(
        f"resume: killed with {', '.join(map(str, killed_at))} of {parts} parts done; "
        f"{begun.total()} begun in all, {'no' if once else 'SOME'} finished part a second time; "
        f"the file is {'the same' if same else 'ANOTHER'}, bit for bit"
    )
    return same and once and begun.total() <= parts + KILLS


def _same(one: pathlib.Path, other: pathlib.Path) -> bool:
    """Whether two files hold the same arrays, bit for bit."""

    def bits(column: np.ndarray) -> Any:  # texts are objects, whose bits are addresses
        return column.tolist() if column.dtype.hasobject else column.tobytes()

    with h5py.File(one) as a, h5py.File(other) as b:
        return set(a) == set(b) and all(
            bits(np.asarray(a[name])) == bits(np.asarray(b[name])) for name in a
        )


def targets(table: Sequence[dict[str, Any]], resumed: bool) -> Iterator[Target]:
    """What is wanted of the last method in contiguous datasets, and of a killed run."""
    fits = [row for row in table if row["what"].startswith("fit")]
    alone, two = [row for row in fits if row["layout"] == "contiguous"][-len(WORKERS) :]
    values = (
        alone["us_per_recording"],
        alone["seconds"] / two["seconds"],
        max(row["memory_mb"] for row in fits),
        float(not resumed),
    )
    yield from (Target.of(TARGETS, *of) for of in zip(TARGETS, values, strict=True))


def main(arguments: argparse.Namespace) -> bool:
    plan = Plan(arguments.folder, arguments.recordings, streaming.PART, METHODS)
    if arguments.quick:
        plan = Plan(arguments.folder, min(arguments.recordings, 400), 32, METHODS[1:])
    table: list[dict[str, Any]] = []
    for row in rows(plan):
        table.append(row)
        alone = next(r for r in table if r["layout"] == row["layout"])  # the first reads by h5py
        row["of_reading"] = row["seconds"] / alone["seconds"]
        show(row)
    (plan.folder / "fits.h5").unlink(missing_ok=True)
    resumed = resume(plan)
    if arguments.output is not None:
        write_csv(arguments.output, table)
    return report(targets(table, resumed))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(done(json.loads(sys.argv[1]))))
