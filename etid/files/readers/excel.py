"""Reader for Excel workbooks (.xlsx); openpyxl reads them row by row.

The first row of a sheet names its columns, as in a CSV table. A column of the first sheet has its
own name, a column of another sheet the name `sheet/column`.
"""

import contextlib
import pathlib
import tempfile
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import numpy as np

from etid.files.channel import Channel, Contents, spooled_channel, with_unit
from etid.files.readers.delimited import ROWS
from etid.recordings.errors import RecordingError, optional


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Columns of a workbook; `prepare` copies the needed ones to temporary binary files."""
    openpyxl = optional("openpyxl", "excel", str(path))
    with contextlib.ExitStack() as stack:
        book = openpyxl.load_workbook(
            stack.enter_context(path.open("rb")), read_only=True, data_only=True
        )
        stack.callback(book.close)
        names: list[str] = []  # several columns may have one name
        places: dict[str, tuple[Any, int, str]] = {}
        for number, sheet in enumerate(book.worksheets):
            head = next(sheet.iter_rows(max_row=1, values_only=True), ())
            for column, cell in enumerate(head):
                if cell is not None:
                    name, unit = with_unit(str(cell).strip())
                    names.append(f"{sheet.title}/{name}" * bool(number) or name)
                    places[names[-1]] = sheet, column, unit
        files: dict[str, BinaryIO] = {}
        counts: dict[str, int] = {}

        def prepare(wanted: Iterable[str]) -> None:
            for name in wanted:
                files[name] = stack.enter_context(tempfile.TemporaryFile(dir=folder))
                counts[name] = _spool(*places[name][:2], files[name])

        def channel(name: str) -> Channel:
            return spooled_channel(name, files[name], counts[name], unit=places[name][2])

        yield Contents(tuple(names), channel, prepare)


def _spool(sheet: Any, column: int, file: BinaryIO) -> int:
    """Write a column below its name to a file as real numbers, and return their number."""
    part: list[float] = []
    count = 0
    cells = sheet.iter_rows(min_row=2, min_col=column + 1, max_col=column + 1, values_only=True)
    for row, (cell,) in enumerate(cells, 2):
        if cell is None:  # the column ends; a number below a gap would be in the wrong place
            if any(below is not None for (below,) in cells):
                raise RecordingError(f"row {row} of column {column + 1} is empty")
            break
        if isinstance(cell, bool) or not isinstance(cell, int | float):
            raise RecordingError(f"row {row} of column {column + 1} is {cell!r}, not a number")
        part.append(float(cell))
        if len(part) == ROWS:
            file.write(np.array(part).data)
            count, part = count + ROWS, []
    file.write(np.array(part).data)
    if not count + len(part):
        raise RecordingError(f"column {column + 1} has no numbers")
    return count + len(part)
