"""Would the tests tell? Bugs are put in, one at a time, and the tests that execute them run.

Mutants (`benchmarks.mutants`) of code, tables and texts are drawn by a seed from all modules of
etid, in a copy of the working tree. First every file of the ordinary tests runs once, and its
executed lines are noted. A mutant is then judged by all files that execute its line; one outside of
functions, by all files that execute any function of the module. What all of them let pass has
survived, and so has what no test executes. Some mutants are no bug at all; they are counted all the
same. They are done in the order in which they were drawn: what is done is a fair sample.

mutmut wraps every function, which compiled code and checks of types see, and cosmic-ray starts
Python and JAX anew for each mutant and runs the same tests for all.
"""

import argparse
import collections
import contextlib
import multiprocessing
import os
import pathlib
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from benchmarks.machine import ROOT
from benchmarks.mutants import Mutant, drawn, mutants
from benchmarks.rates import clopper_pearson
from benchmarks.runner import Target, at_most, each, option, report, show, tabled

TARGETS = {"mutants that survive": at_most(0.1)}
COPIED = (
    *("etid", "tests", "benchmarks", "data_schema", "docs", "notebooks", "examples"),
    *("conda", ".ci"),
    ".pytest_cache",  # what was compiled for tests without a mutant
)
NOTED = "coverage.ini"
# The command, the live view and workers run in child processes, which end by `os._exit` as well.
CHILDREN_TOO = """\
[run]
source = {source}
data_file = {beside}/lines
parallel = true
sigterm = true
patch =
    subprocess
    _exit
"""
LIMIT = 600.0  # [s] of a mutant; one that takes longer counts as a survivor
# To load these takes longer than most mutants live: a process that has loaded them is forked.
PRELOADED = (
    *("jax.export", "equinox", "optimistix", "lineax", "scipy.optimize", "scipy.signal"),
    *("scipy.stats", "h5py", "jinja2", "matplotlib.pyplot", "hypothesis", "beartype"),
    *("jaxtyping", "pytest", "coverage"),
)


class Judged(NamedTuple):
    """What some tests said of the copy."""

    passed: bool | None  # whether all passed; None if they took too long
    killer: str  # the test that failed; empty if none did, or if they could not be collected
    lines: Mapping[str, Sequence[int]]  # executed lines by module, if they were noted


