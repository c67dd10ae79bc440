"""Damage files: bytes, texts, JSON, TOML and archives. Seeded, and without limits."""

import io
import json
import zipfile
from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

Rng = np.random.Generator

# Sizes and addresses that break arithmetic.
_SPECIAL = (0, 1, 2, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)


def one_of(rng: Rng, choices: Sequence[Any]) -> Any:
    """One of several, drawn."""
    return choices[int(rng.integers(len(choices)))]


def damaged(data: bytes, rng: Rng) -> bytes:
    """Flip, overwrite, cut, repeat, move and append bytes, one to four times."""
    found = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if found:
            one_of(rng, _BYTES)(found, rng)
    return bytes(found)


def _place(data: bytearray, rng: Rng, longest: int = 1 << 12) -> slice:
    start = int(rng.integers(len(data)))
    if rng.random() < 0.5:  # metadata are at the beginning
        start = int(rng.integers(min(len(data), 4096)))
    return slice(start, start + int(rng.integers(1, longest)))


def _flip(data: bytearray, rng: Rng) -> None:
    for _ in range(int(rng.integers(1, 9))):
        data[_place(data, rng).start] ^= 1 << int(rng.integers(8))


def _set(data: bytearray, rng: Rng) -> None:
    for _ in range(int(rng.integers(1, 9))):
        data[_place(data, rng).start] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x2C]))


def _number(data: bytearray, rng: Rng) -> None:
    size = int(rng.choice([2, 4, 8]))
    start = _place(data, rng).start // size * size
    value = int(rng.choice(np.array(_SPECIAL, dtype=object)))
    if rng.random() < 0.5:  # an address inside the file, as a link to something else
        value = int(rng.integers(len(data))) // 8 * 8
    data[start : start + size] = (value % 256**size).to_bytes(size, "little")


def _cut(data: bytearray, rng: Rng) -> None:
    del data[_place(data, rng).start :]


def _delete(data: bytearray, rng: Rng) -> None:
    del data[_place(data, rng, 64)]


def _repeat(data: bytearray, rng: Rng) -> None:
    place = _place(data, rng, 256)
    data[place.start : place.start] = data[place]


def _move(data: bytearray, rng: Rng) -> None:
    block = data[_place(data, rng, 512)]
    start = _place(data, rng).start // 8 * 8
    data[start : start + len(block)] = block


def _zero(data: bytearray, rng: Rng) -> None:
    place = _place(data, rng)
    data[place] = bytes(len(data[place]))


def _append(data: bytearray, rng: Rng) -> None:
    data += rng.bytes(int(rng.integers(1, 4096)))


_BYTES = (_flip, _set, _number, _number, _cut, _delete, _repeat, _move, _zero, _append)


def odd_value(rng: Rng) -> Any:
    """A value that no attribute or number of a schema should have."""
    choices = (
        0, -1, 1, 7, 2**62, np.nan, np.inf, -np.inf, 1e308, 1e-308, -0.0, True, 60.0, 2.0e5,
        "", "x", "volt", "loaded", "calibration", "/", "../..", "a\tb", "Ω", "x" * 5000,
        np.bytes_(b"\xff\xfe"), [1.0, 2.0], [1, 2, 3], ["a", "b"], np.zeros((2, 2)),
        np.zeros(7000), 1 + 2j, np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
        h5py.Empty("f8"), h5py.Empty("S3"), np.longdouble(1), np.float16(3),
        np.array([b"s01/dry"]), np.void(b"abc"), np.uint64(2**64 - 1),
    )  # fmt: skip
    return one_of(rng, choices)


def damaged_json(text: str, rng: Rng) -> str:
    """Remove, replace or nest a value of a JSON object, or damage its text."""
    if rng.random() < 0.3:
        return damaged(text.encode(), rng).replace(b"\0", b" ").decode("utf-8", "replace")
    if rng.random() < 0.1:
        depth = int(rng.choice([10, 1000, 100_000]))
        return "[" * depth + "]" * depth
    content = json.loads(text)
    key = one_of(rng, list(content))
    odd = (None, 0, -1, 2.5, 1e308, True, "x", [], {}, [1.0], [[1.0]], ["a"], {"a": [1]}, 10**30,
           [[1.0], [2.0, 3.0]], float("nan"), [None], "successful")  # fmt: skip
    if rng.random() < 0.2:
        del content[key]
    else:
        content[key] = one_of(rng, odd)
    return json.dumps(content)


def damaged_npz(data: bytes, rng: Rng) -> bytes:
    """Replace, remove or misdeclare an array of an archive, whose checksums are right."""
    if rng.random() < 0.4:
        return damaged(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(members)))
    what = rng.random()
    if what < 0.2:
        del members[name]
    elif what < 0.5:
        members[name] = damaged(members[name], rng)
    elif what < 0.7:
        shape = one_of(rng, [(2**40,), (2**33, 100), (10**9,), (-1,), (3, -4), (2**70,)])
        header = f"{{'descr': '<i2', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        members[name] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    else:
        buffer = io.BytesIO()
        odd = odd_value(rng)
        np.save(buffer, np.zeros(3) if isinstance(odd, h5py.Empty) else np.asarray(odd))
        members[name] = buffer.getvalue()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return buffer.getvalue()


def damaged_text(data: bytes, rng: Rng) -> bytes:
    """Damage a table or a mapping: its bytes, or its lines."""
    if rng.random() < 0.5:
        return damaged(data, rng)
    lines = data.split(b"\n")
    place = int(rng.integers(min(len(lines), 12)))
    odd = (b"", b",,,,", b'"', b"nan,inf,-inf", b"1e999,1,1", b"1,2", b"1,2,3,4", b"\xff\xfe", b"a",
           b"\0\0", b"1;2;3", b"0x10,1,1", b"9" * 5000, b'"' + b"x" * 200_000)  # fmt: skip
    lines[place] = one_of(rng, odd)
    return b"\n".join(lines)


def damaged_toml(data: bytes, rng: Rng) -> bytes:
    """The same for a mapping, with deep values, large numbers and values of other types."""
    if rng.random() < 0.4:
        return damaged_text(data, rng)
    lines = data.decode().splitlines()
    place = one_of(rng, [number for number, line in enumerate(lines) if "=" in line])
    depth = int(rng.choice([3, 300, 30_000]))
    values = (
        "[" * depth + "]" * depth, "{a=" * depth + "1" + "}" * depth, "1" + "0" * 400, "1" * 6000,
        "nan", "inf", "-inf", "-1", "0", "true", "''", "'x'", "[]", "{}", "[1, 2]", "['a', {}]",
        "1979-05-27T07:32:00Z", "0x" + "f" * 300, "{channel = 3}", "{channel = 'open', rows = [0]}",
        "{channel = 'open', rows = 99999999999999999999}", '"\\u0000"', "{channel = 'skin'}",
        "1e400", "1e-320", "'" + "x" * 100_000 + "'",
    )  # fmt: skip
    key = lines[place].partition("=")[0]
    if rng.random() < 0.15:
        key = ".".join(["a"] * depth)
    lines[place] = f"{key} = {one_of(rng, values)}"
    if rng.random() < 0.1:
        lines += ["[[recording]]", "path = 'x'"] * int(rng.choice([2, 3000]))
    return "\n".join(lines).encode()
