"""Reader for tables of text with a header line, in one pass and in bounded memory.

A table has commas between its cells, points in its numbers, and its names in the first line, unless
the user says otherwise. A table that looks different is refused; the error says what to confirm.

A column `open [mV]` or `open (mV)` has the name `open` and the unit mV. Oscilloscopes write the
units into a second line instead, such as `(ms),(mV),(mV)` or `Sequence,VOLT,VOLT,-6e-3,5e-6`.

A table without names has the columns `1`, `2`, …; `header_line` is then 0. Some oscilloscopes
write such tables, with a preamble in the first columns of the first rows.
"""

import codecs
import contextlib
import csv
import dataclasses
import itertools
import pathlib
import re
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO, TextIO

import numpy as np

from etid.files.channel import Channel, Contents
from etid.files.units import parse_unit
from etid.recordings.recording import RecordingError

_SEEN = 1 << 16  # [bytes] start of a table that is looked at before it is read
_LINES = 200  # lines in which the first row of numbers is searched
_BESIDE = 3  # rows in which numbers beside a preamble are searched
_DIALECTS = (",.", ";.", ";,", "\t.", "\t,")  # delimiters and decimal signs that are tried
ROWS = 1 << 16  # rows of text in memory at a time

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]")


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


DIALECT = tuple(field.name for field in dataclasses.fields(Dialect))


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path, **told: Any) -> Iterator[Contents]:
    """Columns of a table; `prepare` copies the needed columns to temporary binary files.

    Args:
        path: The table.
        folder: Folder of the temporary files.
        **told: Fields of `Dialect` that the user has given.

    Raises:
        RecordingError: The table is damaged, or nothing was told and it looks different from a
            default table.
    """
    dialect = Dialect(**told)
    if not told:
        _refuse_another(path)
    with contextlib.ExitStack() as files:
        with path.open(newline="", encoding=dialect.encoding) as text:
            names, units, skipped = _header(text, dialect)

        columns: dict[str, BinaryIO] = {}
        count = 0

        def prepare(wanted: Iterable[str]) -> None:
            nonlocal count
            for name in wanted:
                columns[name] = files.enter_context(tempfile.TemporaryFile(dir=folder))
            count = spool(
                path, dialect, skipped, {names.index(name): columns[name] for name in columns}
            )

        def channel(name: str) -> Channel:
            def read(_: int, start: int, stop: int) -> np.ndarray:
                columns[name].seek(8 * start)
                return np.frombuffer(columns[name].read(8 * (stop - start)))

            unit = units[names.index(name)]
            return Channel(name, (count,), np.dtype(np.float64), read, unit)

        yield Contents(names, channel, prepare)


def _refuse_another(path: pathlib.Path) -> None:
    """Raise an error that says what to confirm if a table looks different from the default."""
    with path.open("rb") as file:
        start = file.read(_SEEN)
    encoding = Dialect.encoding
    try:
        codecs.getincrementaldecoder(encoding)().decode(start)
    except UnicodeDecodeError:
        encoding = "utf-16" if start[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "cp1252"
    lines = start.decode(encoding, "replace").splitlines()[:_LINES]
    found = _guessed(lines, encoding)
    if found is None or found == Dialect():
        return
    options = {name: value for name, value in dataclasses.asdict(found).items()
               if value != getattr(Dialect, name)}  # fmt: skip
    flags = " ".join(
        f"--{name.replace('_', '-')} {value if isinstance(value, int) else repr(value)}"
        for name, value in options.items()
    )
    raise RecordingError(
        "seems to be written with "
        + ", ".join(f"{name} {value!r}" for name, value in options.items())
        + f" and the columns {', '.join(_names(found, lines[max(found.header_line - 1, 0)]))}",
        remedy=f"Nothing is guessed: if this is right, add {flags}",
    )


def _guessed(lines: list[str], encoding: str) -> Dialect | None:
    """The dialect in which a table has rows of numbers; None if no dialect has them."""
    filled = [number for number, line in enumerate(lines, 1) if line.strip()]
    for delimiter, decimal in _DIALECTS:
        dialect = Dialect(delimiter, decimal, encoding=encoding)
        cells = [dialect.cells(lines[number - 1]) for number in filled]
        for row in range(1, len(cells) - 1):
            width = len(cells[row])
            if width < 2 or not all(
                len(one) == width and dialect.are_numbers(one) for one in cells[row : row + 2]
            ):
                continue
            units = dialect.units(cells[row - 1], len(cells[row - 1])) is not None
            header = max(0, row - 1 - units)
            named = not dialect.are_numbers(cells[header])
            return dataclasses.replace(dialect, header_line=filled[header] if named else 0)
    for delimiter, decimal in _DIALECTS:
        dialect = Dialect(delimiter, decimal, 0, encoding)
        rows = [dialect.cells(line) for line in lines[:_BESIDE]]
        columns = [all(map(dialect.is_number, column)) for column in zip(*rows, strict=False)]
        if len(rows) == _BESIDE and sum(columns) > 1:
            return dialect
    return None


def _names(dialect: Dialect, line: str) -> list[str]:
    """Names of the columns, from the line with the names or from the first row."""
    cells = dialect.cells(line)
    return cells if dialect.header_line else [str(i) for i in range(1, len(cells) + 1)]


def _header(text: TextIO, dialect: Dialect) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units, and the number of lines above the numbers."""
    skipped = dialect.header_line - 1
    for _ in range(skipped):
        text.readline()
    line = text.readline()
    cells = _names(dialect, line)
    if not dialect.header_line:
        return tuple(cells), ("",) * len(cells), 0
    if dialect.are_numbers(cells):
        raise RecordingError(
            f"line {dialect.header_line} holds numbers, not the names of the columns",
            remedy="If no line names them, add --header-line 0; the columns are then 1, 2, …",
        )
    names, units = zip(*map(with_unit, cells), strict=True) if cells else ((), ())
    below = dialect.units(dialect.cells(text.readline()), len(names))
    if below is None:
        return names, units, skipped + 1
    units = tuple(above or unit for above, unit in zip(units, below, strict=True))
    return names, units, skipped + 2


def with_unit(cell: str) -> tuple[str, str]:
    """Name and unit of a column, from `name [unit]` or `name (unit)`; the unit may be empty."""
    match = _WITH_UNIT.fullmatch(cell)
    if match is None or not parse_unit(match["unit"]):
        return cell, ""
    return match["name"], match["unit"].strip()


def spool(path: pathlib.Path, dialect: Dialect, skipped: int, columns: dict[int, BinaryIO]) -> int:
    """Write columns to files as real numbers, and return the number of rows."""
    rows = 0
    with path.open(newline="", encoding=dialect.encoding) as text:
        lines = (
            line if dialect.decimal == "." else line.replace(dialect.decimal, ".")
            for line in itertools.islice(text, skipped, None)
            if line.strip()
        )
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
    return rows
