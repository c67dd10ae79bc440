"""Reader for tables of text with a header line, in one pass and in bounded memory.

A table has commas between its cells, points in its numbers, and its names in the first line, unless
the user says otherwise. A table that looks different is refused; the error says what to confirm.

A column `open [mV]` or `open (mV)` has the name `open` and the unit mV. Oscilloscopes write the
units into a second line instead, such as `(ms),(mV),(mV)` or `Sequence,VOLT,VOLT,-6e-3,5e-6`.

A table without names has the columns `1`, `2`, …; `header_line` is then 0. Some oscilloscopes
write such tables, with a preamble in the first columns of the first rows; other programs write
lines of text above the numbers. If a preamble names the number of samples or their interval, the
table is compared with it.

Columns with one name tell their place: `CH1#2` and `CH1#4` are the second and the fourth column.
"""

import codecs
import collections
import contextlib
import csv
import dataclasses
import itertools
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO, TextIO

import numpy as np

from etid.files.channel import (
    Contents,
    by_place,
    one_unit,
    parse_unit,
    rate_of,
    spooled,
    with_unit,
)
from etid.files.readers import Reader
from etid.printing import several
from etid.recordings.recording import RecordingError

ROWS = 1 << 16  # rows of text in memory at a time


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How a table is written.

    Attributes:
        delimiter: Character between the cells. A blank means one or more blanks or tabs.
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
        def must(right: bool, field: str, be: str) -> None:
            if not right:
                raise RecordingError(f"is {getattr(self, field)!r}, must be {be}", field=field)

        must(len(self.delimiter) == 1, "delimiter", "one character, such as ';'")
        must(self.decimal in (".", ","), "decimal", "'.' or ','")
        must(self.decimal != self.delimiter, "decimal", "another character than the delimiter")
        must(self.header_line >= 0, "header_line", "the number of a line, or 0")
        try:
            codecs.lookup(self.encoding)
        except LookupError:
            must(False, "encoding", "an encoding of Python, such as cp1252")

    def tidy(self, line: str) -> str:
        """A line with the delimiter once between two cells."""
        return " ".join(line.split()) if self.delimiter == " " else line

    def cells(self, line: str) -> list[str]:
        """Cells of a line."""
        row = next(csv.reader([self.tidy(line)], delimiter=self.delimiter), [])
        return [cell.strip() for cell in row]

    def units(self, cells: Sequence[str], count: int) -> tuple[str, ...] | None:
        """The units of `count` columns if a line of cells holds units; None if it holds none.

        An oscilloscope writes the start of its clock into the cells beside the units.
        """
        cells = [cell.strip("()[] ") for cell in cells]
        if len(cells) > count or not any(map(parse_unit, cells)):
            return None
        found = ["" if self.number(cell) is not None else cell for cell in cells]
        return (*found, *[""] * (count - len(found)))

    def number(self, cell: str) -> float | None:
        """The number of a cell with this decimal sign; None if the cell holds none."""
        if self.decimal != "." and "." in cell:
            return None
        try:
            return float(cell.replace(self.decimal, "."))
        except ValueError:
            return None

    def are_numbers(self, cells: Sequence[str]) -> bool:
        """Whether all cells are numbers; empty ones at the end do not count."""
        filled = list(itertools.dropwhile(lambda cell: not cell, reversed(cells)))
        return bool(filled) and all(self.number(cell) is not None for cell in filled)


