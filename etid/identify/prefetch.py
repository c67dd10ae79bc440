"""Read on while something else computes: one thread is a few steps ahead."""

import collections
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def prefetch(
    load: Callable[[int], T], count: int, ahead: int
) -> Generator[Callable[[], T], None, None]:
    """Call `load(0)`, `load(1)`, … in another thread, in this order and one at a time.

    Close the iterator to stop it early: what has begun is waited for, the rest is not begun.

    Args:
        load: What takes time without Python: reading a file, numpy.
        count: How many calls.
        ahead: How many calls may have begun of which the caller has not come to the result.

    Yields:
        For each call a function that waits for its result and returns it, or raises what it raised.
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
