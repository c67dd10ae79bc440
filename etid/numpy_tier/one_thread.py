"""One thread of BLAS while a small program runs.

OpenBLAS shares a product of a few thousand multiplications among threads. Those then wait for the
next product in a busy loop, which takes three quarters of the CPU time of a driver.
"""

import contextlib
import functools
import threading
from collections.abc import Iterator

from threadpoolctl import ThreadpoolController

_lock = threading.Lock()
_limits: list[contextlib.AbstractContextManager[object]] = []
_inside = 0  # programs that run at this time, in all threads


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS has one thread within, and after the last of several programs as many as before."""
    global _inside
    with _lock:
        if _inside == 0:
            _limits.append(_blas().limit(limits=1))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _limits.pop().__exit__(None, None, None)


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")
