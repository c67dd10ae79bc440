"""One line of text while JAX compiles, where a person waits: on a terminal or in a notebook."""

import contextlib
import sys
import threading
from collections.abc import Iterator

from tqdm import tqdm

PATIENCE = 1.0  # [s] waiting time without a word
COMPILING = "etid: JAX compiles the fit, once in each process."

_told = threading.Event()


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Where something is compiled: prints a line after `PATIENCE`, once in each process."""
    timer = threading.Timer(PATIENCE, _tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _tell() -> None:
    person = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
    if person and not _told.is_set():
        _told.set()
        tqdm.write(COMPILING, file=sys.stderr)  # not into a progress bar
