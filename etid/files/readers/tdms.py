"""Reader for NI's TDMS files from LabVIEW and DAQmx; npTDMS reads them in blocks.

Channel c of group g has the name `g/c`.
"""

import contextlib
import logging
import pathlib
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from etid.files.channel import Channel, Contents, one_unit, rate_of
from etid.files.readers import Reader
from etid.recordings.errors import RecordingError


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a TDMS file."""
    del folder
    import nptdms
    from nptdms import log

    _check_length(path)
    console = log.log_manager.console_handler
    with contextlib.ExitStack() as stack:
        # Silence npTDMS on stderr: it reports errors, which are raised here, and text that is not
        # UTF-8, which is visible anyway.
        console.addFilter(_silent)
        stack.callback(console.removeFilter, _silent)
        # Pass an open file: npTDMS does not close its own file after an error, and might read an
        # index file instead.
        source = stack.enter_context(path.open("rb"))
        file = stack.enter_context(nptdms.TdmsFile.open(source))
        found = [
            (f"{group.name}/{channel.name}", channel)
            for group in file.groups()
            for channel in group.channels()
        ]
        by_name = dict(found)
        yield Contents(tuple(name for name, _ in found), lambda name: _channel(name, by_name[name]))


def _silent(_: logging.LogRecord) -> bool:
    return False


def _check_length(path: pathlib.Path) -> None:
    """Raise an error if a file ends inside a segment; npTDMS would read the part that exists."""
    size, position = path.stat().st_size, 0
    head = struct.Struct("<4slLQQ")  # tag, contents, version, length, length of the metadata
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            lead = file.read(head.size)
            tag, contents, _, length, _ = (
                head.unpack(lead) if len(lead) == head.size else (lead[:4], 0, 0, size, 0)
            )
            if tag != b"TDSm":
                raise RecordingError(f"is not a TDMS file: no segment begins at byte {position}")
            if contents & (1 << 6):  # the segment is big-endian
                length = int.from_bytes(lead[12:20], "big")
            position += head.size + length
    if position != size or size == 0:
        raise RecordingError(
            f"is truncated: the last segment ends at byte {position}, the file at byte {size}",
            remedy="Copy it again, or record it again if the recording program crashed",
        )


def _channel(name: str, channel: Any) -> Channel:
    own = channel.properties
    kinds = {value for key, value in own.items() if key.endswith("_Scale_Type")}
    # These turn a voltage into a voltage. For an unknown scaling npTDMS returns raw codes.
    kinds -= {"Linear", "Polynomial", "Table", "Add", "Subtract", "AdvancedAPI"}
    if kinds:
        raise RecordingError(
            f"{name!r} has the scaling {', '.join(sorted(kinds))}, which gives neither volts nor "
            "amperes"
        )
    raw = np.dtype(getattr(channel.data_type, "nptype", None) or "V8")
    slope, intercept = _line(own) if raw.kind in "iuf" else (1.0, 0.0)
    scaled = (slope, intercept) == (1.0, 0.0)

    def read(_: int, start: int, stop: int) -> np.ndarray:
        return channel.read_data(start, stop - start, scaled=scaled)

    return Channel(
        name,
        (len(channel),),
        channel.dtype if scaled else raw,
        read,
        unit=one_unit(
            name, *(str(own.get(key, "")) for key in ("unit_string", "NI_UnitDescription"))
        ),
        sample_rate=rate_of(own.get("wf_increment", 0.0), 1e-12, own.get("wf_xunit_string") or "s"),
        conversion=slope,
        offset=intercept,
    )


def _line(properties: dict[str, Any]) -> tuple[float, float]:
    """Slope and intercept of a linear scaling; 1 and 0 if npTDMS must apply the scaling."""
    only = int(properties.get("NI_Number_Of_Scales", 0)) == 1
    if not only or properties.get("NI_Scale[0]_Scale_Type") != "Linear":
        return 1.0, 0.0
    if properties.get("NI_Scaling_Status", "unscaled") == "scaled":
        return 1.0, 0.0
    line = properties["NI_Scale[0]_Linear_Slope"], properties["NI_Scale[0]_Linear_Y_Intercept"]
    return float(line[0]), float(line[1])


READER = Reader(
    (".tdms",),
    opened,
    "`group/channel` of NI files",
    unit="`unit_string`",
    rate="`wf_increment`",
    extra="tdms",
    package="npTDMS",
)