def spool(
    path: pathlib.Path, dialect: Dialect, skipped: int, width: int, columns: dict[int, BinaryIO]
) -> tuple[int, str]:
    """Write columns to files as real numbers.

    Returns:
        Number of rows, and a notice if the last row looks as if it was cut off.
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
                _refuse_texts(path, dialect, skipped, columns)
                raise RecordingError(f"cannot be read ({error})") from None
            for file, column in zip(columns.values(), table.T, strict=True):
                file.write(np.ascontiguousarray(column).data)
            rows += len(table)
    if not rows:
        raise RecordingError("the table has no rows")
    return rows, _cut_off(recent, dialect)


def _refuse_texts(
    path: pathlib.Path, dialect: Dialect, skipped: int, columns: Iterable[int]
) -> None:
    """Raise an error that names the line of the first cell without a number, if there is one."""
    with path.open(newline="", encoding=dialect.encoding) as text:
        for number, line in enumerate(itertools.islice(text, skipped, None), skipped + 1):
            cells = dialect.cells(line)
            for place in columns if line.strip() else ():
                cell = cells[place] if place < len(cells) else ""
                if dialect.number(cell) is None:
                    raise RecordingError(
                        f"line {number} has {cell!r} in column {place + 1}, must be a number",
                        remedy="Correct it, or write NaN: without this line, all later samples "
                        "would be at a wrong time",
                    )


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
    for number, own in enumerate(itertools.islice(text, skipped, None), skipped + 1):
        if not own.strip():
            continue
        line = dialect.tidy(own)
        points = dialect.decimal != "." and "." in line
        if points or line.count(dialect.delimiter) != usual:
            cells = dialect.cells(line)
            if least is None:
                least = max(
                    (i for i, cell in enumerate(cells, 1) if dialect.number(cell) is not None),
                    default=1,
                )
            if any(cells[width:]) or len(cells) < least:
                raise RecordingError(
                    f"line {number} has {several(len(cells), 'cell')}; the table has "
                    f"{several(width, 'column')}, and "
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
        recent.append(own)
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


LINES = 200  # lines in which a header ends
DIALECT = tuple(field.name for field in dataclasses.fields(Dialect))


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path, **told: Any) -> Iterator[Contents]:
    """Columns of a table.

    Args:
        path: The table.
        folder: Folder of the temporary files.
        **told: Fields of `Dialect` that the user has given.
    """
    dialect = Dialect(**told)
    if not told:
        _refuse_another(path)
    with path.open(newline="", encoding=dialect.encoding) as text:
        names, units, skipped = _header(text, dialect)
    length, rate = _preamble(path, dialect)

    def write(files: Mapping[str, BinaryIO]) -> str:
        places = {names.index(name): file for name, file in files.items()}
        width = max(number for number, name in enumerate(names, 1) if name)
        count, notice = spool(path, dialect, skipped, width, places)
        if length > count:  # an oscilloscope may have written a part of its record
            found = several(count, "row")
            return f"the table has {found}, its preamble declares {length:g} samples"
        return notice

    def about(name: str) -> dict[str, Any]:
        return {"unit": units[names.index(name)], "sample_rate": rate}

    with spooled(names, folder, write, about) as contents:
        yield contents


def _start(path: pathlib.Path) -> tuple[list[str], str]:
    """The first lines of a table, and their encoding."""
    with path.open("rb") as file:
        start = file.read(1 << 16)
    encoding = Dialect.encoding
    try:
        codecs.getincrementaldecoder(encoding)().decode(start)
    except UnicodeDecodeError:
        encoding = "utf-16" if start[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "cp1252"
    return start.decode(encoding, "replace").splitlines()[:LINES], encoding


def likely_dialect(path: pathlib.Path) -> Dialect | None:
    """The dialect in which a table has rows of numbers; None if no dialect has them."""
    return _guessed(*_start(path))


def _refuse_another(path: pathlib.Path) -> None:
    """Raise an error that says what to confirm if a table looks different from the default."""
    lines, encoding = _start(path)
    likely = _guessed(lines, encoding)
    if likely is None or likely == Dialect():
        return
    options = {name: value for name, value in dataclasses.asdict(likely).items()
               if value != getattr(Dialect, name)}  # fmt: skip
    flags = " ".join(
        f"--{name.replace('_', '-')} {value if isinstance(value, int) else repr(value)}"
        for name, value in options.items()
    )
    raise RecordingError(
        "seems to be written with "
        + ", ".join(f"{name} {value!r}" for name, value in options.items())
        + f" and the columns {', '.join(_names(likely, lines[max(likely.header_line - 1, 0)]))}",
        remedy=f"Nothing is guessed: if this is right, add {flags}",
    )


def _guessed(lines: list[str], encoding: str) -> Dialect | None:
    """The dialect in which a table has rows of numbers; None if no dialect has them."""
    filled = [number for number, line in enumerate(lines, 1) if line.strip()]
    signs = (",.", ";.", ";,", "\t.", "\t,", " .", " ,")  # delimiters and decimal signs
    for delimiter, decimal in signs:
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
            if delimiter == " ":  # a name that contains a blank would shift the others
                named &= len(cells[header]) == width
            return dataclasses.replace(dialect, header_line=filled[header] if named else 0)
    for delimiter, decimal in signs:  # columns of numbers beside a preamble
        dialect = Dialect(delimiter, decimal, 0, encoding)
        rows = [dialect.cells(line) for line in lines[:3]]
        columns = [None not in map(dialect.number, cells) for cells in zip(*rows, strict=False)]
        if len(rows) == 3 and sum(columns) > 1:
            return dialect
    return None


def _names(dialect: Dialect, line: str) -> list[str]:
    """Names of the columns, from the line with the names or from the first row."""
    cells = dialect.cells(line)
    return cells if dialect.header_line else [str(i) for i in range(1, len(cells) + 1)]


def _header(text: TextIO, dialect: Dialect) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units, and the number of lines above the numbers."""
    if not dialect.header_line:
        lines = list(itertools.islice(text, LINES))
        first = _first_row(lines, dialect)
        cells = _names(dialect, lines[first] if lines else "")
        return tuple(cells), ("",) * len(cells), first
    skipped = dialect.header_line - 1
    for _ in range(skipped):
        text.readline()
    cells = _names(dialect, text.readline())
    if dialect.are_numbers(cells):
        raise RecordingError(
            f"line {dialect.header_line} holds numbers, not the names of the columns",
            remedy="If no line names them, add --header-line 0; the columns are then 1, 2, …",
        )
    names, units = zip(*map(with_unit, cells), strict=True) if cells else ((), ())
    names = tuple(by_place(names))
    below = dialect.units(dialect.cells(text.readline()), len(names))
    if below is None:
        return names, units, skipped + 1
    return names, tuple(map(one_unit, names, units, below)), skipped + 2


