"""Check of MATLAB files of version 5, which SciPy reads without one."""

import math
import pathlib
import struct
import zlib

from etid.recordings import limits
from etid.recordings.errors import RecordingError

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
