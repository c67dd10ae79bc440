"""Reader for Excel workbooks (.xlsx); openpyxl reads them row by row.

The first row of a sheet names its columns, as in a CSV table. A column of the first sheet has its
own name, a column of another sheet the name `sheet/column`.
"""

import contextlib
import itertools
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np

from etid.files.channel import Contents, spooled, with_unit
from etid.files.readers.delimited import ROWS
from etid.recordings.errors import RecordingError, optional


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Columns of a workbook."""
    openpyxl = optional("openpyxl", "excel", str(path))
    names: list[str] = []  # several columns may have one name
    places: dict[str, tuple[Any, int, str]] = {}

    def write(files: Mapping[str, BinaryIO]) -> str:
        for name, file in files.items():
            sheet, column, _ = places[name]
            numbers = _numbers(sheet, column)
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
            head = next(sheet.iter_rows(max_row=1, values_only=True), ())
            for column, cell in enumerate(head, 1):
                if cell is not None:
                    name, unit = with_unit(str(cell).strip())
                    names.append(f"{sheet.title}/{name}" * bool(number) or name)
                    places[names[-1]] = sheet, column, unit
        yield stack.enter_context(
            spooled(names, folder, write, lambda name: {"unit": places[name][2]})
        )


def _numbers(sheet: Any, column: int) -> Iterator[float]:
    """The numbers of a column below its name."""
    cells = sheet.iter_rows(min_row=2, min_col=column, max_col=column, values_only=True)
    for row, (cell,) in enumerate(cells, 2):
        if cell is None:  # the column ends; a number below a gap would be in the wrong place
            if any(below is not None for (below,) in cells):
                raise RecordingError(f"row {row} of column {column} is empty")
            return
        if isinstance(cell, bool) or not isinstance(cell, int | float):
            raise RecordingError(f"row {row} of column {column} is {cell!r}, not a number")
        yield float(cell)
