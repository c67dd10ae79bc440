"""Tests of a broken copy of the project, in a process that has loaded JAX and SciPy before.

To load these takes longer than most mutants live. `multiprocessing` keeps a process that has loaded
them, and forks it for each mutant; etid itself is loaded anew.
"""

import contextlib
import multiprocessing
import os
import pathlib
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

PRELOADED = (
    *("jax.export", "equinox", "optimistix", "lineax", "scipy.optimize", "scipy.signal"),
    *("scipy.stats", "h5py", "jinja2", "matplotlib.pyplot", "hypothesis", "beartype"),
    *("jaxtyping", "pytest"),
)


class Outcome(NamedTuple):
    """What the tests said."""

    passed: bool | None  # whether all passed; None if they took too long
    killer: str  # the test that failed; empty if none did, or if they could not be collected


class _Order:
    """Plugin of pytest: some tests of a file come before its others, and the first that fails."""

    def __init__(self, first: Sequence[str]) -> None:
        self.place = {name: i for i, name in enumerate(first)}
        self.failed = ""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Sort the tests; those of a file stay together, as they share what they made."""
        files = list(dict.fromkeys(item.path for item in items))
        last = len(self.place)

        def place(item: Any) -> int:
            return self.place.get(item.nodeid, last)

        earliest = {path: min(place(item) for item in items if item.path == path) for path in files}
        items.sort(key=lambda item: (earliest[item.path], files.index(item.path), place(item)))

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Keep the name of a test that failed."""
        if report.failed:
            self.failed = report.nodeid


def _run(
    folder: str, names: Sequence[str], first: Sequence[str], module: str, answer: Connection
) -> None:
    """Run the tests; this process has not loaded etid."""
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
    import pytest

    order = _Order(first)
    files = [f"tests/test_{name}.py" for name in names]
    options = [
        *("-q", "-x"),
        # Modules of plugins are loaded already, and their assertions are not rewritten.
        *("-W", "ignore::pytest.PytestAssertRewriteWarning"),
        # To check the types of all modules takes longer than to load them.
        f"--jaxtyping-packages={module},beartype.beartype",
    ]
    status = pytest.main([*options, *files], plugins=[order])
    answer.send((status == 0, order.failed))


class Runner:
    """Runs the tests of a copy of the project, each time in a new process.

    Args:
        folder: The copy. Bytecode, caches and the log of the last tests are kept beside it.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(list(PRELOADED))

    def __call__(
        self, names: Sequence[str], module: str, limit: float, first: Sequence[str] = ()
    ) -> Outcome:
        """What the tests say.

        Args:
            names: Files of tests, by the part of their names after `test_`.
            module: Module of etid whose types are checked.
            limit: Time that they may take [s].
            first: Tests that come first.
        """
        ours, theirs = self.context.Pipe(duplex=False)
        arguments = (str(self.folder), tuple(names), tuple(first), module, theirs)
        process = self.context.Process(target=_run, args=arguments)
        process.start()
        theirs.close()
        process.join(limit)
        if process.exitcode is None:
            process.kill()
            process.join()
            return Outcome(None, "")
        with contextlib.suppress(EOFError):  # a process that died has not answered
            return Outcome(*ours.recv())
        return Outcome(False, "")
