"""Writing of recordings to an HDF5 file that follows the schema."""

import dataclasses
import os
from collections.abc import Hashable, Mapping
from typing import Any

import h5py
import numpy as np

from etid.recordings import schema
from etid.recordings.recording import AbstractSource, RecordingError
from etid.recordings.replacing import check_ending, replacing_hdf5


def write(sources: Mapping[str, AbstractSource], path: str | os.PathLike[str]) -> None:
    """Write recordings to a file; see `Study.write`.

    Only one block of a recording is in memory at a time; its source chooses the size of a block.
    """
    check_ending(path)
    for own, source in sources.items():
        for calibration in source.metadata.calibration:
            if calibration not in sources or sources[calibration].metadata.kind != "calibration":
                raise RecordingError(
                    f"{calibration!r} is not a calibration of the study",
                    path=own,
                    field="calibration",
                    remedy="Add that calibration, or remove its path with recording.replace",
                )
    # v108 has checksums for everything except samples, and allows the labels of large stacks
    libver = ("v108", "latest")
    with replacing_hdf5(path, libver=libver) as file:
        _write_attribute(file, "schema", schema.NAME)
        _write_attribute(file, "schema_version", schema.VERSION)
        for group, members in _stacks(sources).items():
            _write_group(file, group, [sources[member] for member in members])


def _stacks(sources: Mapping[str, AbstractSource]) -> dict[str, list[str]]:
    """Paths of the recordings of each group of the file."""
    below: dict[str, int] = {}  # number of recordings below each path
    children: dict[str, list[str]] = {}
    for path in sources:
        children.setdefault(path.rpartition("/")[0], []).append(path)
        outer = path
        while outer := outer.rpartition("/")[0]:
            below[outer] = below.get(outer, 0) + 1
    groups: dict[str, list[str]] = {}
    for parent, paths in children.items():
        rows = [f"{parent}/{row}" for row in range(len(paths))]
        whole = parent and len(paths) > 1 and below[parent] == len(paths)
        if whole and set(rows) == set(paths) and _alike([sources[row] for row in rows]):
            groups[parent] = rows
        else:
            groups.update({path: [path] for path in paths})
    return groups


def _alike(sources: list[AbstractSource]) -> bool:
    def common(source: AbstractSource) -> Hashable:
        return dataclasses.replace(source.metadata, path="", trial=""), source.layout

    first = common(sources[0])
    loaded = sources[0].metadata.kind == "loaded"
    return loaded and all(common(source) == first for source in sources[1:])


def _write_group(file: h5py.File, path: str, sources: list[AbstractSource]) -> None:
    stacked = len(sources) > 1
    once = stacked and len({source.unloaded for source in sources}) == 1
    group = file.create_group(path)
    labels = vars(sources[0].metadata) | {"kind": sources[0].metadata.kind}
    labels["trial"] = [source.metadata.trial for source in sources] if stacked else labels["trial"]
    for name in schema.at("group attribute"):
        value = labels[name]
        if value not in (None, "", ()) and any(item != "" for item in np.ravel(value)):
            _write_attribute(group, name, value)
    datasets: dict[str, h5py.Dataset] = {}
    for row, source in enumerate(sources):
        for record in source.layout:
            single = not stacked or (once and record.name == "v_th")
            if row == 0:
                shape = (record.length,) if single else (len(sources), record.length)
                dataset = group.create_dataset(record.name, shape, record.dtype)
                unit = schema.at("dataset")[record.name].unit
                scale = {"conversion": record.conversion, "offset": record.offset}
                for attribute, value in {"unit": unit, **scale}.items():
                    _write_attribute(dataset, attribute, value)
                datasets[record.name] = dataset
            if row == 0 or not single:
                start = 0
                for block in source.blocks(record.name):
                    part = slice(start, start + block.size)
                    datasets[record.name][part if single else (row, part)] = block
                    start += block.size


def _write_attribute(owner: h5py.Group | h5py.Dataset, name: str, value: Any) -> None:
    """Write a number or text, or a list of them, as an attribute.

    Text has a fixed length. The library would store text of variable length in a heap without a
    checksum, and read it through pointers; one damaged byte could then crash the process.
    """
    items = np.ravel(value)
    if not isinstance(items[0], str):
        owner.attrs[name] = value
        return
    encoded = [item.encode("utf-8") for item in items]
    dtype = h5py.string_dtype("utf-8", max(1, *map(len, encoded)))
    data = np.array(encoded, dtype)
    owner.attrs.create(name, data[0] if isinstance(value, str) else data, dtype=dtype)
