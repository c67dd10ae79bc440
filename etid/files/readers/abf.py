"""Reader for Axon's ABF files of both versions.

pyabf reads the header. This module reads the samples in blocks, because pyabf would read the whole
file and round the codes to float32. A channel has the name of its ADC channel. If this name is
empty or not unique, the name is `channel 0`, …. Several sweeps become trials.
"""

import contextlib
import pathlib
from collections.abc import Iterator

import numpy as np

from etid.files.channel import Channel, Contents, array_channel, rate_of
from etid.recordings.errors import RecordingError, optional


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of an ABF file."""
    del folder
    pyabf = optional("pyabf", "abf", str(path))
    abf = pyabf.ABF(path, loadData=False)
    dtype = np.dtype(abf._dtype).newbyteorder("<")
    sweeps, length, count = abf.sweepCount, abf.sweepPointCount, abf.channelCount
    if hasattr(abf, "_synchArraySection") and len(set(abf._synchArraySection.lLength)) > 1:
        raise RecordingError(
            "has sweeps of different lengths", remedy="Export sweeps of equal length from Clampfit"
        )
    end = abf.dataByteStart + abf.dataPointCount * dtype.itemsize
    if end > path.stat().st_size or min(sweeps, length, count) < 1:
        raise RecordingError(
            f"is truncated: its samples end at byte {end}, the file at {path.stat().st_size}",
            remedy="Copy it again",
        )
    # The file stores one value per channel for each sample; channels are the last axis.
    stored = np.memmap(path, dtype, "r", abf.dataByteStart, (sweeps, length, count))
    own = [name.strip("? \0") for name in abf.adcNames]
    names = [
        name if name and own.count(name) == 1 else f"channel {index}"
        for index, name in enumerate(own)
    ]
    # dataRate of pyabf is truncated to an integer: 149999 instead of 150000
    if abf.abfVersion["major"] == 1:
        interval = abf._headerV1.fADCSampleInterval * count
    else:
        interval = abf._protocolSection.fADCSequenceInterval
    rate = rate_of(1e-6 * interval, 1e-6)  # the precision of float32

    def channel(name: str) -> Channel:
        index = names.index(name)
        codes = dtype.kind == "i"
        return array_channel(
            name,
            stored[:, :, index] if sweeps > 1 else stored[0, :, index],
            unit=abf.adcUnits[index].strip("? \0"),
            sample_rate=rate,
            conversion=abf._dataGain[index] if codes else 1.0,
            offset=abf._dataOffset[index] if codes else 0.0,
        )

    yield Contents(tuple(names), channel)
