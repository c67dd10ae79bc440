"""Reader for WAV files of sound cards; SciPy reads them without copying the samples.

Channel 1 has the name `1`, and so on. A sample is a fraction of full scale, from -1 to 1: the
scale of a mapping is this fraction at 1 V at the terminal.
"""

import contextlib
import pathlib
import warnings
from collections.abc import Iterator

import numpy as np
import scipy.io.wavfile

from etid.files.channel import Channel, Contents
from etid.recordings.recording import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a WAV file."""
    del folder
    with warnings.catch_warnings():
        # A file that was not closed, or chunks that SciPy does not know.
        warnings.simplefilter("error", scipy.io.wavfile.WavFileWarning)
        try:
            rate, samples = scipy.io.wavfile.read(path, mmap=True)
        except (scipy.io.wavfile.WavFileWarning, ValueError):
            warnings.simplefilter("ignore", scipy.io.wavfile.WavFileWarning)
            rate, samples = scipy.io.wavfile.read(path)  # 24 bits, or more chunks
    if samples.size == 0:
        raise RecordingError("the file has no samples")
    columns = samples.reshape(samples.shape[0], -1)
    names = tuple(str(number + 1) for number in range(columns.shape[1]))

    def channel(name: str) -> Channel:
        column = columns[:, names.index(name)]
        whole = column.dtype.kind in "iu"
        full = 2.0 ** (8 * column.dtype.itemsize - 1) if whole else 1.0
        middle = -1.0 if column.dtype.kind == "u" else 0.0  # 8 bits have no sign

        def read(_: int, start: int, stop: int) -> np.ndarray:
            return np.array(column[start:stop])

        return Channel(
            name,
            (column.size,),
            column.dtype,
            read,
            sample_rate=float(rate),
            conversion=1 / full,
            offset=middle,
        )

    yield Contents(names, channel)
