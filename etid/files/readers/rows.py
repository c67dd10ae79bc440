"""Rows of tables of text: how they are written, and their columns in bounded memory."""

import collections
import csv
import dataclasses
import itertools
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import BinaryIO, TextIO

import numpy as np

from etid.files.units import parse_unit
from etid.recordings.recording import RecordingError

ROWS = 1 << 16  # rows of text in memory at a time


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How a table is written.

    Attributes:
        delimiter: Character between the cells.
        decimal: Decimal sign of the numbers: `.` or `,`.
        header_line: Line with the names of the columns, counted from 1; lines above are skipped.
            0: no line names them.
        encoding: Encoding of the text.
    """

    delimiter: str = ","
    decimal: str = "."
    header_line: int = 1
    encoding: str = "utf-8-sig"

    def __post_init__(self) -> None:
        if len(self.delimiter) != 1 or self.decimal not in (".", ",") or self.header_line < 0:
            raise RecordingError(f"the table cannot be written as {self}")

    def cells(self, line: str) -> list[str]:
        """Cells of a line."""
        row = next(csv.reader([line], delimiter=self.delimiter), [])
        return [cell.strip() for cell in row]

    def units(self, cells: Sequence[str], count: int) -> tuple[str, ...] | None:
        """The units of `count` columns if a line of cells holds units; None if it holds none.

        An oscilloscope writes the start of its clock into the cells beside the units.
        """
        cells = [cell.strip("()[] ") for cell in cells]
        if len(cells) > count or not any(map(parse_unit, cells)):
            return None
        found = ["" if self.is_number(cell) else cell for cell in cells]
        return (*found, *[""] * (count - len(found)))

    def is_number(self, cell: str) -> bool:
        """Whether a cell is a number with this decimal sign."""
        try:
            float(cell.replace(self.decimal, "."))
        except ValueError:
            return False
        return self.decimal == "." or "." not in cell

    def are_numbers(self, cells: Sequence[str]) -> bool:
        """Whether all cells are numbers; empty ones at the end do not count."""
        filled = len(cells)
        while filled and not cells[filled - 1]:
            filled -= 1
        return filled > 0 and all(map(self.is_number, cells[:filled]))


def spool(
    path: pathlib.Path, dialect: Dialect, skipped: int, width: int, columns: dict[int, BinaryIO]
) -> tuple[int, str]:
    """Write columns to files as real numbers.

    Args:
        path: The table.
        dialect: How it is written.
        skipped: Number of lines above the numbers.
        width: Number of columns that have a name.
        columns: File for each column to be written.

    Returns:
        Number of rows, and a notice if the last row looks as if it was cut off.

    Raises:
        RecordingError: A row has too many or too few cells, or a cell is not a number.
    """
    rows = 0
    recent: collections.deque[str] = collections.deque(maxlen=100)
    with path.open(newline="", encoding=dialect.encoding) as text:
        lines = _rows(text, dialect, skipped, width, columns, recent)
        while part := list(itertools.islice(lines, ROWS)):
            try:
                table = np.loadtxt(
                    part,
                    delimiter=dialect.delimiter,
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
    return rows, _cut_off(recent, dialect)


def _rows(
    text: TextIO,
    dialect: Dialect,
    skipped: int,
    width: int,
    columns: Iterable[int],
    recent: collections.deque[str],
) -> Iterator[str]:
    """The rows below the header, with decimal points; `recent` gets them as the file has them.

    A lost delimiter and a decimal comma between commas shift the cells behind them. So a row has
    all cells up to the last number of the first row, and none without a name.
    """
    usual = least = None  # delimiters of a row that is right, and cells that every row needs
    for number, line in enumerate(itertools.islice(text, skipped, None), skipped + 1):
        if not line.strip():
            continue
        points = dialect.decimal != "." and "." in line
        if points or line.count(dialect.delimiter) != usual:
            cells = dialect.cells(line)
            if least is None:
                least = max(
                    (i for i, cell in enumerate(cells, 1) if dialect.is_number(cell)), default=1
                )
            if any(cells[width:]) or len(cells) < least:
                raise RecordingError(
                    f"line {number} has {len(cells)} cells; the table has {width} columns, and "
                    f"numbers in {least} of them",
                    remedy="Correct or remove this line; copy the file again if it is the last one",
                )
            for cell in (cells[place] for place in columns if place < len(cells)):
                if points and "." in cell:
                    raise RecordingError(
                        f"line {number} has the cell {cell!r}, but the decimal sign is a comma",
                        remedy="Export it without points for thousands, or tell its decimal sign",
                    )
            if len(cells) <= width and '"' not in line:
                usual = line.count(dialect.delimiter)
        recent.append(line)
        yield line if dialect.decimal == "." else line.replace(dialect.decimal, ".")


def _cut_off(recent: Sequence[str], dialect: Dialect) -> str:
    """A notice if the last number is shorter than those above and no line break follows it."""
    *above, last = map(dialect.cells, recent)
    place = max(i for i, cell in enumerate(last) if cell)
    digits, *others = (
        len("".join(row[place : place + 1]).partition(dialect.decimal)[2]) for row in (last, *above)
    )
    if recent[-1].endswith(("\n", "\r")) or digits >= min(others, default=0):
        return ""
    return (
        f"the last number, {last[place]!r}, is shorter than those above and no line break follows "
        "it: the file may have been cut off there"
    )
