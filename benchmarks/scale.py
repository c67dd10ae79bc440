"""A file of 10^5 recordings: how long reading and fitting take, in how much memory, and `kill -9`.

Every measurement runs in a process of its own, on as many cores as it has workers. The file lies
in the page cache, which flatters reading; reading alone is h5py, recording after recording.
Compilation is in no time but `start` and the CPU time of workers, which tells of other work on the
machine.
"""

import argparse
import collections
import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import h5py
import numpy as np

from benchmarks.large_file import LAYOUTS, large_file
from benchmarks.provenance import ROOT, write_csv
from benchmarks.runner import QUICK, option
from benchmarks.timing import cores
from etid.estimators.registry import names
from etid.identify import file as streaming

FILES = pathlib.Path(tempfile.gettempdir()) / "etid-scale"
EACH = 2e-4  # [s] reading and fitting one recording on one core
TWICE = 1.9  # speed of two workers, relative to one
MEMORY = 1.2e9  # [B]
KILLS = 3
SEED = 9
WORKERS = (1, 2)  # 1 is the process itself
WARM = 8  # recordings that make every process compile
PATIENCE = 0.002  # [s] between two looks at a run that is to be killed


class Plan(NamedTuple):
    """What to measure.

    Attributes:
        folder: Where the files are or will be.
        recordings: How many in a file.
        part: How many are written at once.
        methods: Estimators; None is the default one.
        killed: Estimator of the run that is killed.
    """

    folder: pathlib.Path
    recordings: int
    part: int
    methods: Sequence[str | None]
    killed: str | None


def plan(folder: pathlib.Path, recordings: int, methods: Sequence[str], quick: bool) -> Plan:
    """The plan of the command line."""
    if quick:
        return Plan(folder, min(recordings, 400), 32, ("equation_error",), "equation_error")
    chosen = [None if name == "default" else name for name in methods]
    return Plan(folder, recordings, streaming.PART, chosen, chosen[-1])


def _command(job: dict[str, Any]) -> list[str]:
    return [sys.executable, "-m", "benchmarks.one_run", json.dumps(job)]


def _environment(folder: pathlib.Path) -> dict[str, str]:
    """Compilations are shared, or each worker would need half a minute more."""
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(folder.absolute() / "xla"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return os.environ | cache


def measured(folder: pathlib.Path, job: dict[str, Any]) -> dict[str, Any]:
    """Do one job in a process of its own."""
    with cores(job.get("workers", 1)):
        done = subprocess.run(
            _command(job), cwd=ROOT, env=_environment(folder), stdout=subprocess.PIPE, check=True
        )
    return json.loads(done.stdout)


def fit_job(plan: Plan, layout: str, method: str | None, workers: int) -> dict[str, Any]:
    """A job that fits a file."""
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
    verdicts = found.get("verdicts", {})
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
        "successful": verdicts.get("successful", 0),
    }


def rows(plan: Plan) -> Iterable[dict[str, Any]]:
    """Reading in all layouts, fitting by all methods; one row each."""
    for layout in LAYOUTS:
        file = str(large_file(plan.folder, plan.recordings, layout).absolute())
        for what in ("h5py", "h5py, whole stacks", "etid"):
            found = measured(plan.folder, {"what": what, "file": file})
            yield _row(plan, f"read: {what}", layout, 1, found)
        for method in plan.methods if layout == "contiguous" else plan.methods[-1:]:
            for workers in WORKERS if layout == "contiguous" else (1,):
                found = measured(plan.folder, fit_job(plan, layout, method, workers))
                yield _row(plan, f"fit: {method or 'default'}", layout, workers, found)


class Resumed(NamedTuple):
    """What became of a run that was killed.

    Attributes:
        same: Whether its file is bit for bit that of a run that was not.
        parts: How many parts the file has.
        killed_at: How many parts were there at each kill.
        begun: How many parts were begun in all.
        only_the_last: Whether none was begun anew but those that a kill interrupted.
    """

    same: bool
    parts: int
    killed_at: list[int]
    begun: int
    only_the_last: bool

    @property
    def passed(self) -> bool:
        """Whether nothing was lost and nothing done twice."""
        return self.same and self.only_the_last and self.begun <= self.parts + len(self.killed_at)


