"""What a file of another format holds: named channels, none of them read yet."""

import csv
import dataclasses
import functools
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from etid.recordings import errors
from etid.recordings.recording import RecordingError
from etid.recordings.untrusted import LIBRARY_ERRORS

BLOCK = 1 << 20  # samples that are in memory at once, 8 MB of real numbers
LISTED = 30  # names in an error

# What readers raise, depending on where in a damaged file they give up.
_READ_ERRORS = (
    *LIBRARY_ERRORS,
    ArithmeticError,
    AssertionError,
    EOFError,
    SyntaxError,
    LookupError,
    csv.Error,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """One record of a file, or a stack of trials.

    value [unit] = conversion · stored + offset

    Attributes:
        name: Its name in the file.
        shape: `(time,)` or `(trial, time)`; whatever else it has, no recording can be made of it.
        dtype: Of the stored samples.
        read: The stored samples of a trial, from one index up to another.
        unit: As the file spells it; empty where it names none.
        sample_rate: Samples per second [Hz]; None where the file does not say.
        conversion: Units per stored unit.
        offset: Value of a stored zero, in the unit.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[int, int, int], np.ndarray]
    unit: str = ""
    sample_rate: float | None = None
    conversion: float = 1.0
    offset: float = 0.0

    @property
    def length(self) -> int:
        """Samples of a trial."""
        return self.shape[-1]

    def blocks(self, trial: int = 0) -> Iterator[np.ndarray]:
        """The stored samples of a trial, `BLOCK` at a time.

        Raises:
            RecordingError: The file ends before them.
        """
        for start in range(0, self.length, BLOCK):
            stop = min(start + BLOCK, self.length)
            block = self.read(trial, start, stop)
            if block.shape != (stop - start,):
                raise RecordingError(
                    f"{self.name!r} ends at sample {start + block.size} of {self.length}",
                    remedy="The file is damaged or was not closed: copy or record it again",
                )
            yield block


def _nothing(names: Iterable[str]) -> None:
    del names


@dataclasses.dataclass(frozen=True, eq=False)
class Contents:
    """A file of another format, open.

    Attributes:
        names: Its channels, in order.
        channel: The channel of a name.
        prepare: To be told once, before, which channels will be asked for.
    """

    names: tuple[str, ...]
    channel: Callable[[str], Channel]
    prepare: Callable[[Iterable[str]], None] = _nothing


def listed(names: Iterable[str]) -> str:
    """Names for an error."""
    every = list(names)
    more = f" and {len(every) - LISTED} more" if len(every) > LISTED else ""
    return (", ".join(map(repr, every[:LISTED])) or "none") + more


def chosen(names: Iterable[str], name: str, field: str) -> None:
    """Refuse a name that is not there, or there twice."""
    every = list(names)
    if name not in every:
        raise RecordingError(
            f"there is no {name!r}; the names are {listed(every)}",
            field=field,
            remedy="Name one of them",
        )
    if every.count(name) > 1:
        raise RecordingError(
            f"two channels have the name {name!r}", field=field, remedy="Rename one"
        )


def real(name: str, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    """Refuse what is no array of real numbers."""
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise RecordingError(
            f"{name!r} is a {dtype} array, must be an array of real numbers of at most 64 bits"
        )
    if 0 in shape:
        raise RecordingError(f"{name!r} is empty, of shape {shape}")


def rate_of(interval: float, precision: float) -> float:
    """Samples per second, a whole number where an interval [s] of this precision may mean one."""
    rate = 1 / interval
    return float(round(rate)) if abs(rate - round(rate)) <= precision * rate else rate


# The block that reads from a file of another format, `with located(file, path, field)`.
located = functools.partial(errors.located, foreign=_READ_ERRORS)


def needs(package: str, extra: str, file: str) -> RecordingError:
    """The error of a file whose reader is not installed."""
    return RecordingError(
        f"needs the package {package}", file=file, remedy=f"Run pip install 'etid[{extra}]'"
    )
