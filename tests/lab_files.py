"""Files as instruments write them, made by the libraries that read them; and their import."""

import struct

import h5py
import numpy as np
import pytest
import scipy.io
from nptdms import ChannelObject, TdmsWriter
from pyabf.abfWriter import writeABF1

import etid
from etid.recordings import hdf5

# A linear scaling of a TDMS channel.
LINE = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Linear",
        "NI_Scale[0]_Linear_Slope": 2e-3, "NI_Scale[0]_Linear_Y_Intercept": 0.5}  # fmt: skip


def imported(source, mapping=None, **given):
    """The recordings of a file by path, and what was used for what."""
    target = source.with_suffix(".h5")
    used = etid.import_file(source, target, mapping, **given)
    assert hdf5.check(target) == []
    with hdf5.read(target) as study:
        found = dict(study)
    target.unlink()
    return found, used


def refused(source, mapping, message, **given):
    """That a file is refused with this message, and leaves nothing."""
    before = {*source.parent.iterdir()}
    with pytest.raises(etid.RecordingError, match=message) as caught:
        etid.import_file(source, source.with_suffix(".h5"), mapping, **given)
    assert source.name in caught.value.file
    assert {*source.parent.iterdir()} == before
    return caught.value


def table(folder, text):
    """A CSV file with this text."""
    path = folder / "a.csv"
    path.write_text(text, encoding="utf-8")
    return path


def rig(path, v_th, v_out, **own):
    """A TDMS file of two channels in volts at 200 kHz; `own` are properties of the second."""
    channels = {"rig/open": (v_th, {}), "rig/skin": (v_out, own)}
    return tdms(path / "rig.tdms", channels, unit_string="V", wf_increment=5e-6)


LVM = """\
LabVIEW Measurement{t}
Writer_Version{t}2
Separator{t}{separator}
Decimal_Separator{t}{decimal}
Multi_Headings{t}No
X_Columns{t}{columns}
***End_of_Header***{t}
{t}
Channels{s}2{s}{s}
Samples{s}{count}{s}{count}{s}
Y_Unit_Label{s}Volts{s}{unit}{s}
X0{s}0{s}0{s}
Delta_X{s}{step}{s}{step}{s}
***End_of_Header***{s}{s}{s}
X_Value{s}{name}{s}skin{s}Comment
"""


def labview(path, times, v_th, v_out, *, separator="Tab", decimal=".", unit="Volts", **said):
    """A LabVIEW file of the channels `open` and `skin`; `times` are texts."""
    s = {"Tab": "\t", "Comma": ","}[separator]
    said = {"columns": "One", "count": len(v_th), "name": "open", **said}
    step = str(said.pop("step")).replace(".", decimal)
    head = LVM.format(
        t="\t", s=s, separator=separator, decimal=decimal, unit=unit, step=step, **said
    )
    rows = (
        s.join([t, f"{a:.6f}", f"{b:.6f}", ""]).replace(".", decimal)
        for t, a, b in zip(times, v_th, v_out, strict=True)
    )
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def tdms(path, channels, **properties):
    """A TDMS file of {"group/channel": samples}; properties of each channel by name, or of all."""
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject(*name.split("/", 1), data=samples, properties={**properties, **own})
                for name, (samples, own) in channels.items()
            ]
        )
    return path


def abf(path, sweeps, sample_rate=200e3, unit="V"):
    """An ABF file of one channel without a name."""
    writeABF1(np.asarray(sweeps, float), str(path), sample_rate, unit)
    return path


