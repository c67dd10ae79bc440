"""Studies in HDF5 files: `read` opens a file, `check` lists all faults of a file.

The layout is that of `etid.recordings.schema`. `read` reads only attributes and the headers of
datasets; samples are read when a recording is accessed. A fault of the whole file is raised. A
fault of one recording is stored in `Study.problems`.
"""

import os
from collections.abc import Iterator

import h5py
import numpy as np

from etid.recordings import schema
from etid.recordings.contents import Scan
from etid.recordings.errors import near_miss
from etid.recordings.recording import RecordingError
from etid.recordings.study import Study
from etid.recordings.untrusted import attribute, attribute_names, guarded, translated


def read(path: str | os.PathLike[str]) -> Study:
    """Open a file of recordings; samples are read when a recording is accessed.

    Args:
        path: Path of the file.

    Returns:
        Recordings of the file, sorted by path; numbers in a path are sorted by value.

    Raises:
        RecordingError: The file is missing, damaged or of another schema.
    """
    name = os.fspath(path)
    with guarded(name) as metadata:
        file = h5py.File(name, "r")
        try:
            _check_root(metadata, name)
            scan = Scan(metadata, file, name)
        except BaseException:
            file.close()
            raise
    first: dict[str, RecordingError] = {}
    for problem in scan.problems:
        first.setdefault(problem.path, problem)
    return Study(scan.sources(), problems=first, file=name, close=file.close)


def check(path: str | os.PathLike[str]) -> list[RecordingError]:
    """All faults of a file, field by field.

    Faults are also samples that are not finite, a constant current, and a distance between the
    pulses that does not match the sample rate and the pulse rate.

    Args:
        path: Path of the file.

    Returns:
        The faults; empty if all recordings of the file can be used.
    """
    name = os.fspath(path)
    try:
        with guarded(name) as metadata, h5py.File(name, "r") as file:
            _check_root(metadata, name)
            scan = Scan(metadata, file, name)
            scan.check_samples()
            constant = [*_constant_currents(scan, name)]
    except RecordingError as problem:
        return [problem]
    return scan.problems + constant


def _constant_currents(scan: Scan, name: str) -> Iterator[RecordingError]:
    """The fault of each recording whose current has no pulses."""
    broken = {problem.path for problem in scan.problems}
    for path, source in scan.sources().items():
        if path in broken or all(of.name != "current" for of in source.layout):
            continue
        current = source.load().samples["current"].values
        if np.ptp(current) == 0:
            yield RecordingError(
                f"is constant, {current[0]:g} A",
                file=name,
                path=path,
                field="current",
                remedy="Record the current of the pulses, or remove the dataset",
            )


def _check_root(file: h5py.File, name: str) -> None:
    found: dict[str, str] = {}
    for field in schema.at("file attribute").values():
        remedy = f"The file needs the attributes schema={schema.NAME!r} and schema_version"
        with translated(name, field=field.name):
            if field.name not in file.attrs:
                near = near_miss(field.name, attribute_names(file))
                hint = f", did you mean {field.name} by {near}?" if near else ""
                raise RecordingError(f"is missing{hint}", remedy=remedy)
            try:
                found[field.name] = field.parse(attribute(file, field.name))
            except RecordingError as error:
                raise RecordingError(error.message, remedy=remedy) from None
    problem = schema.version_problem(found["schema_version"])
    if problem:
        raise RecordingError(
            problem, file=name, field="schema_version", remedy="Use the etid that wrote the file"
        )
