"""Files as instruments write them, made by the libraries that read them."""

import h5py
import numpy as np
import scipy.io
from nptdms import ChannelObject, TdmsWriter
from pyabf.abfWriter import writeABF1


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
