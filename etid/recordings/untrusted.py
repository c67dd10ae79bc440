"""Reading of HDF5 files from other sources: types and sizes are checked before data are read.

For most damaged files the HDF5 library raises an error, of any type. There is one exception. A
global heap holds texts of variable length and the parts of virtual datasets, and the size of each
object leads to the next object. If a free object has size 0, the library loops forever in C, and
Python cannot stop it. A `Guarded` file therefore follows the objects of a heap itself before the
library reads the heap. All hangs that `python -m benchmarks fuzz` has found were of this kind. For
each text, the file also holds a descriptor: its length, the address of its heap, and the number of
its object. The library allocates this length before it looks for the object. The guard finds the
descriptors of attributes in what the library reads; `check_texts` reads those of a dataset.

All metadata of all files are read through the guard, because damage may turn any object into one
that needs a heap. The samples of a recording are read without it, from a second handle of the file:
there the library repeats what it has done behind the guard, and reads numbers.
"""

import contextlib
import functools
import importlib
import io
import math
import os
import re
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
_WRITTEN = 0b101  # marks in a superblock: open to write, and open to write while others read
_TEXT = struct.Struct("<IQI")  # length, address of the heap, index of the object
# Start of the type of a text of variable length: version and class, kind, and the size of `_TEXT`.
_VARIABLE = re.compile(
    rb"[\x19\x29\x39\x49\x59][%b]..\x10\0\0\0" % bytes(range(1, 256, 16)), re.DOTALL
)

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
    """A file for the HDF5 library that refuses a damaged global heap, and texts that are too long.

    A heap is damaged if its objects are a loop or its size is wrong.
    """

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer, after a check of the heaps that begin in it."""
        start = self.tell()
        before = min(start, _TEXT.size)  # a signature or text may begin in the previous read
        self.seek(start - before)
        part = self.read(before + len(buffer) + _TEXT.size)
        if len(part) <= 1 << 21 and _VARIABLE.search(part):  # larger reads are samples
            self._check_texts(part)
        place = part.find(_HEAP)
        while place >= 0:
            self._follow(start - before + place)
            place = part.find(_HEAP, place + 1)
        part = part[before : before + len(buffer)]
        buffer[: len(part)] = part
        self.seek(start + len(part))
        return len(part)

    def _check_texts(self, part: bytes) -> None:
        """Raise OSError if an attribute in these bytes has a text that is too long."""
        size = os.fstat(self.fileno()).st_size
        longest = max(_lengths(part), default=0)
        if longest > min(size, limits.ATTRIBUTE):
            raise OSError(f"it has a text of {longest} bytes")

    def _follow(self, heap: int) -> None:
        """Raise OSError if a heap exceeds the file, or an object does not lead to the next."""
        self.seek(heap + len(_HEAP))
        end = heap + int.from_bytes(self.read(8), "little")
        damaged = OSError(f"the heap of texts at byte {heap} is damaged")
        if end > os.fstat(self.fileno()).st_size:  # the library would allocate its declared size
            raise damaged
        place = heap + len(_HEAP) + 8
        while place <= end - _OBJECT.size:
            self.seek(place)
            index, _, length = _OBJECT.unpack(self.read(_OBJECT.size))
            step = length if index == 0 else _OBJECT.size + (length + 7) // 8 * 8
            if step == 0:
                raise damaged
            place += step


def _lengths(part: bytes) -> Iterator[int]:
    """Lengths of the texts of variable length in messages of attributes."""
    message = struct.Struct("<BxHHH")  # version, flags, sizes of its name, type and shape
    start = re.compile(rb"(?=[\x01-\x03][\x00-\x03])")
    for match in start.finditer(part, 0, max(len(part) - message.size, 0)):
        version, name, kind, space = message.unpack_from(part, match.start())
        unit = 8 if version == 1 else 1  # to which the parts are padded
        name, kind, space = (-(-size // unit) * unit for size in (name, kind, space))
        of_type = match.start() + message.size + (version == 3) + name
        first = of_type + kind + space
        if not _VARIABLE.match(part, of_type):
            continue
        sides = part[of_type + kind : first]
        rank, begin = sides[1] if len(sides) > 1 else 0, 8 if sides[:1] == bytes([1]) else 4
        shape = sides[begin:][: 8 * rank]
        shape = struct.unpack_from(f"<{len(shape) // 8}Q", shape)
        for at in range(first, len(part) - _TEXT.size + 1, _TEXT.size)[: math.prod(shape)]:
            yield _TEXT.unpack_from(part, at)[0]


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
        _check_superblock(raw)
        try:
            opened = h5py.File(raw, "r", **options)
        except Exception as error:
            # The frames of the library hold objects that lead to `raw`. If they live until the
            # process ends, the library ends it with a segmentation fault.
            raise error.with_traceback(None) from None
        file = stack.enter_context(opened)
        yield file


def _check_superblock(raw: io.FileIO) -> None:
    """Raise an error if a file was not closed or not copied whole, or has other addresses.

    Addresses and lengths must have 8 bytes, as the guard needs it.
    """
    for place in (0, 512, 1024, 2048):
        raw.seek(place)
        head = raw.read(48)
        if head.startswith(b"\x89HDF\r\n\x1a\n"):
            break
    else:
        return
    version = head[8]
    at, end = (13, 40 if version == 0 else 44) if version < 2 else (9, 28)
    if version > 3 or head[at : at + 2] != b"\x08\x08":
        raise OSError("its addresses do not have 8 bytes")
    if version == 3 and head[11] & _WRITTEN:
        raise RecordingError(
            "was not closed by the program that wrote it, or is still open there",
            remedy="Close it there; if that program has ended, clear its mark in a copy of the "
            "file: h5clear -s COPY (a tool of HDF5)",
        )
    size, stored = os.fstat(raw.fileno()).st_size, int.from_bytes(head[end : end + 8], "little")
    if stored > size:
        raise RecordingError(
            f"ends at byte {size}, its data at byte {stored}: it was not copied whole, or not "
            "closed by the program that wrote it",
            remedy="Copy it again, or record it again",
        )
    raw.seek(0)


def attribute_names(owner: h5py.HLObject) -> list[str]:
    """Names of the attributes of a group or dataset, if they are not too many."""
    names = list(owner.attrs)
    if len(names) > limits.NAMES:
        raise RecordingError(
            f"has {len(names)} attributes, at most {limits.NAMES} are read",
            remedy="Remove attributes that are not in the schema",
        )
    return names


def attribute(owner: h5py.HLObject, name: str) -> Any:
    """Value of an attribute, after a check of its type and size.

    Of the types of variable length only text and references are read. No schema contains another,
    and a damaged text may look like one, for which the library would crash.
    """
    stored = owner.attrs.get_id(name)
    dtype, shape = stored.dtype, stored.shape
    if dtype.hasobject and not (h5py.check_string_dtype(dtype) or h5py.check_ref_dtype(dtype)):
        raise TypeError("it is a sequence of variable length")
    size = math.prod(shape or ()) * dtype.itemsize
    if size > limits.ATTRIBUTE:
        raise ValueError(f"it has {size} bytes, at most {limits.ATTRIBUTE} are read")
    if shape is not None and dtype.kind in "iufS":  # as h5py does, which opens it once more
        numbers = np.empty(shape, dtype)
        stored.read(numbers)
        return numbers[()]
    value = owner.attrs[name]
    if isinstance(value, str):
        return _clean(value)
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        items = [_clean(item) if isinstance(item, str) else item for item in value.ravel()]
        return np.array(items, object).reshape(value.shape)
    return value


def _clean(text: str) -> str:
    """A text without damaged bytes; with them it could not be written again."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def check_size(dataset: h5py.Dataset) -> None:
    """Raise an error if a dataset declares too much data, before memory is allocated."""
    if dataset.external or dataset.is_virtual:
        raise RecordingError(
            "its samples are in another file", remedy="Copy the samples into the file"
        )
    _check_filters(dataset)
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
            f"declares {declared} bytes, but only {held} bytes are stored",
            remedy=DAMAGED,
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


