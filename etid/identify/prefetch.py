"""Reading in advance: a thread loads the next items during a computation."""

import collections
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def prefetch(
    load: Callable[[int], T], count: int, ahead: int
) -> Generator[Callable[[], T], None, None]:
    """Call `load(0)`, `load(1)`, … in another thread, in this order and one at a time.

    Close the iterator to stop early: the running call finishes, the others do not start.

    Args:
        load: A function that spends its time outside Python, in file access or numpy.
        count: Number of calls.
        ahead: Largest number of calls in advance of the caller.

    Yields:
        For each call a function that waits for the result and returns it, or raises its error.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="prefetch") as thread:
        waiting = collections.deque(thread.submit(load, row) for row in range(min(ahead, count)))
        try:
            for row in range(count):
                loaded = waiting.popleft()
                if row + ahead < count:
                    waiting.append(thread.submit(load, row + ahead))
                yield loaded.result
        finally:
            for future in waiting:
                future.cancel()
