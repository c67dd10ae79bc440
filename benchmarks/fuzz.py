"""Damaged files: crashes, hangs, memory and errors that are not etid's own.

Child processes read thousands of them each; one that takes longer than `--limit`, dies, or
allocates more than a gigabyte is counted and named by kind and seed, and `--kind KIND --first SEED
--files 1` repeats it. What may come out is an answer or one `etid.RecordingError`.
"""

import argparse
import collections
import faulthandler
import json
import math
import multiprocessing
import os
import pathlib
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import jax
import numpy as np

import etid
from benchmarks import specimens
from benchmarks.damage import one_of
from benchmarks.runner import option, show

MEMORY = 1 << 30  # bytes that a process may have in memory
SAFETY = 4 << 30  # bytes of addresses beside those after the imports, for the sake of this machine
PATIENCE = 60  # a file may take so many times the limit if others use the processor meanwhile
START = 120.0  # seconds until a child has made its good files, or damaged one
SHARES = {"recordings": 8, "fits": 5, "mapping": 2, "csv": 1, "npz": 1, "matlab": 2,
          "matlab5": 1, "tdms": 1, "abf": 1}  # fmt: skip
FINE = ("read", "refused")
CONTEXT = multiprocessing.get_context("spawn")


OPTIONS = (
    option("--files", default=2000),
    option("--first", default=0, help="first seed"),
    option("--kind", choices=SHARES, help="default: all, by turns"),
    option("--limit", default=5.0, help="seconds of the processor for one file"),
    option("--output", type=pathlib.Path, help="JSON file"),
)


def main(arguments: argparse.Namespace) -> bool:
    started = time.perf_counter()
    seeds = range(arguments.first, arguments.first + arguments.files)
    cases = [(arguments.kind or kind_of(seed), seed) for seed in seeds]
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    faults: list[dict[str, Any]] = []
    slowest = largest = 0.0
    for found in run(cases, arguments.limit):
        counts[found["kind"]][found["outcome"]] += 1
        slowest = max(slowest, found["seconds"])
        largest = max(largest, found["memory"])
        if found["outcome"] not in FINE:
            faults.append(found)
            print(f"{found['kind']} {found['seed']}: {found['outcome']}\n{found['detail']}\n")
    for kind, own in counts.items():
        show({"kind": kind, "files": own.total(), **own})
    print(
        f"{len(faults)} faults in {len(cases)} files; slowest {slowest:.2f} s, "
        f"peak memory {largest / 2**20:.0f} MB, {time.perf_counter() - started:.0f} s in all"
    )
    if arguments.output is not None:
        content = {"cases": len(cases), "counts": counts, "faults": faults, "slowest": slowest,
                   "memory": largest}  # fmt: skip
        arguments.output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return not faults


def kind_of(seed: int) -> str:
    """Which kind of file a seed is for, if none is asked for."""
    turns = [kind for kind, share in SHARES.items() for _ in range(share)]
    return turns[seed % len(turns)]


def run(cases: list[tuple[str, int]], limit: float) -> Iterator[dict[str, Any]]:
    """The outcomes of all cases, from as many child processes as it takes."""
    left = collections.deque(cases)
    while left:
        with _Child() as child:
            while left and child.alive:
                kind, seed = left.popleft()
                yield child.outcome(kind, seed, limit)