def check_texts(dataset: h5py.Dataset, path: str) -> None:
    """Raise an error if the texts of a dataset are longer than its file, before they are read."""
    rows, size = int(dataset.size or 0), os.path.getsize(path)
    if rows == 0:
        return
    start = dataset.id.get_offset()
    if start is None or start + rows * _TEXT.size > size:
        raise RecordingError("its texts are not stored in one block of the file", remedy=DAMAGED)
    descriptor = np.dtype([("length", "<u4"), ("address", "<u8"), ("index", "<u4")])
    texts = np.memmap(path, descriptor, "r", start, (rows,))
    declared = int(texts["length"].sum(dtype=np.uint64))
    if declared > size:  # each text has its own bytes in the file
        raise RecordingError(
            f"declares texts of {declared} bytes, the file has {size}", remedy=DAMAGED
        )


def local_link(group: h5py.Group, name: str) -> h5py.HardLink | h5py.SoftLink:
    """Link of a member of a group; an error if it leads to another file or is a loop."""
    link: Any = group.get(name, getlink=True)
    if isinstance(link, h5py.HardLink):
        return link
    soft = "soft " * isinstance(link, h5py.SoftLink)
    place: Any = group
    left, links = [name], 0
    while left:
        part = left.pop()
        if not part or not isinstance(place, h5py.Group):
            continue
        next_link: Any = place.get(part, getlink=True)
        if next_link is None:  # a dangling link
            break
        if isinstance(next_link, h5py.ExternalLink):
            raise RecordingError(
                f"is a {soft}link to another file, {next_link.filename!r}",
                remedy="Copy the data into the file",
            )
        if isinstance(next_link, h5py.SoftLink):
            links += 1
            if links > limits.DEPTH:
                raise RecordingError("is a soft link in a loop", remedy="Remove the link")
            place = place.file if next_link.path.startswith("/") else place
            left += next_link.path.split("/")[::-1]
        elif left:
            place = place[part]
    return link
