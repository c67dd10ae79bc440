"""HDF5 files of others: types and sizes are looked at before anything is read.

The HDF5 library ends most damaged files with an error. It does not end one: the objects of a
global heap, where it keeps texts of variable length, follow each other by their sizes, and where a
free object has size 0 it goes round for ever, inside C, where Python cannot stop it. A `Guarded`
file therefore shows the library no heap before it has followed its objects itself. All hangs that
`python -m benchmarks fuzz` has found were of this kind. It costs a call of Python for each read, so
that samples, and all metadata of files that etid has written, are read without it.
"""

import contextlib
import functools
import io
import math
import os
import struct
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from etid.recordings import limits
from etid.recordings.errors import RecordingError, located

# What h5py raises, depending on where in a damaged file the HDF5 library gives up.
LIBRARY_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    OverflowError,
    MemoryError,
)

DAMAGED = "The file is damaged or was not closed: copy or record it again"

_PLAIN = 4096  # bytes of a number or text that is read without another look
_HEAP = b"GCOL\x01\0\0\0"
_HEAP_HEAD = 16  # bytes: signature, version, size of the collection
_OBJECT = struct.Struct("<HH4xQ")  # index, reference count, size
_SIZES = {0: 13, 1: 13, 2: 9, 3: 9}  # where a superblock of this version has its sizes of numbers


# The block that reads from an HDF5 file, `with translated(file, path, field)`.
translated = functools.partial(
    located, foreign=LIBRARY_ERRORS, message="the HDF5 library cannot read it", remedy=DAMAGED
)


class Guarded(io.FileIO):
    """A file for the HDF5 library that refuses a damaged global heap: a circle, or a false size."""

    def readinto(self, buffer: Any) -> int:
        """Read as much as the buffer holds, after a look at the heaps that begin in it."""
        start = self.tell()
        before = min(start, len(_HEAP) - 1)  # a heap may have begun in what was read before
        self.seek(start - before)
        seen = self.read(before + len(buffer) + len(_HEAP) - 1)
        place = seen.find(_HEAP)
        while place >= 0:
            self._follow(start - before + place)
            place = seen.find(_HEAP, place + 1)
        part = seen[before : before + len(buffer)]
        buffer[: len(part)] = part
        self.seek(start + len(part))
        return len(part)

    def _follow(self, heap: int) -> None:
        """Raise OSError if a heap exceeds the file, or one object does not lead to the next."""
        self.seek(heap + len(_HEAP))
        end = heap + int.from_bytes(self.read(8), "little")
        damaged = OSError(f"the heap of texts at byte {heap} is damaged")
        if end > os.fstat(self.fileno()).st_size:  # the library would allocate its declared size
            raise damaged
        place = heap + _HEAP_HEAD
        while place <= end - _OBJECT.size:
            self.seek(place)
            index, _, length = _OBJECT.unpack(self.read(_OBJECT.size))
            step = length if index == 0 else _OBJECT.size + (length + 7) // 8 * 8
            if step == 0:
                raise damaged
            place += step


