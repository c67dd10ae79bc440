"""Reader for comma-separated tables with a header line, in one pass and in bounded memory.

A column `open [mV]` or `open (mV)` has the name `open` and the unit mV. Oscilloscopes write the
units into a second line instead, such as `(ms),(mV),(mV)`. This line contains no number.
"""

import contextlib
import csv
import itertools
import pathlib
import re
import tempfile
from collections.abc import Iterable, Iterator
from typing import BinaryIO, TextIO

import numpy as np

from etid.files.channel import Channel, Contents
from etid.files.units import parse_unit
from etid.recordings.recording import RecordingError

ROWS = 1 << 16  # rows of text in memory at a time

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]")


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Columns of a table; `prepare` copies the needed columns to temporary binary files."""
    with contextlib.ExitStack() as files:
        with path.open(newline="", encoding="utf-8-sig") as text:
            names, units, skipped = _header(text)

        columns: dict[str, BinaryIO] = {}
        count = 0

        def prepare(wanted: Iterable[str]) -> None:
            nonlocal count
            for name in wanted:
                columns[name] = files.enter_context(tempfile.TemporaryFile(dir=folder))
            count = _spool(path, skipped, {names.index(name): columns[name] for name in columns})

        def channel(name: str) -> Channel:
            def read(_: int, start: int, stop: int) -> np.ndarray:
                columns[name].seek(8 * start)
                return np.frombuffer(columns[name].read(8 * (stop - start)))

            unit = units[names.index(name)]
            return Channel(name, (count,), np.dtype(np.float64), read, unit)

        yield Contents(names, channel, prepare)


def _header(text: TextIO) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units, and the number of header lines."""
    cells = _cells(text.readline())
    if cells and all(_is_number(cell) for cell in cells):
        raise RecordingError(
            "the first line holds numbers", remedy="The first line must name the columns"
        )
    found = [_WITH_UNIT.fullmatch(cell) for cell in cells]
    known = [match if match and parse_unit(match["unit"]) else None for match in found]
    names = [match["name"] if match else cell for match, cell in zip(known, cells, strict=True)]
    units = [match["unit"].strip() if match else "" for match in known]
    below = [cell.strip("()[] ") for cell in _cells(text.readline())]
    if len(below) != len(names) or not any(below) or any(map(_is_number, below)):
        return tuple(names), tuple(units), 1
    if any(cell and not parse_unit(cell) for cell in below):
        return (
            tuple(names),
            tuple(units),
            1,
        )  # not units: the parser of the numbers will raise the error
    both = zip(units, below, strict=True)
    return tuple(names), tuple(above or unit for above, unit in both), 2


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line]), [])]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _spool(path: pathlib.Path, skipped: int, columns: dict[int, BinaryIO]) -> int:
    """Write columns to files as real numbers, and return the number of rows."""
    rows = 0
    with path.open(newline="", encoding="utf-8-sig") as text:
        lines = (line for line in itertools.islice(text, skipped, None) if line.strip())
        while part := list(itertools.islice(lines, ROWS)):
            try:
                table = np.loadtxt(
                    part,
                    delimiter=",",
                    comments=None,
                    quotechar='"',
                    usecols=list(columns),
                    ndmin=2,
                )
            except ValueError as error:
                beyond = f", counted from row {rows + 1}" * bool(rows)
                raise RecordingError(f"cannot be read ({error}{beyond})") from None
            for file, column in zip(columns.values(), table.T, strict=True):
                file.write(np.ascontiguousarray(column).data)
            rows += len(table)
    if not rows:
        raise RecordingError("the table has no rows")
    return rows
