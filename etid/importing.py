"""Other formats into the schema: npz recordings, CSV tables, MATLAB files.

Nothing is guessed: the caller says which column or variable is which signal, what its scale is and
how it was sampled; where a name does not exist, the error lists those that do.
"""

import contextlib
import csv
import os
import pathlib
import zipfile
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from etid.recording import Recording, RecordingError, Samples
from etid.scan import LIBRARY_ERRORS
from etid.study import Study

_READ_ERRORS = (*LIBRARY_ERRORS, EOFError, zipfile.BadZipFile, zlib.error, csv.Error)

# Largest distance of a time stamp from a uniform grid, in sample periods: more than the rounding of
# a printed time, less than a lost or doubled sample (1).
_TIME_TOLERANCE = 0.25

# A matrix with more trials than samples, each a small part of a pulse period, lies on its side.
_SHORTEST_STACKED = 0.1


def import_file(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    v_th: str | None = None,
    v_out: str | None = None,
    current: str | None = None,
    time: str | None = None,
    sample_rate: float | int | None = None,
    pulse_rate: float | int | None = None,
    scale: float | int | None = None,
    r_load: float | int | None = None,
    subject: str = "",
    condition: str = "",
) -> None:
    """Turn a file of another format into an etid file.

    - `.npz`: `adc_th`, `adc_out` (trial, time) and `adc_ref` (resistor, time) converter codes with
      `R_ref`, `fs`, `f0`, `lsb` and `scale`.  The file says everything itself; only `subject` and
      `condition` (default: the file's name) may be given.  It becomes `calibration/0`, … and
      `loaded/0`, …; as it has no unloaded record for its calibrations, they share `adc_th[0]`.
    - `.csv`: comma-separated columns with a header line, one trial.
    - `.mat`: variables of shape (time,) or (trial, time), `a.b` for field b of structure a.
      MATLAB's 5 and 7.3 files need `pip install etid[matlab]`.

    The trials of a CSV or MATLAB file become `loaded/0`, … or, with `r_load`, `calibration/0`, ….

    Args:
        source: The file to import; its suffix says what it is.
        target: The etid file to write; one that exists is replaced.
        v_th: Column or variable of the unloaded output.
        v_out: Column or variable of the output with the load.
        current: Column or variable of the current, in ampere; optional.
        time: Column or variable of the time [s], instead of `sample_rate`.
        sample_rate: Samples per second [Hz].
        pulse_rate: Stimulation pulses per second [Hz].
        scale: Volts at the terminal are the value divided by this; 1 if the values are volts.
        r_load: Known resistor [ohm], for calibrations.
        subject: Who.
        condition: Which state of the skin, or which circuit.

    Raises:
        RecordingError: The file cannot be read, or a name or a number is missing or wrong.
    """
    path = pathlib.Path(os.fspath(source))
    file = str(path)
    if not path.is_file():
        raise RecordingError("there is no such file", file=file, remedy="Check the path")
    names = {"v_th": v_th, "v_out": v_out, "current": current, "time": time}
    numbers = {"sample_rate": sample_rate, "pulse_rate": pulse_rate, "scale": scale}
    if path.suffix == ".npz":
        given = {**names, **numbers, "r_load": r_load}
        for name, value in given.items():
            if value is not None:
                raise RecordingError(
                    "an npz file of recordings says this itself",
                    file=file,
                    field=name,
                    remedy="Leave the argument out",
                )
        recordings = _from_npz(path, subject, condition or path.stem)
    elif path.suffix in (".csv", ".mat"):
        for name in ("v_th", "v_out", "pulse_rate", "scale"):
            if {**names, **numbers}[name] is None:
                hint = "; 1 if the values are volts at the terminal" if name == "scale" else ""
                raise RecordingError(
                    "is not given, and is not guessed",
                    file=file,
                    field=name,
                    remedy=f"Give {name}, on the command line --{name.replace('_', '-')}{hint}",
                )
        if (time is None) == (sample_rate is None):
            raise RecordingError(
                "one of time and sample_rate is needed, not both",
                file=file,
                field="sample_rate",
                remedy="Pass the rate, or the name of the times",
            )
        wanted = {field: name for field, name in names.items() if name is not None}
        columns = (_from_csv if path.suffix == ".csv" else _from_mat)(path, wanted)
        with _located(file):
            recordings = _recordings(columns, wanted, numbers, r_load, subject, condition)
    else:
        raise RecordingError(
            f"a file {path.suffix!r} cannot be imported",
            file=file,
            remedy="Export it as .csv, .mat or .npz, or write the schema with h5py",
        )
    Study.from_recordings(recordings).write(target)


