"""Tables in HDF5: named columns with units, written whole or not at all."""

import contextlib
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """A name to write to, that becomes the file at the end, if that is reached."""
    target = pathlib.Path(path)
    partial = target.with_suffix(f".partial{target.suffix}")  # some writers go by the suffix
    try:
        yield partial
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


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
    with replacing(path) as partial, h5py.File(partial, "w") as file:
        file.attrs.update(attributes)
        for name, column in columns.items():
            text = np.asarray(column).dtype.kind in "OU"
            data = np.asarray(column, dtype=h5py.string_dtype()) if text else column
            dataset = file.create_dataset(name, data=data)
            if name in units:
                dataset.attrs["unit"] = units[name]


@contextlib.contextmanager
def opened_table(path: str | os.PathLike[str], kind: str) -> Iterator[h5py.File]:
    """A file of columns, none of them read yet.

    Args:
        path: The file.
        kind: What its attribute `schema` must say.

    Raises:
        ValueError: The file is missing, no HDF5, or of another kind.
    """
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise _unreadable(path, error) from error
    with file:
        found = file.attrs.get("schema")
        found = found.decode() if isinstance(found, bytes) else found
        if found != kind:
            raise ValueError(f"{path}: attribute schema is {found!r}, not {kind!r}")
        yield file


def _unreadable(path: str | os.PathLike[str], error: OSError) -> ValueError:
    return ValueError(f"{os.fspath(path)}: cannot be read as HDF5 ({error})")


def read_column(column: h5py.Dataset, rows: Any = ()) -> np.ndarray:
    """Some rows of a column, or all.

    Raises:
        ValueError: The file is damaged.
    """
    try:
        text = h5py.check_string_dtype(column.dtype)
        return np.asarray(column.asstr()[rows] if text else column[rows])
    except OSError as error:
        raise _unreadable(column.file.filename, error) from error


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
    with opened_table(path, kind) as file:
        return {name: read_column(item) for name, item in file.items()}, dict(file.attrs)