class _Failed:
    """Plugin of pytest: the name of the test that failed."""

    name = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Keep it."""
        if report.failed:
            self.name = report.nodeid


def _run(folder: str, tests: Sequence[str], module: str, answer: Connection) -> None:
    """Run tests in the copy; this process has not loaded etid."""
    for name in [name for name in sys.modules if name.partition(".")[0] in ("benchmarks", "etid")]:
        del sys.modules[name]
    beside = pathlib.Path(folder).parent
    os.chdir(folder)
    sys.path.insert(0, folder)
    sys.pycache_prefix, sys.dont_write_bytecode = str(beside / "bytecode"), False
    os.environ.update(PYTHONPATH=folder, XDG_CACHE_HOME=str(beside / "cache"))
    # Also what libraries write there without Python.
    with open(beside / "log", "w") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    import coverage
    import pytest

    failed, noted = _Failed(), coverage.Coverage(config_file=str(beside / NOTED))
    # Modules of plugins are loaded already, and their assertions are not rewritten.
    options = ["-q", "-x", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    if module:  # to check the types of all modules takes longer than to load them
        options.append(f"--jaxtyping-packages={module},beartype.beartype")
    with contextlib.nullcontext() if module else noted.collect():
        status = pytest.main([*options, *tests], plugins=[failed])
    if not module:
        noted.combine()  # with what child processes have left
    data = noted.get_data()
    lines = {os.path.relpath(path, folder): data.lines(path) for path in data.measured_files()}
    # A file whose tests are all slow, or need what is not there, has nothing against it.
    fine = pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED
    answer.send((status in fine, failed.name, lines))


class Tree:
    """A copy of a project, whose tests run each time in a new process.

    Beside it lie bytecode, caches and the log of the last tests.
    """

    def __init__(self, root: pathlib.Path, beside: pathlib.Path) -> None:
        self.folder = beside / "tree"
        self.folder.mkdir()
        for path in root.iterdir():
            if path.is_file() and not path.name.startswith("."):
                shutil.copy2(path, self.folder)
            elif path.name in COPIED:
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(path, self.folder / path.name, ignore=ignored)
        if (root.parent / "shared").exists():  # reference data
            (beside / "shared").symlink_to((root.parent / "shared").resolve())
        (beside / NOTED).write_text(CHILDREN_TOO.format(source=self.folder / "etid", beside=beside))
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(list(PRELOADED))
        self.times = 0

    def judged(self, tests: Sequence[str], module: str, limit: float) -> Judged:
        """What tests say; without a module whose types are checked, executed lines are noted."""
        ours, theirs = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_run, args=(str(self.folder), tests, module, theirs))
        process.start()
        theirs.close()
        late = not ours.poll(limit)
        try:
            return Judged(None, "", {}) if late else Judged(*ours.recv())
        except EOFError:  # a process that died has not answered
            return Judged(False, "", {})
        finally:
            process.kill()
            process.join()

    def executed(self, test: str) -> tuple[float, Mapping[str, Sequence[int]]]:
        """How long a file of tests takes [s], and the lines of etid that it executes."""
        begun = time.perf_counter()
        for left in self.folder.parent.glob("lines*"):
            left.unlink()  # of a child process that was killed late
        found = self.judged([test], "", 10 * LIMIT)
        if not found.passed:
            raise SystemExit(f"{test} fails without any mutant: {found.killer}")
        return time.perf_counter() - begun, found.lines

    def outcome(self, mutant: Mutant, tests: Sequence[str]) -> dict[str, Any]:
        """The row of a mutant."""
        path, begun = self.folder / mutant.path, time.perf_counter()
        source, module = path.read_text("utf-8"), mutant.path.removesuffix(".py").replace("/", ".")
        path.write_text(mutant.applied(source), "utf-8")
        self.times += 1
        # Python takes bytecode for that of a source of the same length and time.
        os.utime(path, (self.times, self.times))
        passed, killer, _ = self.judged(tests, module, LIMIT) if tests else Judged(True, "", {})
        path.write_text(source, "utf-8")
        return {
            "module": module.removeprefix("etid."),
            "place": f"{mutant.path}:{mutant.line}",
            "kind": mutant.kind,
            "before": " ".join(mutant.before.split()),
            "after": " ".join(mutant.after.split()),
            "outcome": {True: "survived", False: "killed", None: "too long"}[passed],
            "killer": killer,
            "seconds": round(time.perf_counter() - begun, 1),
        }


def judges(
    mutant: Mutant,
    executed: Mapping[str, tuple[float, Mapping[str, Sequence[int]]]],
    calls: set[int],
) -> list[str]:
    """Files of tests that execute a mutant, the fastest first; `calls` are lines that calls run.

    A module without functions has no calls: importing it executes its mutants.
    """
    lines = {mutant.line} if mutant.inside or not calls else calls
    of = {
        test: seconds
        for test, (seconds, by) in executed.items()
        if lines & {*by.get(mutant.path, ())}
    }
    return sorted(of, key=lambda test: of[test])


def survived(rows: Sequence[Mapping[str, Any]]) -> Target:
    """The part of the mutants that survived, which are printed."""
    left = [row for row in rows if row["outcome"] != "killed"]
    for row in left:
        print(f"  {row['place']}: {row['kind']}: {row['before'][:70]}  ->  {row['after'][:70]}")
    [name] = TARGETS
    share, interval = len(left) / len(rows), clopper_pearson(len(left), len(rows))
    low, high = interval
    text = f"{len(left)} of {len(rows)}, {share:.0%} (95 %: {low:.0%} to {high:.0%})"
    return Target.of(TARGETS, name, share, text=text, interval=interval)


OPTIONS = (
    option("--mutants", default=40, help="how many to draw"),
    option("--modules", nargs="+", type=str, default=[], metavar="MODULE", help="of etid; all"),
    option("--seed", default=0),
    option("--output", default=pathlib.Path("mutation.csv")),
)


def main(arguments: argparse.Namespace, root: pathlib.Path = ROOT) -> bool:
    below = [path.relative_to(root / "etid") for path in sorted((root / "etid").rglob("*.py"))]
    names = arguments.modules or [".".join(path.with_suffix("").parts) for path in below]
    every, calls = list[Mutant](), {}
    for name in names:
        path = f"etid/{name.replace('.', '/')}.py"
        of = mutants(path, (root / path).read_text("utf-8"))
        calls[path] = {one.line for one in of if one.inside}
        every += of
    chosen = drawn(every, arguments.mutants, arguments.seed)
    print(f"{len(chosen)} of {len(every)} mutants of {len(names)} modules")
    with tempfile.TemporaryDirectory() as place:
        tree = Tree(root, pathlib.Path(place))
        paths = sorted((root / "tests").rglob("test_*.py"))
        tests = [path.relative_to(root).as_posix() for path in paths]
        kept = root == ROOT  # what another tree has done is not known by this one's commit
        files = [(one,) for one in tests]
        noted = dict(each(tree.executed, files, unit="file", keep="tests" if kept else ""))
        executed = {tests[number]: found for number, found in noted.items()}
        killers = collections.defaultdict(list)

        def outcome(mutant: Mutant) -> dict[str, Any]:
            by = judges(mutant, executed, calls[mutant.path])
            row = tree.outcome(mutant, [*killers[mutant.path], *by])
            if row["killer"] and row["killer"] not in killers[mutant.path]:
                killers[mutant.path].append(row["killer"])
            show(row, "place", "kind", "outcome", "seconds")
            return row

        def table(done: dict[int, dict[str, Any]]) -> list[dict[str, Any]]:
            return [{"seed": arguments.seed, **row} for row in done.values()]

        tasks = [(mutant,) for mutant in chosen]
        keep = "mutation" if kept else ""
        rows = tabled(arguments.output, table, outcome, tasks, unit="mutant", keep=keep)
    return report([survived(rows)])
