"""Reader for LabVIEW measurement files (.lvm), which are text with a header of their own.

The header says how the numbers are written, the interval between samples, and the names and units
of the channels. The first column may be the time; it must fit the interval, which replaces it.
Files of several segments, each with a header, are refused: each is another record.
"""

import contextlib
import itertools
import pathlib
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np

from etid.files.channel import Contents, by_place, rate_of, spooled
from etid.files.clock import QUARTZ
from etid.files.readers import Reader
from etid.files.readers.delimited import LINES, Dialect, spool
from etid.recordings.recording import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of an lvm file."""
    with path.open(encoding="utf-8-sig", errors="replace") as text:
        lines = [line.rstrip("\r\n") for line in itertools.islice(text, LINES)]
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        raise RecordingError("is not a LabVIEW measurement file: its first line says nothing of it")
    end = "***End_of_Header***"
    ends = [number for number, line in enumerate(lines) if line.strip().startswith(end)]
    if len(ends) < 2 or ends[1] + 2 >= len(lines):
        raise RecordingError(
            f"has no two headers that end with {end}, and numbers below",
            remedy="Write the file with one header per segment",
        )
    said = {key: rest for key, *rest in (line.split("\t") for line in lines[: ends[0]])}
    separators = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}
    separator = separators.get(_first(said, "Separator", "Tab"))
    decimal = _first(said, "Decimal_Separator", ".")
    if separator is None or decimal not in (".", ","):
        raise RecordingError("its header names no separator that etid knows", field="Separator")
    dialect = Dialect(separator, decimal)
    own = {
        key: rest for key, *rest in (line.split(separator) for line in lines[ends[0] + 1 : ends[1]])
    }
    names = by_place([cell.strip() for cell in lines[ends[1] + 1].split(separator)])
    if names[-1] == "Comment":
        names.pop()
    if _first(said, "X_Columns", "One") not in ("No", "One"):
        raise RecordingError(
            "has a column of times for each channel",
            field="X_Columns",
            remedy="Write one time column, or none",
        )
    channels = names[1:]  # the column X_Value exists even if it is empty
    timed = lines[ends[1] + 2].split(separator)[0].strip() != ""
    intervals = {float(cell.replace(decimal, ".")) for cell in own.get("Delta_X", []) if cell}
    if len(intervals) > 1:
        raise RecordingError("has channels with different intervals", field="Delta_X")
    interval = intervals.pop() if intervals else 0.0
    rate = rate_of(interval, 1e-6, _first(own, "X_Unit_Label", "s"))
    units = dict(zip(channels, own.get("Y_Unit_Label", []), strict=False))
    lengths = dict(zip(channels, own.get("Samples", []), strict=False))

    def write(files: Mapping[str, BinaryIO]) -> str:
        columns = {names.index(name): file for name, file in files.items()}
        with tempfile.TemporaryFile(dir=folder) as times:
            if timed and rate:
                columns[0] = times
            _, notice = spool(path, dialect, ends[1] + 2, len(names) + 1, columns)
            if timed and rate:
                _check_times(np.memmap(times, np.float64, "r"), rate)
        return notice

    def about(name: str) -> dict[str, Any]:
        declared = int(lengths.get(name, "").strip() or 0)
        return {"unit": units.get(name, "").strip(), "sample_rate": rate, "declared": declared}

    with spooled(channels, folder, write, about) as contents:
        yield contents


def _check_times(times: np.ndarray, rate: float) -> None:
    """Raise an error if a column of times contradicts the sample rate [Hz].

    Times may be printed with few digits; their smallest step shows with how many. Where LabVIEW
    has appended to a file, they may begin again at 0.
    """
    steps = np.diff(times)
    steps = steps[steps >= 0]
    rounding = 2 * np.min(steps, initial=np.inf, where=steps > 0)
    if abs(steps.sum() - steps.size / rate) > max(rounding, QUARTZ * steps.sum(), 2 / rate):
        raise RecordingError(
            f"is {1 / rate:g} s, but the column of times has steps of {steps.mean():g} s",
            field="Delta_X",
            remedy="Correct the one that is wrong in the file",
        )


def _first(said: dict[str, list[str]], key: str, default: str) -> str:
    return (said.get(key) or [default])[0].strip() or default


READER = Reader(
    (".lvm",), opened, "columns of LabVIEW, one header per file", "`Y_Unit_Label`", "`Delta_X`"
)