@contextlib.contextmanager
def _located(file: str, field: str = "") -> Iterator[None]:
    """Errors of this file, whoever finds them."""
    try:
        yield
    except RecordingError as error:
        raise error.located(file=file, field=field) from None
    except _READ_ERRORS as error:
        raise RecordingError(
            f"cannot be read ({type(error).__name__}: {error})", file=file, field=field
        ) from error


def _chosen(available: dict[str, Any], name: str, field: str) -> Any:
    """The column or variable of that name, or an error that lists the names."""
    if name not in available:
        names = ", ".join(map(repr, available)) or "none"
        raise RecordingError(
            f"there is no {name!r}; the names are {names}",
            field=field,
            remedy=f"Pass {field}= one of them",
        )
    return available[name]


def _from_npz(path: pathlib.Path, subject: str, condition: str) -> list[Recording]:
    with _located(str(path)):
        if not zipfile.is_zipfile(path):
            raise RecordingError("is not an npz file")
        with np.load(path, allow_pickle=False) as archive:
            keys = ("adc_th", "adc_out", "adc_ref", "R_ref", "fs", "f0", "lsb", "scale")
            shapes: dict[str, Any] = {key: None for key in archive.files}
            held = {key: archive[key] for key in keys if _chosen(shapes, key, key) is None}
        th, out, ref, known = (held[key] for key in ("adc_th", "adc_out", "adc_ref", "R_ref"))
        if th.ndim != 2 or th.shape != out.shape or ref.ndim != 2 or known.shape != ref.shape[:1]:
            found = ", ".join(f"{key} {held[key].shape}" for key in keys[:4])
            raise RecordingError(
                f"shapes do not fit each other: {found}",
                remedy="adc_th and adc_out are (trial, time), adc_ref (resistor, time), "
                "R_ref (resistor,)",
            )
        for key in ("adc_th", "adc_out", "adc_ref"):
            if held[key].dtype.kind not in "iu" or held[key].dtype != th.dtype:
                raise RecordingError(
                    f"has dtype {held[key].dtype}, must hold integer codes like the others",
                    field=key,
                )
        rate, pulses, step, scale = (_number(held[key], key) for key in keys[4:])
        if scale == 0:
            raise RecordingError("is 0", field="scale")
        conversion = step / scale
        limits = np.iinfo(th.dtype)
        common: dict[str, Any] = {
            "sample_rate": rate,
            "pulse_rate": pulses,
            "subject": subject,
            "condition": condition,
            "adc_range": (limits.min * conversion, limits.max * conversion),
        }
        first = Samples(th[0], conversion)
        calibrations = [
            Recording(
                first,
                Samples(codes, conversion),
                r_load=known[index],
                path=f"calibration/{index}",
                **common,
            )
            for index, codes in enumerate(ref)
        ]
        paths = tuple(recording.path for recording in calibrations)
        loaded = [
            Recording(
                Samples(th[trial], conversion),
                Samples(out[trial], conversion),
                trial=trial,
                calibration=paths,
                path=f"loaded/{trial}",
                **common,
            )
            for trial in range(len(out))
        ]
    return calibrations + loaded


def _number(array: npt.NDArray, field: str) -> float:
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise RecordingError(f"is {array!r}, must be one number", field=field)
    return float(array.item())


def _from_csv(path: pathlib.Path, wanted: dict[str, str]) -> dict[str, npt.NDArray]:
    """The wanted columns of a table with a header line."""
    with _located(str(path)), path.open(newline="", encoding="utf-8-sig") as lines:
        header = [name.strip() for name in next(csv.reader([lines.readline()]), [])]
        twice = {name for name in header if header.count(name) > 1}
        places = {name: index for index, name in enumerate(header)}
        columns = {}
        for field, name in wanted.items():
            columns[field] = _chosen(places, name, field)
            if name in twice:
                raise RecordingError(
                    f"two columns have the name {name!r}", field=field, remedy="Rename one"
                )
        text = lines.read()
        if not text.strip():
            raise RecordingError("the table has no rows")
        table = np.loadtxt(
            text.splitlines(),
            delimiter=",",
            comments=None,
            quotechar='"',
            usecols=list(columns.values()),
            ndmin=2,
        )
    return dict(zip(columns, table.T, strict=True))