def resume(plan: Plan) -> Resumed:
    """Kill a run at seeded moments, resume it, and compare with a run that was left alone."""
    job = fit_job(plan, "contiguous", plan.killed, 1) | {"warm": ""}
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
        with subprocess.Popen(
            _command(again), cwd=ROOT, env=_environment(plan.folder), stdout=subprocess.PIPE
        ) as process:
            while len(list(folder.glob("*.h5"))) < moment and process.poll() is None:
                time.sleep(PATIENCE)
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
        killed_at.append(len(list(folder.glob("*.h5"))))
        interrupted.append(log.read_text().splitlines()[-1])
    measured(plan.folder, again)
    begun = collections.Counter(log.read_text().splitlines())
    allowed = collections.Counter(begun.keys()) + collections.Counter(interrupted)
    found = Resumed(_same(whole, target), parts, killed_at, begun.total(), begun <= allowed)
    for path in (whole, target, log):
        path.unlink()
    return found


def _same(one: pathlib.Path, other: pathlib.Path) -> bool:
    """Whether two files hold the same arrays, bit for bit."""
    with h5py.File(one) as a, h5py.File(other) as b:
        return set(a) == set(b) and all(
            _bits(np.asarray(a[name])) == _bits(np.asarray(b[name])) for name in a
        )


def _bits(column: np.ndarray) -> Any:
    """What is equal if all bits are, NaN too; texts are objects, whose bits are addresses."""
    return column.tolist() if column.dtype.hasobject else column.tobytes()


def run(plan: Plan, output: pathlib.Path | None) -> bool:
    """Print the table, write it as CSV; whether every target is met."""
    print(f"{plan.recordings} recordings in {plan.folder}, parts of {plan.part}")
    heads = ("CPU s", "us each", "of reading", "start s", "MB", "MB/worker", "successful")
    print(f"{'':<30}{'layout':<12}{'workers':>7}{'s':>9}" + "".join(f"{h:>11}" for h in heads))
    table: list[dict[str, Any]] = []
    for row in rows(plan):
        table.append(row)
        alone = next(r for r in table if r["layout"] == row["layout"])  # the first reads by h5py
        row["of_reading"] = row["seconds"] / alone["seconds"]
        print(
            f"{row['what']:<30}{row['layout']:<12}{row['workers']:>7}{row['seconds']:9.2f}"
            f"{row['cpu_seconds']:11.1f}{row['us_per_recording']:11.1f}{row['of_reading']:11.1f}{row['start_seconds']:11.1f}"
            f"{row['memory_mb']:11.0f}{row['worker_memory_mb']:11.0f}{row['successful']:11}",
            flush=True,
        )
    with contextlib.suppress(FileNotFoundError):
        (plan.folder / "fits.h5").unlink()
    resumed = resume(plan)
    print(
        f"resume: killed with {', '.join(map(str, resumed.killed_at))} of {resumed.parts} parts "
        f"done; {resumed.begun} begun in all, "
        f"{'no' if resumed.only_the_last else 'SOME'} finished part a second time; "
        f"the file is {'the same' if resumed.same else 'ANOTHER'}, bit for bit"
    )
    if output is not None:
        write_csv(output, table)
    for text, met in _targets(table):
        print(f"{text}: {'met' if met else 'missed'}")
    return all(met for _, met in _targets(table)) and resumed.passed


def _targets(table: Sequence[dict[str, Any]]) -> Iterable[tuple[str, bool]]:
    """What is wanted of the last method in contiguous datasets, and whether it is so."""
    fits = [row for row in table if row["what"].startswith("fit")]
    alone, two = [row for row in fits if row["layout"] == "contiguous"][-len(WORKERS) :]
    each, gain = alone["us_per_recording"], alone["seconds"] / two["seconds"]
    most = max(row["memory_mb"] for row in fits)
    yield f"{each:.0f} us a recording <= {1e6 * EACH:.0f}", each <= 1e6 * EACH
    yield f"two workers {gain:.2f} times as fast >= {TWICE}", gain >= TWICE
    yield f"peak memory {most:.0f} MB <= {MEMORY / 1e6:.0f}", most <= MEMORY / 1e6


OPTIONS = (
    QUICK,
    option("--recordings", default=100_000),
    option("--folder", default=FILES, type=pathlib.Path, help="of the files it makes"),
    option("--method", nargs="+", type=str, choices=("default", *names()),
           default=["default", "equation_error"], help="the last: in all layouts, and killed"),
    option("-o", "--output", type=pathlib.Path, help="CSV to write"),
)  # fmt: skip


def main(arguments: argparse.Namespace) -> bool:
    """Run the command; whether every target is met."""
    chosen = plan(arguments.folder, arguments.recordings, arguments.method, arguments.quick)
    return run(chosen, arguments.output)
