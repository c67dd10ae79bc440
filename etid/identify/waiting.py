"""One line of text while JAX compiles, where a person waits: on a terminal or in a notebook."""

import sys
import threading

import jax
from tqdm import tqdm

PATIENCE = 1.0  # [s] waiting time without a word
COMPILING = "etid: JAX compiles the fit, once in each process."
KEEP = (
    " To keep compiled programs for later processes, set JAX_COMPILATION_CACHE_DIR to a folder and "
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS to 0."
)

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
        kept = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
        tqdm.write(COMPILING + ("" if kept else KEEP), file=sys.stderr)  # not into a progress bar
