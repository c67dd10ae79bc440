"""Reader for Excel workbooks (.xlsx); openpyxl reads them row by row.

The first row of a sheet names its columns, and the second may name their units, as in a CSV table.
A column of the first sheet has its own name, a column of another sheet the name `sheet/column`.
"""

import contextlib
import itertools
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np

from etid.files.channel import Contents, by_place, one_unit, spooled, with_unit
from etid.files.readers import Reader
from etid.files.readers.delimited import ROWS, Dialect
from etid.recordings.errors import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Columns of a workbook."""
    import openpyxl

    names: list[str] = []
    places: dict[str, tuple[Any, int, int]] = {}  # sheet, first row of numbers, column
    units: dict[str, str] = {}

    def write(files: Mapping[str, BinaryIO]) -> str:
        for name, file in files.items():
            sheet, first, column = places[name]
            numbers = _numbers(sheet, first, column)
            while (part := np.fromiter(itertools.islice(numbers, ROWS), float)).size:
                file.write(part.data)
            if not file.tell():
                raise RecordingError(f"column {column} has no numbers")
        return ""

    with contextlib.ExitStack() as stack:
        book = openpyxl.load_workbook(
            stack.enter_context(path.open("rb")), read_only=True, data_only=True
        )
        stack.callback(book.close)
        for number, sheet in enumerate(book.worksheets):
            head, second, *_ = *sheet.iter_rows(max_row=2, values_only=True), (), ()
            cells = ["" if cell is None else str(cell) for cell in second]
            below = Dialect().units(cells, len(head))
            titles = ["" if cell is None else str(cell).strip() for cell in head]
            own, units_of = zip(*map(with_unit, titles), strict=True) if titles else ((), ())
            for column, (name, unit, said) in enumerate(
                zip(by_place(own), units_of, below or [""] * len(head), strict=True), 1
            ):
                if name:
                    names.append(f"{sheet.title}/{name}" * bool(number) or name)
                    places[names[-1]] = sheet, 2 + (below is not None), column
                    units[names[-1]] = one_unit(name, unit, said)
        yield stack.enter_context(spooled(names, folder, write, lambda name: {"unit": units[name]}))


def _numbers(sheet: Any, first: int, column: int) -> Iterator[float]:
    """The numbers of a column from the first row of numbers on."""
    cells = sheet.iter_rows(min_row=first, min_col=column, max_col=column, values_only=True)
    for row, (cell,) in enumerate(cells, first):
        if cell is None:  # the column ends; a number below a gap would be in the wrong place
            if any(below is not None for (below,) in cells):
                raise RecordingError(f"row {row} of column {column} is empty")
            return
        if isinstance(cell, bool) or not isinstance(cell, int | float):
            raise RecordingError(f"row {row} of column {column} is {cell!r}, not a number")
        yield float(cell)


READER = Reader(
    (".xlsx",),
    opened,
    "columns of Excel; further sheets `sheet/column`",
    unit="as in a table of text",
    extra="excel",
    package="openpyxl",
)
