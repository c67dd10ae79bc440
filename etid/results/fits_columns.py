"""Columns of a file of fits: what describes each recording, and checks of what is read."""

import dataclasses
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.lookup import circuit_class
from etid.recordings.fields import DESCRIBING
from etid.recordings.recording import RecordingError
from etid.recordings.remarks import remarks_of
from etid.recordings.schema import FITS
from etid.results.fit import Limited
from etid.results.hdf5_table import Table, check_same_length
from etid.results.verdicts import USABLE, verdicts_of

SCHEMA = FITS
VERSION = "1.4"
# Columns that describe each recording: its path, its labels, and numbers.
DESCRIBED = {"path": "text"} | {
    name: "text" if field.type == "label" else "number" for name, field in DESCRIBING.items()
}
LIMITS = tuple(field.name for field in dataclasses.fields(Limited))
LABELS = tuple(name for name, kind in DESCRIBED.items() if kind == "text")


def described(recordings: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """The columns of `Fits.labels`.

    Args:
        recordings: Fields of each recording by name. A missing label becomes empty, a missing
            number NaN.
    """
    columns = {name: [one.get(name) for one in recordings] for name in DESCRIBED}
    return {
        name: np.array([value or "" for value in column], str)
        if DESCRIBED[name] == "text"
        else np.array(column, float)
        for name, column in columns.items()
    }


def long_form(columns: Mapping[str, np.ndarray], units: Mapping[str, str]) -> dict[str, np.ndarray]:
    """A table of fits with one row per element: `element`, `unit`, `value`, `stderr`, `change`.

    Args:
        columns: The columns of `Fits.table()`, with or without the changes of the elements. Those
            that are not of an element stay.
        units: Units of the elements.
    """
    parts = {"value": "", "stderr": "_stderr", "change": "_change"}
    own = {part: [name + end for name in units] for part, end in parts.items()}
    rest = columns.keys() - {name for names in own.values() for name in names}
    count = len(columns["path"])
    return {
        **{name: np.repeat(of, len(units)) for name, of in columns.items() if name in rest},
        "element": np.tile(list(units), count),
        "unit": np.tile(list(units.values()), count),
        **{
            part: np.stack([columns[name] for name in names], axis=1).ravel()
            for part, names in own.items()
            if columns.keys() >= {*names}
        },
    }


def columns_of(
    table: Table, circuit: type[AbstractCircuit] | None
) -> tuple[type[AbstractCircuit], dict[str, Any], dict[str, np.ndarray], np.ndarray]:
    """The class of the circuits, the elements and the other fields of a `Fit`, labels and notes.

    Raises:
        RecordingError: A column or an attribute is missing or invalid.
    """
    kind = _circuit(table, circuit)
    size = len(kind.names())
    kinds = DESCRIBED | {"verdict": "text", "remarks": "text", "note": "text"}
    columns = {name: table.column(name, kind) for name, kind in kinds.items()}
    changes = [f"{name}_change" for name in (*kind.names(), "amplitude")]
    single = (*kind.names(), "rrse", "chi2", *changes)
    columns |= {name: table.column(name, "number") for name in single}
    columns["steps"] = table.column("steps", "integer")
    for name in ("cov", "shared_cov"):
        columns[name] = table.column(name, "number", (size, size))
    columns["change_stderr"] = table.column("change_stderr", "number", (size + 1,))
    if "outside" in table:  # only for fits with bounds
        columns |= {name: table.column(name, "number", (size,)) for name in LIMITS}
    check_same_length(table, columns)
    read = {name: table.read(column) for name, column in columns.items()}
    numbers = (*single, "cov", "shared_cov", "change_stderr")
    real = {name: read[name].astype(float) for name in numbers}
    # Steiglitz-McBride may give others negative elements, and an element without effect may be 0.
    usable = np.isin(read["verdict"], USABLE)
    for name in kind.names():
        wrong = usable & ~(real[name] > 0.0)
        if wrong.any():
            raise RecordingError(
                f"{real[name][wrong][0]:g} is no value of an element: a usable fit has "
                "positive ones",
                file=table.name,
                field=name,
                remedy="The file is damaged: copy it again, or fit the recordings again",
            )
    real["change"] = np.stack([real.pop(name) for name in changes], axis=1)
    fields = real | {
        "result": _read(verdicts_of, table, "verdict", read["verdict"]),
        "steps": read["steps"],
        "method": table.text("method"),
        "remarks": _read(np.vectorize(remarks_of, otypes=[int]), table, "remarks", read["remarks"]),
    }
    if "outside" in read:
        fields["limits"] = Limited(**{name: read[name].astype(float) for name in LIMITS})
    labels = {name: read[name] for name in DESCRIBED}
    return kind, fields, labels, read["note"]


def _circuit(table: Table, given: type[AbstractCircuit] | None) -> type[AbstractCircuit]:
    """The class of the circuits in a file. The file cannot make etid import a module."""
    stored = table.text("circuit")
    try:
        kind = circuit_class(stored, given)
    except LookupError as error:
        raise RecordingError(
            f"is {reprlib.repr(stored)}", file=table.name, field="circuit", remedy=str(error)
        ) from None
    parameters = table.attribute("parameters")
    names = parameters if isinstance(parameters, list) else [parameters]
    if tuple(names) != kind.names():
        raise RecordingError(
            f"is {reprlib.repr(names)}, but {kind.__name__} has {', '.join(kind.names())}",
            file=table.name,
            field="parameters",
            remedy="Pass the class as it was when the fits were made, or fit the recordings again",
        )
    return kind


def _read(of: Callable[[np.ndarray], Any], table: Table, field: str, words: np.ndarray) -> Any:
    """Verdicts or remarks of these words."""
    try:
        return of(words)
    except KeyError as error:
        raise RecordingError(
            f"{error} is not a verdict or a remark of this version of etid",
            file=table.name,
            field=field,
            remedy="Read it with the etid that wrote it",
        ) from None
