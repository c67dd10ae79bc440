"""Files for other programs: tables of fits and identified circuits."""

import csv
import itertools
import json
import os
import pathlib
import re
from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.netlist import circuit_string, netlist
from etid.files.channel import listed
from etid.precision import in_float64
from etid.recordings.errors import RecordingError, located, optional
from etid.recordings.replacing import replace_text, replacing
from etid.recordings.untrusted import attribute, translated
from etid.results.columns import long_form
from etid.results.fit import Fit
from etid.results.fits import Fits
from etid.results.fits_file import SCHEMA, VERSION, columns_in, elements_in
from etid.results.hdf5_table import REMEDY, Table, opened_table

ROWS = 1 << 16  # fits in memory at a time
CIRCUITS = (".cir", ".json")


def export_fits(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    long: bool = False,
    all: bool = False,
) -> None:
    """Write the table of a file of fits for other programs: labels, elements ±, verdicts, notes.

    - `.csv`: one line of column names, such as `r_s [ohm]` and `r_s_stderr [ohm]`, then one line
      per fit. Numbers are in SI units with all digits. An unknown number is `nan`. A text that
      begins as a formula does, with `=`, `+`, `-` or `@`, gets an apostrophe in front of it.
    - `.parquet`: the same columns; their names have no unit. The metadata of a column contain its
      `unit`. The metadata of the file contain `circuit`, `method` and `etid_version`. This format
      needs the extra `parquet`.

    The covariances are not exported. At most 65536 fits are in memory at a time.

    Args:
        source: File of fits.
        target: File to write. An existing file is replaced at the end.
        long: As in `Fits.table`: one line per element.
        all: Write all columns of `Fits.table()`: also the changes of the elements, χ² and other
            columns of quality.

    Raises:
        ValueError: The source is not a file of fits, or the target has another suffix.
        RecordingError: pyarrow is not installed.
    """
    suffix = pathlib.Path(target).suffix.lower()
    if suffix not in TABLES:
        raise ValueError(
            f"{os.fspath(target)}: fits are exported as {' or '.join(TABLES)}, not {suffix!r}"
        )
    with (
        opened_table(source, SCHEMA, VERSION) as table,
        located(os.fspath(target)),
        replacing(target) as partial,
    ):
        names = elements_in(table)
        wanted = ("always", "all") if all else ("always",)
        columns = {
            name: stored
            for name, (column, stored) in columns_in(table, names).items()
            if column.shown in wanted
        }
        units = {name: _units(column, table) for name, column in columns.items()}
        of = {name: units[name] or "1" for name in names}
        parts = _parts(table, columns)
        if long:
            parts = (long_form(part, of) for part in parts)
        about = {name: table.text(name) for name in ("circuit", "method", "etid_version")}
        TABLES[suffix](parts, units, about, partial)


def _units(column: h5py.Dataset, table: Table) -> str | None:
    """Unit of a column; None if it has none."""
    with translated(table.name, field=str(column.name).strip("/")):
        unit = attribute(column, "unit") if "unit" in column.attrs else None
        if not isinstance(unit, str | None):
            raise RecordingError(f"has the unit {unit!r}", remedy=REMEDY)
    return unit


def _parts(table: Table, columns: dict[str, h5py.Dataset]) -> Iterator[dict[str, np.ndarray]]:
    """The columns in parts of `ROWS` rows; one part without rows if there are no fits."""
    for start in range(0, max(1, len(columns["path"])), ROWS):
        rows = slice(start, start + ROWS)
        yield {name: table.read(column, rows) for name, column in columns.items()}


_Part = dict[str, np.ndarray]
_Units = Mapping[str, str | None]


def _csv(parts: Iterator[_Part], units: _Units, about: dict[str, str], path: pathlib.Path) -> None:
    del about
    with path.open("w", newline="", encoding="utf-8") as text:
        lines = csv.writer(text)
        first = next(parts)
        known = [(name, units.get(name)) for name in first]
        lines.writerow(name if unit in (None, "1") else f"{name} [{unit}]" for name, unit in known)
        for part in itertools.chain([first], parts):
            cells = ([_cell(item) for item in column.tolist()] for column in part.values())
            lines.writerows(zip(*cells, strict=True))


