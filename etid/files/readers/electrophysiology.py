"""Reader for files of electrophysiology: Axon (ABF 1 and 2), Intan (RHD, RHS), Spike2 (32 bits).

neo reads the header, and the samples in blocks. A channel has the name of the header; channels of
one name tell their place, as in `IN 0#2`. Several sweeps, or parts between pauses, become trials.
"""

import contextlib
import logging
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from etid.files.channel import Channel, Contents, by_place, located, rate_of
from etid.files.readers import Reader
from etid.recordings.errors import RecordingError

AGAIN = "Copy it again, or save it again with the program that recorded it"


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a file that neo reads. Each has one block of segments."""
    del folder
    raw, sweeps = _parsed(path)
    found = raw.header["signal_channels"]
    streams = [*raw.header["signal_streams"]["id"]]
    segments = range(raw.header["nb_segment"][0])
    starts = [raw.get_signal_t_start(0, 0, stream) for stream in range(len(streams))]
    names = by_place([str(one["name"]).strip() or f"ch{one['id']}" for one in found])

    def channel(name: str) -> Channel:
        place = names.index(name)
        one = found[place]
        stream = streams.index(one["stream_id"])
        index = np.count_nonzero(found["stream_id"][:place] == one["stream_id"])
        lengths = {int(raw.get_signal_size(0, segment, stream)) for segment in segments}
        length = max(lengths) // sweeps
        if lengths != {length * sweeps}:
            raise RecordingError(
                "has sweeps of different lengths",
                remedy="Export sweeps of equal length from the program that recorded it",
            )

        def read(trial: int, start: int, stop: int) -> np.ndarray:
            segment, first = (0, trial * length) if sweeps > 1 else (trial, 0)
            place = first + start, first + stop
            return raw.get_analogsignal_chunk(0, segment, *place, stream, [index])[:, 0]

        rate, late = float(one["sampling_rate"]), float(starts[stream] - min(starts))
        return Channel(
            name,
            (length,) if len(segments) * sweeps == 1 else (len(segments) * sweeps, length),
            np.dtype(one["dtype"]),
            read,
            unit=str(one["units"]),
            sample_rate=rate_of(1 / rate, 1e-7),  # the precision of float32
            conversion=float(one["gain"]),
            offset=float(one["offset"]),
            notice=f"{name!r} begins {late:g} s after the first channel" * (late * rate >= 1),
        )

    yield Contents(tuple(names), channel)


def _parsed(path: pathlib.Path) -> tuple[Any, int]:
    """Neo's reader of a file, and the number of sweeps that it has in one segment."""
    from neo import rawio

    raw: Any
    match path.suffix.lower():
        case ".abf":
            raw = rawio.AxonRawIO(str(path))
        case ".smr":
            raw = rawio.Spike2RawIO(str(path), ced_units=False, try_signal_grouping=False)
        case _:
            raw = rawio.IntanRawIO(str(path), ignore_integrity_checks=True)
    raw.logger = logging.Logger("neo", logging.ERROR)  # it warns of fields that are not used here
    with located(remedy=AGAIN), np.errstate(all="ignore"):
        raw.parse_header()
        if isinstance(raw, rawio.AxonRawIO):
            return raw, _old_axon(raw)
        if isinstance(raw, rawio.Spike2RawIO):
            _check_blocks(raw, path.stat().st_size)
        elif raw.discontinuous_timestamps:
            raise RecordingError("has lost samples: its time stamps have gaps", remedy=AGAIN)
        return raw, 1


def _old_axon(raw: Any) -> int:
    """Correct what neo reads wrong in ABF files of version 1; number of sweeps in one segment.

    The header of versions before 1.6 has 2048 bytes; where neo expects the gain of a telegraph,
    they have samples. Some files have no table of sweeps; neo then joins all.
    """
    info = raw._axon_info
    if info["fFileVersionNumber"] >= 2:
        return 1
    for one in raw.header["signal_channels"]:
        if one["dtype"] == "int16" and info["lDataSectionPtr"] == 4:
            one["gain"] = info["fADCRange"] / info["lADCResolution"]
            for name in ("fInstrumentScaleFactor", "fSignalGain", "fADCProgrammableGain"):
                one["gain"] /= info[name][int(one["id"])]
    joined = info["nOperationMode"] in (2, 5) and not info["lSynchArraySize"]
    return max(int(info["lActualEpisodes"]), 1) if joined else 1


def _check_blocks(raw: Any, size: int) -> None:
    """Raise an error if the blocks of a Spike2 channel are not those that its header declares.

    neo reads zeros behind the end of a file, counts blocks in 16 bits, and takes the pauses of all
    channels from the first.
    """
    for one in raw.header["signal_channels"]:
        number, width = int(one["id"]), np.dtype(one["dtype"]).itemsize
        parts = raw._by_seg_data_blocks[number]  # of each segment
        declared = 20 + int(raw._channel_infos[number]["lastblock"]) * raw._diskblock
        end = max(np.max(part["pos"] + width * part["size"].astype(int)) for part in parts)
        held = [part["size"].sum() for part in parts]
        ticks = [part["end_time"][-1] - part["start_time"][0] for part in parts]
        lost = np.multiply(ticks, one["sampling_rate"] * raw._time_factor) + 1 - held
        if parts[-1]["pos"][-1] != declared or end > size or np.max(np.abs(lost)) >= 2:
            raise RecordingError(f"channel {str(one['name'])!r} has lost samples", remedy=AGAIN)


READER = Reader(
    (".abf", ".rhd", ".rhs", ".smr"),
    opened,
    "channels of Axon, Intan and Spike2 (32 bits); `ch0`, … without a name",
    unit="header",
    rate="header",
    trials="sweeps",
    extra="neo",
    package="neo",
)
