"""A file of fits: its schema, and checks of what is read."""

import dataclasses
import reprlib
from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.lookup import circuit_class
from etid.recordings import limits
from etid.recordings.recording import RecordingError
from etid.recordings.schema import FITS
from etid.results.columns import Column, named
from etid.results.fit import Fit, Limited
from etid.results.hdf5_table import REMEDY, Table, check_same_length
from etid.results.verdicts import usable

SCHEMA = FITS
VERSION = "1.4"


def elements_in(table: Table) -> tuple[str, ...]:
    """Names of the elements of an open file."""
    stored = table.attribute("parameters")
    names = stored if isinstance(stored, list) else [stored]
    if not all(isinstance(name, str) for name in names) or len(names) > limits.NAMES:
        raise RecordingError(
            f"is {reprlib.repr(stored)}, must be names",
            file=table.name,
            field="parameters",
            remedy=REMEDY,
        )
    return tuple(names)


def columns_in(table: Table, elements: Sequence[str]) -> dict[str, tuple[Column, h5py.Dataset]]:
    """The columns of an open file by name; their data are not read.

    Args:
        table: The file.
        elements: Names of the elements.

    Raises:
        RecordingError: A column is missing, or is not what it must be.
    """
    sizes = {"element": len(elements), "moved": len(elements) + 1}
    found = {
        name: (column, table.column(name, column.kind, tuple(sizes[axis] for axis in column.axes)))
        for name, (column, *_) in named(dict.fromkeys(elements, "")).items()
        if not column.needs or column.needs in table
    }
    check_same_length(table, {name: stored for name, (_, stored) in found.items()})
    return found


def fits_of(
    table: Table, circuit: type[AbstractCircuit] | None
) -> tuple[Fit, dict[str, np.ndarray]]:
    """The fits of an open file, and what a table has beside them: labels and notes.

    Raises:
        RecordingError: A column or an attribute is missing or invalid.
    """
    kind = _circuit(table, circuit)
    parts: dict[Column, list[np.ndarray]] = {}
    for column, stored in columns_in(table, kind.names()).values():
        if column.field or column.of is None:
            of = table.read(stored)
            parts.setdefault(column, []).append(of.astype(float) if column.kind == "number" else of)
    fields: dict[str, Any] = {}
    beside: dict[str, np.ndarray] = {}
    for column, read in parts.items():
        try:
            values = column.read(np.stack(read, -1) if column.each else read[0])
        except KeyError as error:
            raise RecordingError(
                f"{error} is not a verdict or a remark of this version of etid",
                file=table.name,
                field=column.name,
                remedy="Read it with the etid that wrote it",
            ) from None
        if column.field:
            fields[column.field] = values
        else:
            beside[column.name] = values
    names = [field.name for field in dataclasses.fields(Limited)]
    bounds = {name: fields.pop(name) for name in names if name in fields}
    fields["limits"] = Limited(**bounds) if bounds else None
    fields["circuit"] = kind.of_fit(fields["circuit"].T)
    fit = Fit(method=table.text("method"), **fields)
    # Steiglitz-McBride may give others negative elements, and an element without effect may be 0.
    good = usable(fit.result)
    for name in kind.names():
        value = getattr(fit.circuit, name)
        wrong = good & ~(value > 0.0)
        if wrong.any():
            raise RecordingError(
                f"{value[wrong][0]:g} is no value of an element: a usable fit has positive ones",
                file=table.name,
                field=name,
                remedy="The file is damaged: copy it again, or fit the recordings again",
            )
    return fit, beside


def _circuit(table: Table, given: type[AbstractCircuit] | None) -> type[AbstractCircuit]:
    """The class of the circuits in a file. The file cannot make etid import a module."""
    stored = table.text("circuit")
    try:
        kind = circuit_class(stored, given)
    except LookupError as error:
        raise RecordingError(
            f"is {reprlib.repr(stored)}", file=table.name, field="circuit", remedy=str(error)
        ) from None
    names = elements_in(table)
    if names != kind.names():
        raise RecordingError(
            f"is {reprlib.repr(names)}, but {kind.__name__} has {', '.join(kind.names())}",
            file=table.name,
            field="parameters",
            remedy="Pass the class as it was when the fits were made, or fit the recordings again",
        )
    return kind