def intan(path, channels, first=0):
    """An Intan file at 200 kHz: analog inputs {name: codes} of 312.5 uV, and the amplifier `A-000`.

    It measures 195 uV and, in an RHS file, stimulates with -3 and 5 uA. The samples, a multiple of
    128, are numbered from `first`.
    """
    rhs = path.suffix == ".rhs"

    def texts(*several):
        return b"".join(struct.pack("<I", 2 * len(one)) + one.encode("utf-16le") for one in several)

    if rhs:
        head = struct.pack("<Ihhfh8fh2f2h3f", 0xD69127AC, 3, 0, 200e3, *[0] * 14, 1e-6, 0, 0)
        head += texts("", "", "") + struct.pack("<hh", 0, 0)
    else:
        head = struct.pack("<Ihhfh6fh2f", 0xC6912702, 3, 0, 200e3, *[0] * 10)
        head += texts("", "", "") + struct.pack("<hh", 0, 13)
    kinds = {"A-000": 0, **dict.fromkeys(channels, 3)}
    head += texts("") + struct.pack("<h", 1) + texts("Port A", "A")
    head += struct.pack("<hhh", 1, len(kinds), 1)
    for place, (name, kind) in enumerate(kinds.items()):
        head += texts(f"ANALOG-IN-{place}" if kind else name, name)
        head += struct.pack("<hhhh", place, place, kind, 1) + bytes(22 if rhs else 20)
    codes = np.array([*channels.values()], "<u2")
    amplifier = [[33768] * 128, [256 + 3, 5] * 64] if rhs else [[33768] * 128]
    with path.open("wb") as file:
        file.write(head)
        for start in range(0, codes.shape[1], 128):
            file.write(np.arange(first + start, first + start + 128, dtype="<i4").data)
            file.write(np.array(amplifier, "<u2").data)
            file.write(codes[:, start : start + 128].tobytes())
    return path


def spike2(path, channels, starts=(0,), late=0):
    """A Spike2 file of 32 bits at 200 kHz: channels in mV, {name: codes}, of 10 / 65536 mV.

    It was sampled from the samples `starts` on, for equal times; all but its first channel `late`
    samples later.
    """
    head = struct.pack(
        "<h10s8s3hi5hid", 9, b"(C) CED 87", b"", 1, 1, 0, 0, len(channels), 140, 0, 0, 0, 0, 1e-6
    )
    place = first = -(-(512 + 140 * len(channels)) // 512)
    table = blocks = b""
    for number, (name, codes) in enumerate(channels.items()):
        pieces = [
            (start + late * (number > 0) + i, part[i : i + 200].astype("<i2"))
            for start, part in zip(starts, np.split(codes, len(starts)), strict=True)
            for i in range(0, len(part), 200)
        ]
        begin, last, times = place, place + len(pieces) - 1, (0, 0)
        for place, (start, piece) in enumerate(pieces, begin):
            chain = place - 1 if place > begin else -1, place + 1 if place < last else -1
            times = 5 * start, 5 * (start + len(piece) - 1)
            block = struct.pack("<iiiihh", *chain, *times, number + 1, len(piece))
            blocks += (block + piece.tobytes()).ljust(512, b"\0")
        place += 1
        title, unit = (bytes([len(text)]) + text.encode() for text in (name, "mV"))
        sizes = (len(pieces), 0, 0, 0, 512, 200)
        table += struct.pack("<hiii6h72s", 0, -1, begin, last, *sizes, b"")
        table += struct.pack("<iih10sfBb", times[1], 5, number, title, 200e3, 1, 0)
        table += struct.pack("<ff6sh", 1.0, 0.0, unit, 0)
    path.write_bytes((head.ljust(512, b"\0") + table).ljust(512 * first, b"\0") + blocks)
    return path


def matlab(path, version, **variables):
    """A MATLAB file; version 7.3 is HDF5 with reversed axes behind a 512-byte header."""
    if version == 5:
        scipy.io.savemat(path, variables)
        return path
    with h5py.File(path, "w", userblock_size=512) as file:
        _write_matlab(file, variables)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def _write_matlab(group, variables):
    for name, value in variables.items():
        if isinstance(value, dict):
            group.create_group(name).attrs["MATLAB_class"] = np.bytes_("struct")
            _write_matlab(group[name], value)
            continue
        array = np.array([[*map(ord, value)]], "u2") if isinstance(value, str) else value
        kinds = {"f": "double", "i": "int16", "u": "char", "V": "double", "c": "double"}
        group[name] = np.atleast_2d(array).T
        group[name].attrs["MATLAB_class"] = np.bytes_(kinds[array.dtype.kind])
