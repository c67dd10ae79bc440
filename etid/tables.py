"""Tables in HDF5: named columns with units, written whole or not at all."""

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    *,
    units: Mapping[str, str],
    attributes: Mapping[str, Any],
) -> None:
    """Write columns to an HDF5 file, replacing it only when everything is on disk.

    Args:
        path: The file.
        columns: Arrays of one length along their first axis; text is stored as UTF-8.
        units: SI units of columns that have one, stored as their attribute `unit`.
        attributes: Attributes of the file.
    """
    target = pathlib.Path(path)
    partial = target.with_name(target.name + ".partial")
    try:
        with h5py.File(partial, "w") as file:
            file.attrs.update(attributes)
            for name, column in columns.items():
                text = np.asarray(column).dtype.kind in "OU"
                data = np.asarray(column, dtype=h5py.string_dtype()) if text else column
                dataset = file.create_dataset(name, data=data)
                if name in units:
                    dataset.attrs["unit"] = units[name]
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def read_table(
    path: str | os.PathLike[str], kind: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read columns and attributes back.

    Args:
        path: The file.
        kind: What its attribute `schema` must say.

    Raises:
        ValueError: The file is missing, no HDF5, or of another kind.
    """
    try:
        with h5py.File(path, "r") as file:
            attributes = dict(file.attrs)
            found = attributes.get("schema")
            if found != kind:
                raise ValueError(f"{path}: attribute schema is {found!r}, not {kind!r}")
            columns = {
                name: item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]
                for name, item in file.items()
            }
    except OSError as error:
        raise ValueError(f"{path}: cannot be read as HDF5 ({error})") from error
    return columns, attributes
