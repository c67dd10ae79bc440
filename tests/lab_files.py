"""Files as instruments write them, made by the libraries that read them; and their import."""

import wave

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.io.wavfile
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


def wav(path, kind):
    """A WAV file of two channels of 30 samples at 200 kHz."""
    if kind == "24 bits":
        with wave.open(str(path), "wb") as file:
            file.setparams((2, 3, 200_000, 30, "NONE", ""))
            file.writeframes(bytes(6 * 30))
    else:
        scipy.io.wavfile.write(path, 200_000, np.arange(60).reshape(30, 2).astype(kind))
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
