"""Reader for MATLAB files.

Version 7.3 is HDF5 and is read in blocks. Earlier versions are read completely. Field b of
structure a is the channel `a.b`. Rows are trials, columns are times.
"""

import contextlib
import math
import pathlib
import struct
import warnings
import zlib
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
import scipy.io
from h5py import h5o  # type: ignore[attr-defined]  # compiled, without stubs

from etid.files.channel import Channel, Contents, array_channel
from etid.recordings import limits
from etid.recordings.errors import RecordingError
from etid.recordings.untrusted import attribute, check_size, guarded, local_link


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a MATLAB file of any version."""
    del folder
    if h5py.is_hdf5(path):
        # A chunk holds several trials, which are read one by one.
        with guarded(str(path), rdcc_nbytes=1 << 25) as file:
            yield _hdf5(file)
    else:
        yield _whole(path)


def _hdf5(file: h5py.File) -> Contents:
    """Channels of version 7.3: HDF5 with reversed axes; names with `#` are internal to MATLAB."""
    datasets: dict[str, h5py.Dataset] = {}
    walked: set[int] = set()  # addresses, because links may form a loop

    def walk(group: h5py.Group, prefix: str) -> None:
        address = h5o.get_info(group.id).addr
        if address in walked:
            return
        walked.add(address)
        if prefix.count(".") > limits.DEPTH:
            raise RecordingError(f"has structures nested more than {limits.DEPTH} deep")
        names: Any = list(group)
        for name in names:
            if name.startswith("#"):
                continue
            local_link(group, name)
            member = group.get(name)
            if isinstance(member, h5py.Group):
                walk(member, f"{prefix}{name}.")
            elif isinstance(member, h5py.Dataset):
                datasets[f"{prefix}{name}"] = member

    walk(file, "")

    def channel(name: str) -> Channel:
        data = datasets[name]
        kind = attribute(data, "MATLAB_class") if "MATLAB_class" in data.attrs else b""
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if kind in ("char", "logical", "cell"):
            raise RecordingError(f"{name!r} is a {kind} array, must be an array of real numbers")
        if "MATLAB_empty" in data.attrs or data.shape is None:
            raise RecordingError(f"{name!r} is empty")
        check_size(data)
        axes = [axis for axis, size in enumerate(data.shape) if size != 1] or [0]
        shape = tuple(data.shape[axis] for axis in reversed(axes))

        def read(trial: int, start: int, stop: int) -> np.ndarray:
            place: list[int | slice] = [0] * data.ndim
            place[axes[0]] = slice(start, stop)
            if len(axes) == 2:
                place[axes[1]] = trial
            return data[tuple(place)]

        return Channel(name, shape, data.dtype, read)

    return Contents(tuple(datasets), channel)


def _whole(path: pathlib.Path) -> Contents:
    """Channels of version 5 and older."""
    check(path)
    try:
        # Variables that SciPy leaves out are named where they are asked for.
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            content = _flat(scipy.io.loadmat(path, simplify_cells=True))
    except (scipy.io.matlab.MatReadError, UnboundLocalError) as error:  # an unknown class of array
        raise RecordingError(f"cannot be read ({error})") from error
    if any("byte ordering" in str(one.message) for one in said):
        raise RecordingError(
            "contains numbers of a VAX or Cray (MATLAB 4), which are read wrong",
            remedy="Save it again in MATLAB: save('file.mat', '-v7.3')",
        )

    def channel(name: str) -> Channel:
        array = content[name]
        if not isinstance(array, np.ndarray):
            kind = type(array).__name__
            raise RecordingError(f"{name!r} is a {kind}, must be an array of real numbers")
        return array_channel(name, array)

    return Contents(tuple(content), channel)


def _flat(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Variables by name; the fields of structures have names such as `structure.field`."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        elif not name.startswith("__"):
            flat[f"{prefix}{name}"] = value
    return flat


# --- Check of files of version 5 ------------------------------------------------------------------


_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}  # types of elements: integers, reals, texts


def check(path: pathlib.Path) -> None:
    """Raise an error if an element of a version-5 file is invalid; other versions pass.

    SciPy does not check these files. An element of an unknown type crashes the process, as does one
    that is no number where SciPy reads numbers, for instance after an array that says that it is
    complex and is not. SciPy allocates a cell array with its declared size. A file is a sequence of
    elements (type, size, bytes); a matrix contains further elements (MathWorks, MAT-File Format,
    chapter 1).

    Raises:
        RecordingError: An element has an unknown type, is longer than the file, is nested too
            deep, or declares more data than it contains.
    """
    data = path.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if 0 in data[:4]:
        return  # version 4
    if order is None:
        raise _error("is not a MATLAB file of version 5 or 7.3")
    _walk(memoryview(data)[128:], order, 0)


def _error(message: str) -> RecordingError:
    return RecordingError(message, remedy="The file is damaged: copy or save it again")


def _walk(data: memoryview, order: str, depth: int) -> list[tuple[int, memoryview]]:
    """List the elements of one level, and check the elements inside them."""
    if depth > limits.DEPTH:
        raise _error(f"has variables nested more than {limits.DEPTH} deep")
    elements: list[tuple[int, memoryview]] = []
    place = 0
    while place < len(data):
        if len(data) - place < 8:
            raise _error("ends inside an element")
        kind, size = struct.unpack_from(f"{order}II", data, place)
        if kind >> 16:  # short element: type, size and up to 4 bytes in 8 bytes
            kind, size, start, after = kind & 0xFFFF, kind >> 16, place + 4, place + 8
            if size > 4:
                raise _error(f"has a short element of {size} bytes")
        else:
            start, after = place + 8, place + 8 + size
            after += 0 if kind == _COMPRESSED else -size % 8
        if start + size > len(data):
            raise _error(f"has an element of {size} bytes that ends after the file")
        body = data[start : start + size]
        if kind == _COMPRESSED:
            _walk(_unpacked(body), order, depth + 1)
        elif kind == _MATRIX:
            _check_matrix(_walk(body, order, depth + 1), order, size)
        elif kind not in _NUMBERS:
            raise _error(f"has an element of type {kind}, which does not exist")
        elements.append((kind, body))
        place = after
    return elements


def _unpacked(body: memoryview) -> memoryview:
    most = max(limits.FREE, limits.COMPRESSION * len(body))
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(body, most)
    if unpacker.unconsumed_tail:
        raise _error(f"has a variable of more than {most} bytes in {len(body)}")
    return memoryview(content)


def _check_matrix(parts: list[tuple[int, memoryview]], order: str, size: int) -> None:
    """Raise an error if a matrix lacks numbers, or declares more cells than its bytes can hold."""
    if not parts:
        return  # empty
    if len(parts[0][1]) < 8:
        raise _error("has an array without a class")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    kind = flags & 0xFF  # 1 to 3: cells, structures, objects; 4: texts; 5: sparse; 6 to 15: numbers
    numbers = {4: 1, 5: 3, **dict.fromkeys(range(6, 16), 1)}.get(kind, 0)  # elements of numbers
    if 5 <= kind <= 15 and flags & 0x800:  # complex
        numbers += 1
    named = 3  # elements before the numbers: flags, shape, name
    values = parts[named : named + numbers]
    if len(values) < numbers or any(one not in _NUMBERS for one, _ in values):
        raise _error("has an array without its numbers")
    if kind not in (1, 2, 3) or len(parts) < named:
        return  # only of the others SciPy makes arrays of Python objects
    count = len(parts[1][1]) // 4
    shape = struct.unpack_from(f"{order}{count}i", parts[1][1])
    if min(shape, default=0) < 0 or math.prod(shape) > max(1, size):
        raise _error(f"has an array of shape {shape} in {size} bytes")
