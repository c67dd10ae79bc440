"""Reader for LabVIEW measurement files (.lvm), which are text with a header of their own.

The header says how the numbers are written, the interval between samples, and the names and units
of the channels. The first column may be the time, which the interval replaces. Files of several
segments, each with a header, are refused: each is another record.
"""

import contextlib
import itertools
import pathlib
import tempfile
from collections.abc import Iterable, Iterator
from typing import BinaryIO

import numpy as np

from etid.files.channel import Channel, Contents, rate_of
from etid.files.readers.delimited import Dialect, spool
from etid.recordings.recording import RecordingError

_LINES = 200  # of a header
_END = "***End_of_Header***"
_SEPARATORS = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of an lvm file; `prepare` copies the needed ones to temporary binary files."""
    with path.open(encoding="utf-8-sig", errors="replace") as text:
        lines = [line.rstrip("\r\n") for line in itertools.islice(text, _LINES)]
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        raise RecordingError("is not a LabVIEW measurement file: its first line says nothing of it")
    ends = [number for number, line in enumerate(lines) if line.strip().startswith(_END)]
    if len(ends) < 2 or ends[1] + 2 >= len(lines):
        raise RecordingError(
            f"has no two headers that end with {_END}, and numbers below",
            remedy="Write the file with one header per segment",
        )
    said = {key: rest for key, *rest in (line.split("\t") for line in lines[: ends[0]])}
    separator = _SEPARATORS.get(_first(said, "Separator", "Tab"))
    decimal = _first(said, "Decimal_Separator", ".")
    if separator is None or decimal not in (".", ","):
        raise RecordingError("its header names no separator that etid knows", field="Separator")
    dialect = Dialect(separator, decimal, ends[1] + 2, "utf-8-sig")
    own = {
        key: rest for key, *rest in (line.split(separator) for line in lines[ends[0] + 1 : ends[1]])
    }
    names = [cell.strip() for cell in lines[ends[1] + 1].split(separator)]
    if names[-1] == "Comment":
        names.pop()
    times = {"No": 0, "One": 1}.get(_first(said, "X_Columns", "One"))
    if times is None:
        raise RecordingError(
            "has a column of times for each channel",
            field="X_Columns",
            remedy="Write one time column, or none",
        )
    channels = names[1:]  # the column X_Value exists even if it is empty
    intervals = {float(cell.replace(decimal, ".")) for cell in own.get("Delta_X", []) if cell}
    if len(intervals) > 1:
        raise RecordingError("has channels with different intervals", field="Delta_X")
    interval = intervals.pop() if intervals else 0.0
    units = dict(zip(channels, own.get("Y_Unit_Label", []), strict=False))
    files: dict[str, BinaryIO] = {}
    count = 0
    with contextlib.ExitStack() as stack:

        def prepare(wanted: Iterable[str]) -> None:
            nonlocal count
            for name in wanted:
                files[name] = stack.enter_context(tempfile.TemporaryFile(dir=folder))
            columns = {names.index(name): files[name] for name in files}
            count = spool(path, dialect, ends[1] + 2, columns)

        def channel(name: str) -> Channel:
            def read(_: int, start: int, stop: int) -> np.ndarray:
                files[name].seek(8 * start)
                return np.frombuffer(files[name].read(8 * (stop - start)))

            rate = rate_of(interval, 1e-6) if interval > 0 else None
            unit = units.get(name, "").strip()
            return Channel(name, (count,), np.dtype(np.float64), read, unit, rate)

        yield Contents(tuple(channels), channel, prepare)


def _first(said: dict[str, list[str]], key: str, default: str) -> str:
    return (said.get(key) or [default])[0].strip() or default
