"""Reader for WAV files of sound cards; SciPy reads them without copying the samples.

Channel 1 has the name `1`, and so on. A sample is a fraction of full scale, from -1 to 1: the
scale of a mapping is this fraction at 1 V at the terminal.
"""

import contextlib
import pathlib
import struct
import warnings
from collections.abc import Iterator

import numpy as np
import scipy.io.wavfile

from etid.files.channel import Channel, Contents, array_channel
from etid.files.readers import Reader
from etid.recordings.recording import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a WAV file."""
    del folder
    _check_length(path)
    with warnings.catch_warnings():
        # SciPy warns of chunks that it does not know; they hold no samples.
        warnings.simplefilter("ignore", scipy.io.wavfile.WavFileWarning)
        try:
            rate, samples = scipy.io.wavfile.read(path, mmap=True)
        except ValueError:
            rate, samples = scipy.io.wavfile.read(path)  # 24 bits
    columns = np.atleast_2d(samples.T).T  # (time, channel)
    names = tuple(str(number + 1) for number in range(columns.shape[1]))

    def channel(name: str) -> Channel:
        column = columns[:, names.index(name)]
        whole = column.dtype.kind in "iu"
        return array_channel(
            name,
            column,
            sample_rate=float(rate),
            conversion=2.0 ** (1 - 8 * column.dtype.itemsize) if whole else 1.0,
            offset=-1.0 if column.dtype.kind == "u" else 0.0,  # 8 bits have no sign
        )

    yield Contents(names, channel)


def _check_length(path: pathlib.Path) -> None:
    """Raise an error if a file ends before its samples do; SciPy would read those that exist."""
    size, position, long = path.stat().st_size, 12, 0
    with path.open("rb") as file:
        order = ">" if file.read(4) == b"RIFX" else "<"
        while position + 8 <= size:
            file.seek(position)
            name, length = struct.unpack(f"{order}4sI", file.read(8))
            if name == b"ds64":  # files of more than 4 GB: lengths of the file and of the samples
                _, long = struct.unpack("<QQ", file.read(16))
            end = position + 8 + (long or length)
            if name == b"data" and end > size:
                raise RecordingError(
                    f"is truncated: its samples end at byte {end}, the file at byte {size}",
                    remedy="Copy it again, or record it again if the recording program crashed",
                )
            position += 8 + length + length % 2


READER = Reader((".wav",), opened, "`1`, `2`, …, as fractions of full scale", rate="header")
