"""Axon's ABF files of both versions: the header by pyabf, the samples by blocks.

Each ADC channel is called by its name, or `channel 0`, … where it has none of its own.  Several
sweeps are trials.  pyabf itself would read the whole file and round its codes to float32.
"""

import contextlib
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from etid.files.channel import Channel, Contents, needs, rate_of
from etid.recordings.recording import RecordingError

_PRECISION = 1e-6  # of a sample interval, a float32


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """An ABF file."""
    del folder
    try:
        import pyabf  # optional: only labs with instruments of Axon need it
    except ImportError:
        raise needs("pyabf", "abf", str(path)) from None

    abf: Any = pyabf.ABF(path, loadData=False)
    dtype = np.dtype(abf._dtype).newbyteorder("<")
    sweeps, length, count = abf.sweepCount, abf.sweepPointCount, abf.channelCount
    if hasattr(abf, "_synchArraySection") and len(set(abf._synchArraySection.lLength)) > 1:
        raise RecordingError(
            "its sweeps differ in length", remedy="Export sweeps of one length from Clampfit"
        )
    end = abf.dataByteStart + abf.dataPointCount * dtype.itemsize
    if end > path.stat().st_size or min(sweeps, length, count) < 1:
        raise RecordingError(
            f"is cut off: its samples end at byte {end}, the file at {path.stat().st_size}",
            remedy="Copy it again",
        )
    # Of sweeps, time and channels, the channels are next to each other.
    stored = np.memmap(path, dtype, "r", abf.dataByteStart, (sweeps, length, count))
    own = [name.strip("? \0") for name in abf.adcNames]
    names = [
        name if name and own.count(name) == 1 else f"channel {index}"
        for index, name in enumerate(own)
    ]
    # pyabf's own dataRate has lost what is behind the point: 149999 for 150000
    if abf.abfVersion["major"] == 1:
        interval = abf._headerV1.fADCSampleInterval * count
    else:
        interval = abf._protocolSection.fADCSequenceInterval
    rate = rate_of(1e-6 * interval, _PRECISION)

    def channel(name: str) -> Channel:
        index = names.index(name)
        codes = dtype.kind == "i"

        def read(sweep: int, start: int, stop: int) -> np.ndarray:
            return np.array(stored[sweep, start:stop, index])

        return Channel(
            name,
            (sweeps, length) if sweeps > 1 else (length,),
            dtype,
            read,
            unit=abf.adcUnits[index].strip("? \0"),
            sample_rate=rate,
            conversion=abf._dataGain[index] if codes else 1.0,
            offset=abf._dataOffset[index] if codes else 0.0,
        )

    yield Contents(tuple(names), channel)