@contextlib.contextmanager
def guarded(path: str, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file behind a guard.

    Args:
        path: The file.
        **options: Of `h5py.File`.

    Raises:
        RecordingError: It is missing, no HDF5, or damaged.
    """
    check_file(path)
    with translated(path), contextlib.ExitStack() as stack:
        raw = stack.enter_context(Guarded(path, "rb"))
        _check_numbers(raw)
        file = stack.enter_context(h5py.File(raw, "r", **options))
        yield file


def check_file(path: str) -> None:
    """Refuse what is no HDF5 file; a pipe or a device is not opened.

    Raises:
        RecordingError: It is missing, or no HDF5.
    """
    if not os.path.isfile(path):
        raise RecordingError("there is no such file", file=path, remedy="Check the path")
    if not h5py.is_hdf5(path):
        raise RecordingError(
            "is not an HDF5 file, or its head is damaged",
            file=path,
            remedy="If it is of another format, turn it into one of etid with `etid import`",
        )


def _check_numbers(raw: io.FileIO) -> None:
    """Refuse addresses and lengths of other than 8 bytes: the guard reads no others."""
    for place in (0, 512, 1024, 2048):
        raw.seek(place)
        head = raw.read(16)
        if head.startswith(b"\x89HDF\r\n\x1a\n"):
            at = _SIZES.get(head[8])
            if at is None or head[at : at + 2] != b"\x08\x08":
                raise OSError("its addresses are not of 8 bytes")
            break
    raw.seek(0)


class Attributes:
    """Attributes of the objects of one file, read after a look at their type and size.

    Texts of variable length are read behind a guard, from a second handle that is opened when the
    first of them is found.
    """

    def __init__(self, path: str):
        self._path = path
        self._second: h5py.File | None = None
        self._open = contextlib.ExitStack()

    def __enter__(self) -> "Attributes":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._second = None

    def names(self, owner: h5py.HLObject) -> list[str]:
        """Names of the attributes of a group or dataset.

        Raises:
            RecordingError: There are more than any schema has.
        """
        names = list(owner.attrs)
        if len(names) > limits.ATTRIBUTES:
            raise RecordingError(
                f"has {len(names)} attributes, at most {limits.ATTRIBUTES} are read",
                remedy="Keep what is not in the schema elsewhere",
            )
        return names

    def value(self, owner: h5py.HLObject, name: str) -> Any:
        """The value of an attribute.

        Raises:
            Exception: One of `LIBRARY_ERRORS`: it cannot be read, or is too large.
        """
        attributes = owner.attrs
        stored = attributes.get_id(name)
        dtype = stored.dtype
        if not dtype.hasobject and math.prod(stored.shape or ()) * dtype.itemsize <= _PLAIN:
            return attributes[name]  # as etid writes all of them
        if in_a_heap(dtype):
            if self._second is None:
                self._second = self._open.enter_context(guarded(self._path))
            owner = self._second[owner.name]
        return attribute(owner, name)


def in_a_heap(dtype: np.dtype) -> bool:
    """Whether values of a type lie in a global heap: texts of variable length, regions."""
    return dtype.hasobject and h5py.check_ref_dtype(dtype) is not h5py.Reference


def attribute(owner: h5py.HLObject, name: str) -> Any:
    """The value of an attribute, whose type and size are looked at first.

    A sequence of variable length is in no schema; made from a damaged text, it crashes the library.

    Raises:
        Exception: One of `LIBRARY_ERRORS`: it cannot be read, or is too large.
    """
    stored = owner.attrs.get_id(name)
    if h5py.check_vlen_dtype(stored.dtype) not in (None, str, bytes):
        raise TypeError("it is a sequence of variable length")
    size = math.prod(stored.shape or ()) * stored.dtype.itemsize
    if size > limits.ATTRIBUTE:
        raise ValueError(f"it has {size} bytes, at most {limits.ATTRIBUTE} are read")
    return owner.attrs[name]


def check_size(dataset: h5py.Dataset) -> None:
    """Refuse a dataset that declares more than it can hold, before anything is allocated.

    Raises:
        RecordingError: It is beyond one of `etid.recordings.limits`, or beyond its file.
    """
    if dataset.external or dataset.is_virtual:
        raise RecordingError(
            "its samples lie in another file", remedy="Copy the samples into the file"
        )
    itemsize = dataset.dtype.itemsize
    declared = math.prod(dataset.shape or ()) * itemsize
    chunk = math.prod(dataset.chunks or ()) * itemsize
    if chunk > limits.CHUNK:
        raise RecordingError(
            f"has chunks of {chunk} bytes, at most {limits.CHUNK} are read",
            remedy="Write it with smaller chunks",
        )
    trials = dataset.shape[0] if dataset.ndim == 2 else 1
    if declared <= limits.FREE and trials <= limits.FREE_TRIALS:
        return
    stored = dataset.id.get_storage_size()
    held = min(stored, dataset.file.id.get_filesize())
    if declared > limits.COMPRESSION * held or stored > held:
        raise RecordingError(
            f"declares {declared} bytes, {held} of them stored",
            remedy=DAMAGED,
        )


def local_link(group: h5py.Group, name: str) -> h5py.HardLink | h5py.SoftLink:
    """The link of a member, which does not leave the file.

    Raises:
        RecordingError: It is a link to another file, or passes through one.
    """
    remedy = "Copy the data into the file"
    link: Any = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise RecordingError(f"is a link to another file, {link.filename!r}", remedy=remedy)
    if isinstance(link, h5py.SoftLink):
        _check_soft(group, link.path)
    return link


def _check_soft(group: h5py.Group, path: str) -> None:
    """Refuse a soft link that leads out of the file or in a circle; a dangling one passes."""
    place: Any = group.file if path.startswith("/") else group
    left = path.split("/")[::-1]
    links = 0
    while left:
        part = left.pop()
        link = place.get(part, getlink=True) if part and isinstance(place, h5py.Group) else None
        if isinstance(link, h5py.ExternalLink):
            raise RecordingError(
                f"is a soft link to another file, {link.filename!r}",
                remedy="Copy the data into the file",
            )
        if isinstance(link, h5py.SoftLink):
            links += 1
            if links > limits.LINKS:
                raise RecordingError("is a soft link in a circle", remedy="Remove the link")
            place = place.file if link.path.startswith("/") else place
            left += link.path.split("/")[::-1]
        elif link is not None:
            place = place[part]
        elif part:
            return
