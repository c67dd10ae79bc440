"""Recordings as TimeSeries in a file of Neurodata Without Borders (NWB).

This module needs pynwb, so `etid.files.exporting` imports it only for an export.
"""

import contextlib
import datetime
import hashlib
import io
import os
import pathlib
from collections.abc import Hashable, Iterator, Mapping
from typing import Any

import h5py
import hdmf.common
import numpy as np
import pynwb
from hdmf.data_utils import GenericDataChunkIterator

from etid.recordings import schema
from etid.recordings.fields import DECLARED, SIGNALS
from etid.recordings.hdf5 import read
from etid.recordings.recording import AbstractSource, Layout, RecordingError
from etid.recordings.replacing import replacing

# pynwb declares its arguments with a decorator that hides them from the type checker.
_nwb: Any = pynwb
_tables: Any = hdmf.common


def write_nwb(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    session_start: datetime.datetime,
) -> None:
    """Write a file of recordings as NWB; see `etid.export_study`."""
    with read(source) as study, pathlib.Path(source).open("rb") as content:
        if study.problems:
            raise next(iter(study.problems.values()))
        if not study:
            raise RecordingError(
                "holds no recording", file=study.file, remedy="Name a file with recordings"
            )
        subjects = {study.metadata(path).subject for path in study}
        only = subjects.pop() if len(subjects) == 1 else ""
        file = _nwb.NWBFile(
            session_description="Recordings of an electro-tactile stimulator's output",
            identifier=hashlib.file_digest(content, "sha256").hexdigest(),
            session_start_time=session_start,
            subject=_nwb.file.Subject(subject_id=only) if only else None,
        )
        rows: list[dict[str, Any]] = []
        shared: dict[Hashable, Any] = {}
        for path in study:
            recording = study.source(path)
            series = _series(path, recording, shared)
            for each in series.values():
                if each.name in file.acquisition:
                    raise RecordingError(
                        f"two records would be called {each.name!r}", file=study.file, path=path
                    )
                file.add_acquisition(each)
            rows.append(_row(recording, {name: each.name for name, each in series.items()}))
        columns = [
            _tables.VectorData(name=name, description=text, data=[row[name] for row in rows])
            for name, text in _columns().items()
        ]
        table = _tables.DynamicTable(
            name="recordings", description="One line per recording", columns=columns
        )
        file.add_acquisition(table)
        with (
            replacing(target) as partial,
            _created(partial) as written,
            _nwb.NWBHDF5IO(file=written, mode="w") as output,
        ):
            output.write(file)


@contextlib.contextmanager
def _created(path: pathlib.Path) -> Iterator[h5py.File]:
    """An HDF5 file to write; an error of the disk is raised when HDF5 has closed it."""
    disk = _Disk(path, "xb+")
    try:
        with io.BufferedRandom(disk) as raw, h5py.File(raw, "w") as file:
            yield file
    finally:
        if disk.error is not None:
            raise disk.error


class _Disk(io.FileIO):
    """A file whose first error is kept for the end, and that then loses what is written.

    pynwb leaves objects to the garbage collector. If HDF5 cannot write what belongs to one of them,
    it ends the process with a segmentation fault.
    """

    error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.error = self.error or error
            return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


class _Samples(GenericDataChunkIterator):
    """The stored samples of one record; they are read only while they are written."""

    def __init__(self, source: AbstractSource, record: Layout) -> None:
        self.source, self.record = source, record
        whole = (record.length,)
        super().__init__(buffer_shape=whole, chunk_shape=whole)

    def _get_data(self, selection: tuple[slice, ...]) -> np.ndarray:
        return np.concatenate(list(self.source.blocks(self.record.name)))[selection]

    def _get_maxshape(self) -> tuple[int, ...]:
        return (self.record.length,)

    def _get_dtype(self) -> np.dtype:
        return np.dtype(self.record.dtype)


def _series(path: str, source: AbstractSource, shared: dict[Hashable, Any]) -> dict[str, Any]:
    """TimeSeries of the records of a recording, by name."""
    series = {}
    for record in source.layout:
        key = source.unloaded if record.name == "v_th" else None
        series[record.name] = _nwb.TimeSeries(
            name=f"{path}/{record.name}".replace("/", ".").replace(":", "."),
            description=SIGNALS[record.name].description,
            data=shared[key] if key in shared else _Samples(source, record),
            unit=SIGNALS[record.name].unit,
            conversion=record.conversion,
            offset=record.offset,
            rate=source.metadata.sample_rate,
            starting_time=0.0,
        )
        if key is not None:
            shared.setdefault(key, series[record.name])
    return series


def _columns() -> dict[str, str]:
    """Descriptions of the columns of the table."""
    columns = {"path": "Path in the etid file."}
    for name, field in schema.at("group attribute").items():
        columns[name] = field.description + (f" [{field.unit}]" if field.unit else "")
    return columns | {name: f"TimeSeries: {field.description}" for name, field in SIGNALS.items()}


def _row(source: AbstractSource, series: Mapping[str, str]) -> dict[str, Any]:
    """Line of the table for a recording; paths are text, an unknown number is NaN, a text empty."""
    metadata = source.metadata
    row: dict[str, Any] = {"path": metadata.path, "kind": metadata.kind}
    for name, field in DECLARED.items():
        value = getattr(metadata, name)
        if field.type == "paths":
            value = "\n".join(value)
        elif value is None:
            value = {"range": (np.nan, np.nan), "text": ""}.get(field.type, np.nan)
        row[name] = value
    return row | {name: series.get(name, "") for name in SIGNALS}
