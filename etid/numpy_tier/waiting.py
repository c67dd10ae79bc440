"""One line of text while JAX compiles, where a person waits: on a terminal or in a notebook."""

import sys
import threading

from tqdm import tqdm

PATIENCE = 1.0  # [s] waiting time without a word
COMPILING = "etid: JAX compiles the fit, once in each process."

_told = threading.Event()


def announced_later() -> threading.Timer:
    """A started timer that prints a line after `PATIENCE`, once in each process."""
    timer = threading.Timer(PATIENCE, _tell)
    timer.daemon = True
    timer.start()
    return timer


def _tell() -> None:
    person = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
    if person and not _told.is_set():
        _told.set()
        tqdm.write(COMPILING, file=sys.stderr)  # not into a progress bar