def _cell(value: str | float | int) -> str | float | int:
    """Value of a cell; a text that begins as a formula is marked as text.

    A program for spreadsheets would compute a formula, or run it.
    """
    formula = ("=", "+", "-", "@", "\t", "\r")
    return f"'{value}" if isinstance(value, str) and value.startswith(formula) else value


def _parquet(
    parts: Iterator[_Part], units: _Units, about: dict[str, str], path: pathlib.Path
) -> None:
    pyarrow = optional("pyarrow", "parquet")
    parquet = optional("pyarrow.parquet", "parquet", package="pyarrow")
    fields = []
    first = next(parts)
    for name, column in first.items():
        text = column.dtype.kind in "OU"
        kind: Any = pyarrow.string() if text else pyarrow.from_numpy_dtype(column.dtype)
        unit = units.get(name)
        fields.append(pyarrow.field(name, kind, metadata={"unit": unit} if unit else None))
    schema = pyarrow.schema(fields, metadata=about)
    with parquet.ParquetWriter(path, schema) as writer:
        for part in itertools.chain([first], parts):
            writer.write_table(pyarrow.table(part, schema=schema))


TABLES = {".csv": _csv, ".parquet": _parquet}  # writers of tables by suffix


@in_float64
def export_circuit(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    path: str | None = None,
    *,
    circuit: type[AbstractCircuit] | None = None,
) -> None:
    """Write one identified circuit of a file of fits for other programs.

    - `.cir`: a SPICE subcircuit with the nodes `plus` and `minus`. Its name is `load_` and the path
      of the recording, such as `load_s01_dry_03`. See `etid.netlist`.
    - `.json`: a file for `CustomCircuit().load(…)` of impedance.py. The initial guess holds the
      identified values. See `etid.circuit_string`.

    Args:
        source: File of fits.
        target: File to write. An existing file is replaced at the end.
        path: Path of the recording; not needed if the file has only one fit.
        circuit: Class of the circuit, as in `Fits.read`.

    Raises:
        ValueError: The source is not a file of fits, the fit does not exist or cannot be used,
            or the target has another suffix.
    """
    suffix = pathlib.Path(target).suffix.lower()
    if suffix not in CIRCUITS:
        raise ValueError(f"{os.fspath(target)}: a circuit is exported as {' or '.join(CIRCUITS)}")
    fits = Fits.read(source, circuit)
    paths = [str(each) for each in fits.labels["path"]]
    if path is None and len(paths) == 1:
        path = paths[0]
    if path is None or path.strip("/") not in paths:
        said = "say which recording" if path is None else f"there is no fit of {path!r}"
        raise RecordingError(f"{said}; the fits are of {listed(paths)}", file=os.fspath(source))
    index = paths.index(path.strip("/"))
    fit = fits[index]
    if not fit.usable:
        raise ValueError(
            f"{os.fspath(source)}: the fit of {paths[index]!r} is {fit.verdict}, not usable; "
            f"its circuit is not exported. {fits.notes[index]}"
        )
    try:
        text = _written(fit, paths[index], suffix)
    except ValueError as error:  # an element is 0 or not finite
        raise RecordingError(str(error), file=os.fspath(source), path=paths[index]) from error
    replace_text(target, text)


def _written(fit: Fit, path: str, suffix: str) -> str:
    """Text of a circuit in the format of the suffix."""
    if suffix == ".cir":
        name = "load_" + re.sub(r"\W", "_", path, flags=re.ASCII)
        return f"* {path}, by {fit.method}\n{netlist(fit.circuit, name=name)}"
    string, values = circuit_string(fit.circuit)
    content = {
        "Name": f"{path}, by etid",
        "Circuit String": string,
        "Initial Guess": values,
        "Constants": {},
        "Fit": False,  # a fit of impedance.py would contain its own standard errors
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"
