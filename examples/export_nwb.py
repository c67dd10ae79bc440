"""Recordings as NWB.

A TimeSeries for each record, with the stored codes; a neurophysiologist adds the other fields.
"""

import datetime
import pathlib
import tempfile

import pynwb

import etid

file = pynwb.NWBFile(
    session_description="Output of an electro-tactile stimulator",
    identifier="example",
    session_start_time=datetime.datetime(2026, 1, 31, 9, 30, tzinfo=datetime.UTC),
)
for path, recording in etid.read("data_schema/example.h5").items():
    for name, record in recording.samples.items():
        series = pynwb.TimeSeries(
            name=f"{path}/{name}".replace("/", "."),
            data=record.stored,
            unit="ampere" if name == "current" else "volt",
            conversion=record.conversion,
            offset=record.offset,
            rate=recording.sample_rate,
            comments=f"{recording.metadata}",
        )
        file.add_acquisition(series)
target = pathlib.Path(tempfile.mkdtemp()) / "example.nwb"
with pynwb.NWBHDF5IO(target, "w") as output:
    output.write(file)
print(f"{len(file.acquisition)} TimeSeries, {len(pynwb.validate(path=target))} errors: {target}")
