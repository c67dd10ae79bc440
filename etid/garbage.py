"""No search for garbage while many objects are made that live on: imports and traces."""

import contextlib
import gc
from collections.abc import Iterator

MANY = 2_000  # new objects, whose search takes some 0.1 ms


@contextlib.contextmanager
def unsearched() -> Iterator[None]:
    """Search no garbage within, nor at once after it.

    A trace makes a million objects that live on. To search them for garbage again and again takes a
    sixth of its time. After few objects the next search is as short as any.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # What the process itself has frozen would be undone; to count it takes longer than a fit.
        if gc.get_count()[0] > MANY and not gc.get_freeze_count():
            gc.freeze()
            gc.unfreeze()  # both: all objects count as old ones
        gc.enable()
