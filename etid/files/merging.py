"""Several files of recordings become one."""

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from etid.recordings import hdf5
from etid.recordings.fields import Metadata
from etid.recordings.recording import AbstractSource, RecordingError
from etid.recordings.study import Study


@dataclasses.dataclass(frozen=True, eq=False)
class _Moved(AbstractSource):
    """A recording of another file, below a group of this file."""

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
    Samples are copied in blocks.

    Args:
        sources: Files of recordings; their names without the ending must differ.
        target: File to write. An existing file is replaced at the end.

    Returns:
        Number of recordings of each group.
    """
    paths = [pathlib.Path(os.fspath(source)) for source in sources]
    merged: dict[str, AbstractSource] = {}
    counts: dict[str, int] = {}
    with contextlib.ExitStack() as files:
        for path in paths:
            if path.stem in counts:
                raise RecordingError(
                    f"another file has the name {path.stem!r}, which becomes the name of its group",
                    file=str(path),
                    remedy="Rename one of the files",
                )
            study = files.enter_context(hdf5.read(path))
            for problem in study.problems.values():
                raise problem
            counts[path.stem] = len(study)
            merged |= _moved(study, path.stem)
        Study(merged).write(target)
    return counts


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