def _first_row(lines: Sequence[str], dialect: Dialect) -> int:
    """Number of lines above the first row of a table without names.

    Lines above have a text, and other columns of numbers than the two lines below them. A line
    of numbers is a row.
    """
    rows = [dialect.cells(line) for line in lines]
    for place, row in enumerate(rows):
        below = rows[place : place + 3]
        numbers = [None not in map(dialect.number, cells) for cells in zip(*below, strict=False)]
        if dialect.are_numbers(row) or (any(numbers) and len({*map(len, below)}) == 1):
            return place
    return 0


def _preamble(path: pathlib.Path, dialect: Dialect) -> tuple[float, float | None]:
    """Number of samples and sample rate [Hz] in a preamble; 0 and None if it names none.

    The name is in the first cell of a line, the value in the second. Rigol writes the interval
    below the name `Increment`, or as `tInc = 1e-6`.
    """
    length, rate, above = 0.0, None, []
    with path.open(newline="", encoding=dialect.encoding) as text:
        for line in itertools.islice(text, LINES):
            cells = dialect.cells(line)
            pairs = [
                *zip(above, cells, strict=False),
                *(cell.split("=") for cell in cells if cell.count("=") == 1),
            ]
            above = cells
            rigol = ("increment", "tinc")
            intervals = [(value, "s") for name, value in pairs if name.strip().lower() in rigol]
            name, value, unit, *_ = (*cells, "", "", "")
            name = name.strip(":").lower()
            if name in ("record length", "memory length", "number of samples", "points"):
                length = dialect.number(value) or length
            elif name in ("sample interval", "sampling period"):
                intervals.append((value, unit if parse_unit(unit) else "s"))
            for value, unit in intervals:
                interval = dialect.number(value)
                if interval is not None:
                    rate = rate_of(interval, 1e-6, unit)
    return length, rate


READER = Reader(
    (".csv", ".txt", ".dat"),
    opened,
    "columns of a table of text, by the line with their names",
    unit="`open [mV]`, or a second line of units",
    rate="a preamble with `Sample Interval` or `Increment`",
    dialect=True,
)
