"""Studies in HDF5 files: `read` opens a file, `check` lists its faults, `write` writes one.

The layout is that of `etid.recordings.schema`. `read` reads only attributes and the headers of
datasets; samples are read when a recording is accessed. A fault of the whole file is raised. A
fault of one recording is stored in `Study.problems`.
"""

import contextlib
import dataclasses
import functools
import os
import pathlib
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from etid.recordings import schema
from etid.recordings.contents import SamplesFile, Scan
from etid.recordings.errors import near_miss
from etid.recordings.fields import Metadata
from etid.recordings.recording import AbstractSource, RecordingError
from etid.recordings.replacing import check_ending, replacing_hdf5
from etid.recordings.study import Study
from etid.recordings.untrusted import attribute, guarded, translated


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
        samples_of = SamplesFile(name)
        try:
            samples_of.open()
            _check_root(metadata, name)
            scan = Scan(metadata, samples_of)
        except BaseException:
            samples_of.close()
            raise
    first: dict[str, RecordingError] = {}
    for problem in scan.problems:
        first.setdefault(problem.path, problem)
    return Study(scan.sources(), problems=first, file=name, close=samples_of.close)


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
        with guarded(name) as metadata, contextlib.closing(SamplesFile(name)) as samples_of:
            samples_of.open()
            _check_root(metadata, name)
            scan = Scan(metadata, samples_of)
            scan.check_samples()
    except RecordingError as problem:
        return [problem]
    return scan.problems


def _check_root(file: h5py.File, name: str) -> None:
    found: dict[str, str] = {}
    with translated(name, field="schema"):
        if "schema" in file.attrs and attribute(file, "schema") == schema.FITS:
            raise RecordingError(
                "is a file of fits, not of recordings",
                remedy="Name the file of recordings, or of a driver (etid calibrate); etid report "
                "and etid export take a file of fits",
            )
    remedy = (
        f"The file needs the attributes schema={schema.NAME!r} and schema_version; convert a file "
        "of another program with `etid import`"
    )
    for field in schema.at("file attribute").values():
        with translated(name, field=field.name):
            if field.name not in file.attrs:
                near = near_miss(field.name, file.attrs)
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


# --- Writing --------------------------------------------------------------------------------------


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


# --- Drivers of other files, and merging ----------------------------------------------------------


def read_calibrations(path: str | os.PathLike[str]) -> Study:
    """The recordings with known resistors of a file, all of one driver.

    Raises:
        RecordingError: The file cannot be read, or holds calibrations of no driver or of several.
    """
    whole = read(path)
    found = whole.calibrations
    sessions = {found.metadata(one).session for one in found} - {""}
    named = {whole.metadata(one).calibration for one in whole.loaded} - {()}
    if found and len(sessions) < 2 and len(named) < 2:
        return found
    whole.close()
    if not found:
        raise RecordingError(
            "holds no recording with a known resistor",
            file=os.fspath(path),
            remedy="Import it with its resistor: etid import FILE --r-load OHM",
        )
    which = f"sessions {', '.join(sorted(sessions))}" if len(sessions) > 1 else "several drivers"
    raise RecordingError(
        f"holds calibrations of {which}",
        file=os.fspath(path),
        remedy="Write those of one: Study.from_recordings([study[path], …]).write(FILE)",
    )


def read_with_driver(path: str | os.PathLike[str], driver: str | os.PathLike[str]) -> Study:
    """The loaded recordings of a file; the calibrations of another file are theirs.

    Args:
        path: File of recordings. Its own calibrations are left out.
        driver: File of the calibrations of one driver. They come into a group of its name.

    Raises:
        RecordingError: As `read` and `read_calibrations`.
    """
    calibrations, whole = read_calibrations(driver), read(path)
    moved = _moved(calibrations, pathlib.Path(os.fspath(driver)).name)
    names = tuple(moved)
    for own in whole.loaded:
        source = whole.source(own)
        known = dataclasses.replace(source.metadata, calibration=names)
        moved[own] = _Moved(source.layout, source.unloaded, source, known)

    close = functools.partial(_close_both, calibrations.close, whole.close)
    return Study(moved, problems=whole.problems, file=whole.file, close=close)


def _close_both(*closes: Callable[[], None]) -> None:
    for close in closes:
        close()


@dataclasses.dataclass(frozen=True, eq=False)
class _Moved(AbstractSource):
    """A recording of another file, with another path or other calibrations."""

    source: AbstractSource
    moved: Metadata

    @property
    def metadata(self) -> Metadata:
        return self.moved

    def blocks(self, name: str) -> Iterator[np.ndarray]:
        return self.source.blocks(name)


def merge_files(
    sources: Sequence[str | os.PathLike[str]], target: str | os.PathLike[str]
) -> dict[str, int]:
    """Write the recordings of several files into one file.

    The recordings of `s01.h5` come into the group `s01`: `loaded/0` becomes `s01/loaded/0`. They
    keep their calibrations. A recording that names none gets the only calibration of its own file.
    If its file has none, files that have some are refused: their driver is not its own. Samples are
    copied in blocks.

    Args:
        sources: Files of recordings; their names without the ending must differ.
        target: File to write. An existing file is replaced at the end.

    Returns:
        Number of recordings of each group.

    Raises:
        RecordingError: A file cannot be read, two have one name, or a recording without a
            calibration would come beside calibrations of other files.
    """
    paths = [pathlib.Path(os.fspath(source)) for source in sources]
    studies: dict[str, Study] = {}
    with contextlib.ExitStack() as files:
        for path in paths:
            if path.stem in studies:
                raise RecordingError(
                    f"another file has the name {path.stem!r}, which becomes the name of its group",
                    file=str(path),
                    remedy="Rename one of the files",
                )
            study = files.enter_context(read(path))
            for problem in study.problems.values():
                raise problem
            studies[path.stem] = study
        _refuse_other_drivers(studies.values())
        merged: dict[str, AbstractSource] = {}
        for group, study in studies.items():
            merged |= _moved(study, group)
        Study(merged).write(target)
        return {group: len(study) for group, study in studies.items()}


def _refuse_other_drivers(studies: Collection[Study]) -> None:
    """Raise an error if a recording has no calibration, but would come beside foreign ones."""
    if not any(study.calibrations for study in studies):
        return
    for study in studies:
        for path in () if study.calibrations else study.loaded:
            if "v_th" in {record.name for record in study.source(path).layout}:
                raise RecordingError(
                    "has no calibration, and those of the other files may be of another driver",
                    file=study.file,
                    path=path,
                    remedy="Import it with its own, etid import --calibration FILE OHM, or fit its "
                    "file alone, with the driver of another: etid fit --driver FILE",
                )


def _moved(study: Study, group: str) -> dict[str, AbstractSource]:
    """Sources of a study below a group, by their new paths."""
    known = tuple(study.calibrations)
    found: dict[str, AbstractSource] = {}
    for path in study:
        source = study.source(path)
        names = source.metadata.calibration
        if not names and source.metadata.kind == "loaded" and len(known) == 1:
            names = known
        moved = dataclasses.replace(
            source.metadata,
            path=f"{group}/{path}",
            calibration=tuple(f"{group}/{name}" for name in names),
        )
        found[moved.path] = _Moved(source.layout, source.unloaded, source, moved)
    return found
