"""Reader for tables of text with a header line, in one pass and in bounded memory.

A table has commas between its cells, points in its numbers, and its names in the first line, unless
the user says otherwise. A table that looks different is refused; the error says what to confirm.

A column `open [mV]` or `open (mV)` has the name `open` and the unit mV. Oscilloscopes write the
units into a second line instead, such as `(ms),(mV),(mV)`. This line contains no number.
"""

import codecs
import contextlib
import csv
import dataclasses
import itertools
import pathlib
import re
import tempfile
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO, TextIO

import numpy as np

from etid.files.channel import Channel, Contents
from etid.files.units import parse_unit
from etid.recordings.recording import RecordingError

_SEEN = 1 << 16  # [bytes] start of a table that is looked at before it is read
_LINES = 200  # lines in which the first row of numbers is searched
ROWS = 1 << 16  # rows of text in memory at a time

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]")


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How a table is written.

    Attributes:
        delimiter: Character between the cells.
        decimal: Decimal sign of the numbers: `.` or `,`.
        header_line: Line with the names of the columns, counted from 1; lines above are skipped.
        encoding: Encoding of the text.
    """

    delimiter: str = ","
    decimal: str = "."
    header_line: int = 1
    encoding: str = "utf-8-sig"

    def __post_init__(self) -> None:
        if len(self.delimiter) != 1 or self.decimal not in (".", ",") or self.header_line < 1:
            raise RecordingError(f"the table cannot be written as {self}")

    def cells(self, line: str) -> list[str]:
        """Cells of a line."""
        row = next(csv.reader([line], delimiter=self.delimiter), [])
        return [cell.strip() for cell in row]

    def is_number(self, cell: str) -> bool:
        """Whether a cell is a number with this decimal sign."""
        try:
            float(cell.replace(self.decimal, "."))
        except ValueError:
            return False
        return self.decimal == "." or "." not in cell


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
        + f" and the columns {', '.join(found.cells(lines[found.header_line - 1]))}",
        remedy=f"Nothing is guessed: if this is right, add {flags}",
    )


def _guessed(lines: list[str], encoding: str) -> Dialect | None:
    """The dialect in which a table has rows of numbers; None if no dialect has them."""
    for delimiter, decimal in (",.", ";.", ";,", "\t.", "\t,"):
        dialect = Dialect(delimiter, decimal, encoding=encoding)
        for number in range(1, len(lines) - 1):
            rows = [dialect.cells(line) for line in lines[number : number + 2]]
            width = len(rows[0])
            if width < 2 or not all(len(row) == width and all(map(dialect.is_number, row))
                                    for row in rows):  # fmt: skip
                continue
            above = [cell.strip("()[] ") for cell in dialect.cells(lines[number - 1])]
            units = any(above) and all(not cell or parse_unit(cell) for cell in above)
            header = max(1, number - units)
            if all(map(dialect.is_number, dialect.cells(lines[header - 1]))):
                return None  # no names: the reader of the header says so
            return dataclasses.replace(dialect, header_line=header)
    return None


def _header(text: TextIO, dialect: Dialect) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units, and the number of lines above the numbers."""
    skipped = dialect.header_line - 1
    for _ in range(skipped):
        text.readline()
    cells = dialect.cells(text.readline())
    if cells and all(dialect.is_number(cell) for cell in cells):
        raise RecordingError(
            "the first line holds numbers", remedy="The first line must name the columns"
        )
    both = [with_unit(cell) for cell in cells]
    names, units = [name for name, _ in both], [unit for _, unit in both]
    below = [cell.strip("()[] ") for cell in dialect.cells(text.readline())]
    if len(below) != len(names) or not any(below) or any(map(dialect.is_number, below)):
        return tuple(names), tuple(units), skipped + 1
    if any(cell and not parse_unit(cell) for cell in below):
        return (
            tuple(names),
            tuple(units),
            skipped + 1,
        )  # not units: the parser of the numbers will raise the error
    both = zip(units, below, strict=True)
    return tuple(names), tuple(above or unit for above, unit in both), skipped + 2


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
