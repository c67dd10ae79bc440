"""Reader for NumPy archives: each named array is a channel of shape (time,) or (trial, time)."""

import contextlib
import pathlib
import zipfile
from collections.abc import Iterator

import numpy as np

from etid.files.channel import Channel, Contents, array_channel
from etid.files.readers import Reader
from etid.recordings.recording import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Arrays of an archive."""
    del folder
    if not zipfile.is_zipfile(path):
        raise RecordingError("is not an npz file")
    # `np.load` of a path would leave a damaged file open.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:

        def channel(name: str) -> Channel:
            return array_channel(name, np.atleast_1d(archive[name]))

        yield Contents(tuple(archive.files), channel)


READER = Reader((".npz",), opened, "arrays of NumPy", trials="rows")
