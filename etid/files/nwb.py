"""Recordings in a file of Neurodata Without Borders (NWB), as TimeSeries.

Importing this module needs pynwb; `etid.files.exporting` does it when it is asked to.
"""

import datetime
import hashlib
import os
import pathlib
from collections.abc import Hashable, Mapping
from typing import Any

import hdmf.common
import numpy as np
import pynwb
from hdmf.data_utils import GenericDataChunkIterator

from etid.recordings import schema
from etid.recordings.hdf5 import read
from etid.recordings.recording import LABELS, AbstractSource, Layout, RecordingError
from etid.recordings.replacing import replacing

# How pynwb declares arguments hides them from a type checker.
_nwb: Any = pynwb
_tables: Any = hdmf.common

_LABELS = {
    "path": "path in the etid file",
    "kind": "calibration: a known resistor is the load; loaded: anything else",
    "subject": "who",
    "condition": "which state of the skin, or which circuit",
    "electrode": "which electrode of the display",
    "trial": "which repetition",
    "calibration": "paths of the calibrations that belong to it, a line each",
}
_NUMBERS = {
    "pulse_rate": "stimulation pulses per second [Hz]",
    "r_load": "known resistor [ohm], NaN where the load is unknown",
    "adc_low": "lowest voltage at the terminal that the converter can tell [V], NaN if not known",
    "adc_high": "highest voltage at the terminal that the converter can tell [V]",
}
_SERIES = {
    "v_th": "unloaded output of the driver",
    "v_out": "output of the driver with its load",
    "current": "current through the load",
}


def write_nwb(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    session_start: datetime.datetime,
) -> None:
    """Write a file of recordings as NWB; `etid.export_study` says how."""
    with read(source) as study, pathlib.Path(source).open("rb") as content:
        if study.problems:
            raise next(iter(study.problems.values()))
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
        described = _LABELS | _NUMBERS | {key: f"TimeSeries: {_SERIES[key]}" for key in _SERIES}
        columns = [
            _tables.VectorData(name=name, description=text, data=[row[name] for row in rows])
            for name, text in described.items()
        ]
        table = _tables.DynamicTable(
            name="recordings", description="A line per recording", columns=columns
        )
        file.add_acquisition(table)
        with replacing(target) as partial, _nwb.NWBHDF5IO(partial, "w") as output:
            output.write(file)


class _Samples(GenericDataChunkIterator):
    """The stored samples of one record, read when they are written."""

    def __init__(self, source: AbstractSource, record: Layout):
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
    """The records of a recording."""
    series = {}
    for record in source.layout:
        key = source.unloaded if record.name == "v_th" else None
        series[record.name] = _nwb.TimeSeries(
            name=f"{path}/{record.name}".replace("/", ".").replace(":", "."),
            description=_SERIES[record.name],
            data=shared[key] if key in shared else _Samples(source, record),
            unit=schema.at("dataset")[record.name].unit,
            conversion=record.conversion,
            offset=record.offset,
            rate=source.metadata.sample_rate,
            starting_time=0.0,
        )
        if key is not None:
            shared.setdefault(key, series[record.name])
    return series


def _row(source: AbstractSource, series: Mapping[str, str]) -> dict[str, Any]:
    metadata = source.metadata
    low, high = metadata.adc_range or (np.nan, np.nan)
    return {
        "path": metadata.path,
        "kind": metadata.kind,
        **{name: getattr(metadata, name) for name in LABELS},
        "calibration": "\n".join(metadata.calibration),
        "pulse_rate": metadata.pulse_rate,
        "r_load": np.nan if metadata.r_load is None else metadata.r_load,
        "adc_low": low,
        "adc_high": high,
        **{name: series.get(name, "") for name in _SERIES},
    }
