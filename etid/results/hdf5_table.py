"""Tables in HDF5: named columns with units, written completely or not at all."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np

from etid.printing import several
from etid.recordings import limits
from etid.recordings.errors import RecordingError
from etid.recordings.replacing import check_ending, replacing_hdf5
from etid.recordings.schema import NAME, version_problem
from etid.recordings.untrusted import (
    attribute,
    check_size,
    guarded,
    local_link,
    translated,
)

REMEDY = "Fit the recordings again"


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    *,
    units: Mapping[str, str],
    attributes: Mapping[str, Any],
) -> None:
    """Write columns to an HDF5 file. An old file is replaced only when all data are on disk.

    Args:
        path: The file.
        columns: Arrays of equal length along their first axis. Text is stored as UTF-8.
        units: SI units of the columns that have one. They are stored as attribute `unit`.
        attributes: Attributes of the file.

    Raises:
        RecordingError: The name of the file says another format.
    """
    check_ending(path)
    with replacing_hdf5(path) as file:
        file.attrs.update(attributes)
        for name, column in columns.items():
            text = np.asarray(column).dtype.kind in "OU"
            data = np.asarray(column, dtype=h5py.string_dtype()) if text else column
            dataset = file.create_dataset(name, data=data)
            if name in units:
                dataset.attrs["unit"] = units[name]


class Table:
    """An open file of columns; a column is read on request.

    Every fault of the file is one error. It names the file, the column or attribute, and the
    remedy.
    """

    def __init__(self, file: h5py.File, name: str) -> None:
        self.file = file
        self.name = name

    def text(self, name: str) -> str:
        """An attribute that is text.

        Raises:
            RecordingError: The attribute is missing or is not text.
        """
        value = self.attribute(name)
        if not isinstance(value, str):
            raise RecordingError(
                f"is {value!r}, must be text", file=self.name, field=name, remedy=REMEDY
            )
        return value

    def attribute(self, name: str) -> Any:
        """An attribute as a Python value: a number, text, or a list of these.

        Raises:
            RecordingError: The attribute is missing, cannot be read, or has another type.
        """
        with translated(self.name, field=name):
            if name not in self.file.attrs:
                raise RecordingError("is missing", remedy=REMEDY)
            value = np.asarray(attribute(self.file, name))
            if value.dtype.kind not in "biufSUO":
                raise RecordingError(f"has dtype {value.dtype}", remedy=REMEDY)
            plain = value.tolist()
            items = plain if isinstance(plain, list) else [plain]
            items = [item.decode("utf-8") if isinstance(item, bytes) else item for item in items]
            if not all(isinstance(item, str | int | float) for item in items):
                raise RecordingError(f"is {plain!r}, must be numbers or texts", remedy=REMEDY)
        return items if isinstance(plain, list) else items[0]

    @property
    def attributes(self) -> set[str]:
        """Names of the attributes."""
        with translated(self.name):
            return set(self.file.attrs)

    def __contains__(self, name: str) -> bool:
        with translated(self.name, field=name):
            return name in self.file

    def column(self, name: str, kind: str, shape: tuple[int, ...] = ()) -> h5py.Dataset:
        """A column whose header is valid; its data are not read.

        Args:
            name: Name of the column.
            kind: `text`, `number` or `integer`.
            shape: Sizes of its dimensions after the first.

        Raises:
            RecordingError: The column is missing, has another kind or shape, or is too large.
        """
        with translated(self.name, field=name):
            if name not in self.file:
                raise RecordingError("the column is missing", remedy=REMEDY)
            local_link(self.file, name)
            column = self.file[name]
            if not isinstance(column, h5py.Dataset):
                raise RecordingError("is not a column", remedy=REMEDY)
            if column.shape is None or column.ndim != 1 + len(shape) or column.shape[1:] != shape:
                wanted = ", ".join(["fit", *map(str, shape)])
                raise RecordingError(f"has shape {column.shape}, must be ({wanted})", remedy=REMEDY)
            if column.shape[0] > limits.FITS:
                raise RecordingError(f"has {column.shape[0]} rows, at most {limits.FITS} are read")
            text = h5py.check_string_dtype(column.dtype)
            fits = {
                "text": text is not None,
                "number": column.dtype.kind in "iuf" and column.dtype.itemsize <= 8,
                "integer": column.dtype.kind in "iu",
            }
            if not fits[kind]:
                what = f"of type {column.dtype}" if text is None else "text"
                raise RecordingError(f"is {what}, must be {kind}", remedy=REMEDY)
            check_size(column)
        return column

    def read(self, column: h5py.Dataset, rows: Any = ()) -> np.ndarray:
        """Some or all rows of a column.

        A number may be as large as it likes: a fit that did not converge may hold any.

        Raises:
            RecordingError: The file is damaged.
        """
        with translated(self.name, field=str(column.name).strip("/")):
            if h5py.check_string_dtype(column.dtype):
                return np.asarray(column.asstr()[rows])
            return np.asarray(column[rows])


@contextlib.contextmanager
def opened_table(path: str | os.PathLike[str], kind: str, version: str) -> Iterator[Table]:
    """Open a file of columns.

    Args:
        path: The file.
        kind: Value that the attribute `schema` must have.
        version: Version of this schema that the reader knows.

    Raises:
        RecordingError: The file is missing, is not HDF5, or has another schema or version.
    """
    name = os.fspath(path)
    with guarded(name) as file:
        table = Table(file, name)
        schema = table.attribute("schema") if "schema" in table.attributes else None
        if schema != kind:
            recordings = schema == NAME
            raise RecordingError(
                f"is {schema!r}, not {kind!r}",
                file=name,
                field="schema",
                remedy="This is a file of recordings: run etid fit first, and name the file of fits"
                if recordings
                else "Name another file",
            )
        problem = version_problem(table.text("schema_version"), version)
        if problem:
            raise RecordingError(problem, file=name, field="schema_version", remedy=REMEDY)
        yield table


def check_same_length(table: Table, columns: Mapping[str, np.ndarray | h5py.Dataset]) -> None:
    """Raise RecordingError unless these columns have the same number of rows."""
    sizes = {name: column.shape[0] for name, column in columns.items()}
    first = next(iter(sizes.values()), 0)
    for name, size in sizes.items():
        if size != first:
            raise RecordingError(
                f"has {several(size, 'row')}, {next(iter(sizes))} has {first}",
                file=table.name,
                field=name,
                remedy=REMEDY,
            )
