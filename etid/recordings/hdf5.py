"""Studies in HDF5 files: `read`, and `check`, which says all that is wrong with a file.

The layout is that of `etid.recordings.schema`. Opening a file reads attributes and the headers of
datasets only; samples are read when a recording is accessed. Trouble with the whole file is raised,
trouble with one recording is put aside in `Study.problems`.
"""

import os

import h5py

from etid.recordings import schema
from etid.recordings.contents import Scan
from etid.recordings.errors import near_miss
from etid.recordings.recording import RecordingError
from etid.recordings.study import Study
from etid.recordings.untrusted import Attributes, check_file, translated


def read(path: str | os.PathLike[str]) -> Study:
    """Open a file of recordings; the samples are read when they are needed.

    Args:
        path: The file.

    Returns:
        Its recordings in the order of their paths, numbers in them by value.

    Raises:
        RecordingError: The file as a whole is missing, damaged or of another schema.
    """
    name = os.fspath(path)
    file = _open(name)
    try:
        scan = Scan(file, name)
    except BaseException:
        file.close()
        raise
    first: dict[str, RecordingError] = {}
    for problem in scan.problems:
        first.setdefault(problem.path, problem)
    return Study(scan.sources(), problems=first, file=name, close=file.close)


def check(path: str | os.PathLike[str]) -> list[RecordingError]:
    """All that is wrong with a file, field by field.

    Samples that are not finite are, and pulses that are not as far apart as both rates say.

    Args:
        path: The file.

    Returns:
        The problems; none, if the file can be used whole.
    """
    name = os.fspath(path)
    try:
        with _open(name) as file:
            scan = Scan(file, name)
            scan.check_samples()
    except RecordingError as problem:
        return [problem]
    return scan.problems


def _open(name: str) -> h5py.File:
    """The file, once its root says that it follows the schema."""
    check_file(name)
    with translated(name):
        file = h5py.File(name, "r")
    try:
        with Attributes(name) as attributes:
            _check_root(file, name, attributes)
    except BaseException:
        file.close()
        raise
    return file


def _check_root(file: h5py.File, name: str, attributes: Attributes) -> None:
    found: dict[str, str] = {}
    for field in schema.at("file attribute").values():
        remedy = f"The file needs the attributes schema={schema.NAME!r} and schema_version"
        with translated(name, field=field.name):
            if field.name not in file.attrs:
                near = near_miss(field.name, attributes.names(file))
                hint = f", did you mean {field.name} by {near}?" if near else ""
                raise RecordingError(f"is missing{hint}", remedy=remedy)
            try:
                found[field.name] = field.parse(attributes.value(file, field.name))
            except ValueError as error:
                raise RecordingError(str(error), remedy=remedy) from None
    problem = schema.version_problem(found["schema_version"])
    if problem:
        raise RecordingError(
            problem, file=name, field="schema_version", remedy="Read it with the etid that wrote it"
        )
