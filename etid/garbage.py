"""No search for garbage while many objects are made that live on: imports and traces."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def unsearched() -> Iterator[None]:
    """Search no garbage within, nor at once after it.

    A trace makes a million objects that live on. To search them for garbage again and again takes a
    sixth of its time.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # else it would be undone
            gc.freeze()
            gc.unfreeze()  # both: all objects count as old ones
        gc.enable()