def _from_mat(path: pathlib.Path, wanted: dict[str, str]) -> dict[str, npt.NDArray]:
    """The wanted variables of a MATLAB file."""
    file = str(path)
    try:
        import pymatreader  # optional: only labs with MATLAB need it
    except ImportError:
        raise RecordingError(
            "MATLAB files need the package pymatreader",
            file=file,
            remedy="Run pip install 'etid[matlab]'",
        ) from None
    from scipy.io.matlab import MatReadError

    try:
        with _located(file):
            content = _flat(pymatreader.read_mat(path))
    except MatReadError as error:
        raise RecordingError(f"cannot be read ({error})", file=file) from error
    with _located(file):
        columns = {field: _chosen(content, name, field) for field, name in wanted.items()}
    for field, value in columns.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
            what = f"{value.dtype} array" if isinstance(value, np.ndarray) else type(value).__name__
            raise RecordingError(
                f"{wanted[field]!r} is a {what}, must be an array of real numbers",
                file=file,
                field=field,
            )
    return columns


def _flat(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Variables by name, fields of structures as `structure.field`."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        elif not name.startswith("__"):
            flat[f"{prefix}{name}"] = value
    return flat


def _recordings(
    columns: dict[str, npt.NDArray],
    names: dict[str, str],
    numbers: dict[str, Any],
    r_load: float | int | None,
    subject: str,
    condition: str,
) -> list[Recording]:
    """One recording per trial of columns (time,) or (trial, time)."""
    records = {field: array for field, array in columns.items() if field != "time"}
    shape = records["v_out"].shape
    fits = records["v_th"].shape in (shape, shape[-1:]) and (
        "current" not in records or records["current"].shape == shape
    )
    if len(shape) not in (1, 2) or 0 in shape or not fits:
        found = ", ".join(f"{names[field]} {array.shape}" for field, array in records.items())
        raise RecordingError(
            f"shapes do not fit each other: {found}",
            remedy="They must be (time,) or (trial, time); only v_th may be (time,) beside a "
            "stacked v_out",
        )
    rate = numbers["sample_rate"]
    if "time" in columns:
        rate = _rate(columns["time"], shape[-1])
    scale = numbers["scale"]
    if not (np.isfinite(scale) and scale != 0):
        raise RecordingError(f"is {scale}, must be finite and not 0", field="scale")
    periods = shape[-1] * numbers["pulse_rate"] / rate if rate > 0 else np.inf
    if len(shape) == 2 and shape[0] > shape[1] and periods < _SHORTEST_STACKED:
        raise RecordingError(
            f"{names['v_out']!r} would be {shape[0]} trials of {shape[1]} samples, "
            f"{periods:.2g} pulse periods each",
            field="v_out",
            remedy="Rows are trials and columns are time: transpose the variables",
        )

    def samples(field: str, array: npt.NDArray) -> Samples:
        return Samples(array, 1.0 if field == "current" else 1.0 / scale)

    common = samples("v_th", records["v_th"]) if records["v_th"].ndim == 1 else None
    kind = "loaded" if r_load is None else "calibration"
    recordings = []
    for trial in range(shape[0] if len(shape) == 2 else 1):
        rows: dict[str, Any] = {
            field: samples(field, array if len(shape) == 1 else array[trial])
            for field, array in records.items()
            if field != "v_th" or common is None
        }
        if common is not None:
            rows["v_th"] = common
        recordings.append(
            Recording(
                **rows,
                sample_rate=rate,
                pulse_rate=numbers["pulse_rate"],
                r_load=r_load,
                subject=subject,
                condition=condition,
                trial=trial if len(shape) == 2 else "",
                path=f"{kind}/{trial}",
            )
        )
    return recordings


def _rate(time: npt.NDArray, length: int) -> float:
    """Sample rate of uniform time stamps [s], from the first and the last."""
    if time.shape != (length,) or length < 2:
        raise RecordingError(
            f"has shape {time.shape}, must be ({length},) with at least two times", field="time"
        )
    stamps = time.astype(np.float64)
    step = (stamps[-1] - stamps[0]) / (length - 1)
    if not step > 0:
        raise RecordingError("does not increase", field="time", remedy="Times are in seconds")
    grid = stamps[0] + step * np.arange(length)
    worst = int(np.argmax(np.abs(stamps - grid)))
    distance = abs(stamps[worst] - grid[worst]) / step
    if not distance <= _TIME_TOLERANCE:
        raise RecordingError(
            f"is not uniform: sample {worst} is {distance:.2g} sample periods off",
            field="time",
            remedy="Resample outside, or give the sample_rate the instrument was set to",
        )
    return float(1 / step)