class _Child:
    """A process that reads one damaged file after the other."""

    def __enter__(self) -> "_Child":
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="etid-fuzz-"))
        self.log, (self.pipe, theirs) = self.folder.with_suffix(".log"), CONTEXT.Pipe()
        self.process = CONTEXT.Process(target=child, args=(theirs, self.folder, self.log))
        self.process.start()
        theirs.close()
        self.alive = True
        if self._answer(START) is None:
            raise RuntimeError(f"no child process could be started:\n{self._last_words()}")
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()
        self.log.unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def outcome(self, kind: str, seed: int, limit: float) -> dict[str, Any]:
        """What comes of one file."""
        found = {"kind": kind, "seed": seed, "seconds": limit, "memory": 0.0, "detail": ""}
        self.pipe.send((kind, seed))
        # What a file that has once been damaged takes to be damaged is not the reader's time.
        began = self._answer(PATIENCE * START, START) is not None
        answer = self._answer(PATIENCE * limit, limit) if began else None
        if answer is not None:
            return found | answer
        hangs, pid, self.alive = self.alive, self.process.pid, False
        if hangs and pid is not None:
            os.kill(pid, signal.SIGUSR1)  # faulthandler says where it is
            time.sleep(0.3)
            self.process.kill()
        self.process.join()
        outcome = "hang" if hangs else f"crash, status {self.process.exitcode}"
        return found | {"outcome": outcome, "detail": self._last_words()}

    def _answer(self, limit: float, work: float = math.inf) -> dict[str, Any] | None:
        """The next one; None if there is none in this time, or in this time of the processor."""
        end, begun = time.monotonic() + limit, self._worked()
        try:
            while not self.pipe.poll(0.2):
                if time.monotonic() > end or self._worked() - begun > work:
                    return None
            return self.pipe.recv()
        except (EOFError, ConnectionError):  # it has died
            self.alive = False
            return None

    def _worked(self) -> float:
        """Seconds of the processor that the child has had."""
        stat = pathlib.Path(f"/proc/{self.process.pid}/stat").read_text("ascii")
        return sum(map(int, stat.rpartition(")")[2].split()[11:13])) / os.sysconf("SC_CLK_TCK")

    def _last_words(self) -> str:
        return self.log.read_text(errors="replace")[-4000:] if self.log.exists() else ""


def damage(path: pathlib.Path, kind: specimens.Kind, seed: int) -> pathlib.Path:
    """Write a damaged file of this kind and seed into a folder."""
    rng = np.random.default_rng(seed)
    name = path / f"{seed}{kind.suffix}"
    name.write_bytes(one_of(rng, kind.good))
    kind.damage(name, rng)
    return name


def judge(path: pathlib.Path, kind: specimens.Kind, seed: int) -> tuple[str, str]:
    """What comes of reading a file: `read`, `refused`, or what is wrong about it, and the text."""
    try:
        kind.use(path, seed)
    except etid.RecordingError as error:
        hidden = [one for one in _chain(error) if isinstance(one, MemoryError | Warning)]
        if hidden:
            return type(hidden[0]).__name__, "".join(traceback.format_exception(error))
        # One line that says which file.
        place = path.name in str(error) or path.stem in str(error)
        return ("refused", str(error)) if place else ("unnamed", str(error))
    except BaseException as error:
        return type(error).__name__, "".join(traceback.format_exception(error)[-12:])
    return "read", ""


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and those of which it came."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _status(name: str) -> int:
    """A number of /proc/self/status [byte]."""
    text = pathlib.Path("/proc/self/status").read_text("ascii")
    return 1024 * int(text.split(f"{name}:")[1].split()[0])


def child(pipe: Connection, folder: pathlib.Path, log: pathlib.Path) -> None:
    """Take cases from a pipe, and give what comes of them."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    jax.config.update("jax_enable_x64", True)
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    faulthandler.enable()
    warnings.simplefilter("error")
    known = specimens.kinds()
    limit = _status("VmSize") + SAFETY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    pipe.send({})
    warm: set[str] = set()
    while True:
        name, seed = pipe.recv()
        kind = known[name]
        if name not in warm and seed % specimens.PAGES == 0:  # what it compiles is kept
            good = folder / f"good{kind.suffix}"
            good.write_bytes(kind.good[0])
            judge(good, kind, seed)
            warm.add(name)
        path = damage(folder, kind, seed)
        pipe.send({})
        pathlib.Path("/proc/self/clear_refs").write_text("5", "ascii")  # the peak from here on
        started = time.process_time()
        outcome, detail = judge(path, kind, seed)
        seconds = time.process_time() - started
        for left in folder.iterdir():
            left.unlink()
        memory = _status("VmHWM")
        if memory > MEMORY and outcome in FINE:
            outcome, detail = "memory", f"{memory >> 20} MB. {detail}"
        said = {"outcome": outcome, "detail": detail, "seconds": seconds, "memory": memory}
        pipe.send(said)
