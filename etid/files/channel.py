"""Named channels of a file of another format; their samples are read later."""

import collections
import contextlib
import dataclasses
import functools
import itertools
import pathlib
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from etid.printing import first_of, several
from etid.recordings import errors, limits
from etid.recordings.errors import RecordingError
from etid.recordings.replacing import unwritable

BLOCK = 1 << 20  # [samples] size of a block in memory, 8 MB of real numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Channel:
    """One record of a file, or a stack of trials.

    value [unit] = conversion · stored + offset

    Attributes:
        name: Name of the channel in the file.
        shape: `(time,)` or `(trial, time)`; a channel of another shape cannot become a recording.
        dtype: Type of the stored samples.
        read: Function of trial, start and stop; it returns the stored samples.
        unit: Unit in the spelling of the file; empty if the file does not name it.
        sample_rate: Samples per second [Hz]; None if the file does not contain it.
        conversion: Units per stored unit.
        offset: Value of a stored zero, in the unit.
        declared: Number of samples that the file declares; programs may have appended more.
        notice: What a user must know of the samples although they are read; usually empty.

    Raises:
        RecordingError: The channel is empty, too large, or not of real numbers. Or the file
            contradicts itself: in the unit, or in the number of samples.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[int, int, int], np.ndarray]
    unit: str = ""
    sample_rate: float | None = None
    conversion: float = 1.0
    offset: float = 0.0
    declared: int = 0
    notice: str = ""

    def __post_init__(self) -> None:
        if self.dtype.kind not in "iuf" or self.dtype.itemsize > 8:
            raise RecordingError(
                f"{self.name!r} is a {self.dtype} array, must be an array of real numbers of at "
                "most 64 bits"
            )
        if 0 in self.shape:
            raise RecordingError(f"{self.name!r} is empty")
        if self.length > limits.SAMPLES or max(self.shape[:-1], default=0) > limits.TRIALS:
            raise RecordingError(
                f"channel {self.name!r} has {self.size}; etid reads at most {limits.TRIALS} trials "
                f"of {limits.SAMPLES} samples",
                remedy="Split the channel",
            )
        unit = one_unit(self.name, self.unit, with_unit(self.name)[1])
        object.__setattr__(self, "unit", unit)
        if self.length < self.declared:
            raise RecordingError(
                f"{self.name!r} has {several(self.length, 'sample')}, "
                f"the file declares {self.declared}",
                remedy="Copy or record it again; if this part is enough, correct the number in it",
            )

    @property
    def length(self) -> int:
        """Number of samples of a trial."""
        return self.shape[-1]

    @property
    def size(self) -> str:
        """Text for errors: how many samples and trials."""
        if len(self.shape) == 1:
            return f"{self.length} samples"
        if len(self.shape) == 2:
            return f"{several(self.shape[0], 'trial')} of {self.length} samples"
        return f"an array of {' x '.join(map(str, self.shape))} numbers"

    def blocks(self, trial: int = 0) -> Iterator[np.ndarray]:
        """The stored samples of a trial, in blocks of `BLOCK` samples."""
        for start in range(0, self.length, BLOCK):
            stop = min(start + BLOCK, self.length)
            block = self.read(trial, start, stop)
            if block.shape != (stop - start,):
                raise RecordingError(
                    f"{self.name!r} ends at sample {start + block.size} of {self.length}",
                    remedy="The file is damaged or was not closed: copy or record it again",
                )
            yield block

    def part(self, place: slice) -> "Channel":
        """Some samples of a channel of shape (time,)."""
        start = place.start

        def read(trial: int, first: int, last: int) -> np.ndarray:
            return self.read(trial, start + first, start + last)

        name = f"{self.name}[{start}:{place.stop}]"
        shape = (place.stop - start,)
        return dataclasses.replace(self, name=name, shape=shape, read=read, declared=0)


@dataclasses.dataclass(frozen=True, eq=False)
class Contents:
    """An open file of another format.

    Attributes:
        names: Names of the channels, in their order in the file.
        channel: Function that returns the channel of a name.
        prepare: Function to call once with the names of all channels that will be read.
    """

    names: tuple[str, ...]
    channel: Callable[[str], Channel]
    prepare: Callable[[Iterable[str]], None] = lambda names: None


def listed(names: Iterable[str]) -> str:
    """Text of at most 30 names for an error message."""
    return first_of([repr(name) for name in names], 30) or "none"


def by_place(names: Sequence[str]) -> list[str]:
    """Names of the columns of a table; those that occur several times tell their place, `CH1#3`."""
    count = collections.Counter(names)
    return [
        f"{name}#{place}" if name and count[name] > 1 else name
        for place, name in enumerate(names, 1)
    ]


def chosen(names: Iterable[str], name: str, field: str) -> None:
    """Raise an error if a name is missing or occurs twice."""
    every = list(names)
    if not every:
        raise RecordingError("the file is empty", remedy="Export or copy it again")
    alike = [one for one in every if one.rpartition("#")[0] == name]
    if name and name not in every and len(alike) > 1:
        raise RecordingError(
            f"{len(alike)} columns have the name {name!r}",
            field=field,
            remedy=f"Name one of them by its place: {' or '.join(map(repr, alike))}",
        )
    if name not in every:
        raise RecordingError(
            f"there is no {name!r}; the names are {listed(every)}",
            field=field,
            remedy="Use one of these names",
        )
    if every.count(name) > 1:
        raise RecordingError(
            f"two channels have the name {name!r}", field=field, remedy="Rename one"
        )


def array_channel(name: str, array: np.ndarray, **fields: Any) -> Channel:
    """The channel of an array in memory or mapped from a file, (time,) or (trial, time).

    Args:
        name: Name of the channel.
        array: The stored samples.
        **fields: Other fields of `Channel`.
    """

    def read(trial: int, start: int, stop: int) -> np.ndarray:
        return np.asarray(array if array.ndim == 1 else array[trial])[start:stop]

    return Channel(name, array.shape, array.dtype, read, **fields)


@contextlib.contextmanager
def spooled(
    names: Iterable[str],
    folder: pathlib.Path,
    write: Callable[[Mapping[str, BinaryIO]], str],
    about: Callable[[str], Mapping[str, Any]],
) -> Iterator[Contents]:
    """Contents of a file of text: `prepare` copies the needed columns to temporary files.

    Args:
        names: Names of the columns.
        folder: Folder of the temporary files.
        write: Function that writes the numbers of columns to the files of these names, as float64,
            and returns the notice on all channels.
        about: Function that returns other fields of the channel of a name.
    """
    files: dict[str, BinaryIO] = {}
    notice = ""
    with _written_in(folder), contextlib.ExitStack() as stack:

        def prepare(wanted: Iterable[str]) -> None:
            nonlocal notice
            with _written_in(folder):
                for name in wanted:
                    files[name] = stack.enter_context(tempfile.TemporaryFile(dir=folder))
                notice = write(files)

        def channel(name: str) -> Channel:
            numbers = np.memmap(files[name], np.float64, "r")
            return array_channel(name, numbers, notice=notice, **about(name))

        yield Contents(tuple(names), channel, prepare)


@contextlib.contextmanager
def _written_in(folder: pathlib.Path) -> Iterator[None]:
    """Name the folder, not the file that is read, if temporary files cannot be written."""
    try:
        yield
    except OSError as error:
        raise unwritable(folder, error) from error


def rate_of(interval: float, precision: float, unit: str = "s") -> float | None:
    """Sample rate [Hz] from an interval; a whole number if the precision allows it.

    Args:
        interval: Time between two samples, in the unit; None is returned if it is not positive.
        precision: Relative precision of the interval.
        unit: Unit of the interval in the spelling of the file.
    """
    time = parse_unit(unit)
    if time is None or time.si != "second":
        raise RecordingError(
            f"has a sample every {interval:g} {unit!r}, which is not a time",
            field="sample_rate",
            remedy="Import a record over time",
        )
    if not interval > 0:
        return None
    rate = 1 / (interval * time.factor)
    return float(round(rate)) if abs(rate - round(rate)) <= precision * rate else rate


# For a block that reads a file of another format: its errors become a RecordingError of this place.
located = functools.partial(errors.located, foreign=Exception)


# --- Units in the spellings of instrument files ---------------------------------------------------


class Unit(NamedTuple):
    """A unit of the values in a file.

    Attributes:
        factor: Size of the unit in its SI unit.
        si: SI unit: `volt`, `ampere` or `second`.
    """

    factor: float
    si: str


# "M" is missing, because "MV" can be a millivolt in capital letters or a megavolt.
_SHORT = {
    "": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "\N{MICRO SIGN}": 1e-6,
    "\N{GREEK SMALL LETTER MU}": 1e-6, "n": 1e-9, "p": 1e-12,
}  # fmt: skip
_LONG = {"": 1.0, "kilo": 1e3, "milli": 1e-3, "micro": 1e-6, "nano": 1e-9, "pico": 1e-12}
_SPELLINGS = {
    "volt": ("V", "volt", "volts"),
    "ampere": ("A", "ampere", "amperes", "amp", "amps"),
    "second": ("s", "second", "seconds", "sec"),
}
# All units by their spelling: symbols with short prefixes, words with long ones.
UNITS = {
    prefix + name: Unit(factor, unit)
    for unit, (symbol, *words) in _SPELLINGS.items()
    for names, prefixes in (([symbol], _SHORT), (words, _LONG))
    for name in names
    for prefix, factor in prefixes.items()
}
# Texts that mean a unit, known or not, in small letters. A letter alone may be a label.
_MEANT = {
    (prefix + name).lower()
    for name in itertools.chain.from_iterable(_SPELLINGS.values())
    for prefix in (*_SHORT, *_LONG, "g", "mega", "giga")
} - {"a", "s", "v"}


def parse_unit(text: str) -> Unit | None:
    """Unit of a text such as `mV` or `millivolts`; None if the text is not a known unit.

    Symbols are case-sensitive; words are not.
    """
    name = text.strip()
    return UNITS.get(name) or UNITS.get(name.lower() if len(name) > 2 else name)


def with_unit(name: str) -> tuple[str, str]:
    """Name and unit of a channel, from `name [unit]`, `name (unit)` or `name / unit`.

    The unit may be empty. It is the text in the brackets, known or not, if it means a unit; another
    text belongs to the name.
    """
    match = re.fullmatch(r"(.*\S)\s*(?:[\[(]([^\[\]()]+)[\])]|\s/\s+(\S+))", name)
    if match is None:
        return name, ""
    unit = (match[2] or match[3]).strip()
    return (match[1], unit) if parse_unit(unit) or unit.lower() in _MEANT else (name, "")


def one_unit(name: str, *said: str) -> str:
    """The unit of a channel that a file names in several places; empty if it names none."""
    found = {parse_unit(unit) or unit.strip(): unit.strip() for unit in said if unit.strip()}
    if len(found) > 1:
        raise RecordingError(
            f"the file says {' and '.join(map(repr, found.values()))} of channel {name!r}",
            remedy="Correct the one that is wrong in the file",
        )
    return next(iter(found.values()), "")
