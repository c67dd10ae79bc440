"""Small tables of names and numbers that people write."""

import csv
import pathlib

from etid.recordings.errors import RecordingError


def rows_of(path: pathlib.Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """The rows of a CSV table, by the names of its first line; spaces around cells do not count.

    Raises:
        RecordingError: A column is missing, or there is no row.
        OSError: As `open`; UnicodeDecodeError: the text is not UTF-8.
    """
    with path.open(encoding="utf-8-sig", newline="") as lines:
        rows = list(csv.DictReader(lines, skipinitialspace=True))
    *most, last = columns
    if not rows or not {*columns} <= rows[0].keys():
        names = f"{', '.join(most)} and {last}"
        raise RecordingError(f"must have the columns {names}, and a row for each {columns[0]}")
    return [{name: str(row[name]).strip() for name in columns} for row in rows]
