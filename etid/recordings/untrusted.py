"""HDF5 files of any source: an error of the library is a `RecordingError`, and sizes are checked.

For most damaged files the HDF5 library raises an error, of any type. There is one exception. A
global heap holds texts of variable length, and the size of each object leads to the next object. If
a free object has size 0, the library loops forever in C, and Python cannot stop it: `python -m
benchmarks fuzz --no-guard` measures how often. A `Guarded` file therefore follows the objects of a
heap itself before the library reads the heap. All metadata are read through it. The samples of a
recording are read without it, from a second handle of the file.
"""

import contextlib
import functools
import importlib
import io
import math
import os
import struct
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from h5py import h5z  # type: ignore[attr-defined]  # compiled, without stubs

from etid.recordings import limits
from etid.recordings.errors import RecordingError, located, require_file

DAMAGED = "The file is damaged or was not closed: copy or record it again"

_HEAP = b"GCOL\x01\0\0\0"
_OBJECT = struct.Struct("<HH4xQ")  # index, reference count, size

# For a block that reads an HDF5 file: all its errors become a RecordingError of this place.
translated = functools.partial(
    located, foreign=Exception, message="the HDF5 library cannot read it", remedy=DAMAGED
)

# In such a block: the library refuses a file that is being written.
_unlocked = functools.partial(
    located,
    foreign=BlockingIOError,
    message="another program has opened it to write",
    remedy="Close it there",
)


class Guarded(io.FileIO):
    """A file for the HDF5 library that refuses a global heap whose objects are a loop."""

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, after a check of the heaps that begin in it."""
        start = self.tell()
        before = min(start, len(_HEAP) - 1)  # a signature may begin in the previous read
        self.seek(start - before)
        part = self.read(before + len(buffer))
        place = part.find(_HEAP)
        while place >= 0:
            self._follow(start - before + place)
            place = part.find(_HEAP, place + 1)
        part = part[before:]
        buffer[: len(part)] = part
        self.seek(start + len(part))
        return len(part)

    def _follow(self, heap: int) -> None:
        """Raise OSError if an object of a heap does not lead to the next."""
        self.seek(heap + len(_HEAP))
        end = heap + int.from_bytes(self.read(8), "little")
        end = min(end, os.fstat(self.fileno()).st_size)
        place = heap + len(_HEAP) + 8
        while place <= end - _OBJECT.size:
            self.seek(place)
            index, _, length = _OBJECT.unpack(self.read(_OBJECT.size))
            step = length if index == 0 else _OBJECT.size + (length + 7) // 8 * 8
            if step == 0:
                raise OSError(f"the heap of texts at byte {heap} is damaged")
            place += step


@contextlib.contextmanager
def guarded(path: str, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file that is read through `Guarded`."""
    require_file(path)
    if not h5py.is_hdf5(path):
        raise RecordingError(
            "is not an HDF5 file, or its header is damaged",
            file=path,
            remedy="If it has another format, convert it with `etid import`",
        )
    with translated(path), _unlocked(path), contextlib.ExitStack() as stack:
        raw = stack.enter_context(Guarded(path, "rb"))
        try:
            opened = h5py.File(raw, "r", **options)
        except Exception as error:
            # The frames of the library hold objects that lead to `raw`. If they live until the
            # process ends, the library ends it with a segmentation fault.
            raise error.with_traceback(None) from None
        file = stack.enter_context(opened)
        yield file


def attribute(owner: h5py.HLObject, name: str) -> Any:
    """Value of an attribute; bytes that are no UTF-8 could not be written again."""
    value: Any = owner.attrs[name]
    several = isinstance(value, np.ndarray) and value.dtype.hasobject
    return np.frompyfunc(_clean, 1, 1)(value) if several else _clean(value)


def _clean(item: Any) -> Any:
    if not isinstance(item, str):
        return item
    return item.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def check_size(dataset: h5py.Dataset) -> None:
    """Raise an error if a dataset declares much more data than it stores, before it is read."""
    if dataset.external or dataset.is_virtual:
        raise RecordingError(
            "its samples are in another file", remedy="Copy the samples into the file"
        )
    _check_filters(dataset)
    declared = math.prod(dataset.shape or ()) * dataset.dtype.itemsize
    stored = dataset.id.get_storage_size()
    if declared > max(limits.FREE, limits.COMPRESSION * stored):
        raise RecordingError(
            f"declares {declared} bytes, but only {stored} bytes are stored", remedy=DAMAGED
        )


def _check_filters(dataset: h5py.Dataset) -> None:
    """Raise an error if the library lacks a filter; hdf5plugin, where installed, brings more."""
    properties = dataset.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(number)
        if h5z.filter_avail(code):
            continue
        with contextlib.suppress(ImportError):
            importlib.import_module("hdf5plugin")  # it registers its filters
        if not h5z.filter_avail(code):
            called = name.decode("utf-8", "replace").rstrip("\0").partition(";")[0]
            raise RecordingError(
                f"is compressed by filter {code}{f' ({called})' if called else ''}, which the HDF5 "
                "library does not have",
                remedy="Run pip install hdf5plugin, which has the usual filters, or write the file "
                "with gzip",
            )


def local_link(group: h5py.Group, name: str) -> Any:
    """Link of a member of a group; an error if it leads to another file."""
    link: Any = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise RecordingError(
            f"is a link to another file, {link.filename!r}", remedy="Copy the data into the file"
        )
    return link
