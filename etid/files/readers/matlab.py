"""Reader for MATLAB files.

Version 7.3 is HDF5 and is read in blocks. Earlier versions are read completely. Field b of
structure a is the channel `a.b`. Rows are trials, columns are times.
"""

import contextlib
import pathlib
import warnings
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from h5py import h5o  # type: ignore[attr-defined]  # compiled, without stubs

from etid.files.channel import Channel, Contents, array_channel, optional, real
from etid.files.readers import mat5
from etid.recordings import limits
from etid.recordings.recording import RecordingError
from etid.recordings.untrusted import attribute, check_size, guarded, local_link


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a MATLAB file of any version."""
    del folder
    if h5py.is_hdf5(path):
        # A chunk holds several trials, which are read one by one.
        with guarded(str(path), rdcc_nbytes=1 << 25) as file:
            yield _hdf5(file)
    else:
        yield _whole(path)


def _hdf5(file: h5py.File) -> Contents:
    """Channels of version 7.3: HDF5 with reversed axes; names with `#` are internal to MATLAB."""
    datasets: dict[str, h5py.Dataset] = {}
    walked: set[int] = set()  # addresses, because links may form a loop

    def walk(group: h5py.Group, prefix: str) -> None:
        address = h5o.get_info(group.id).addr
        if address in walked:
            return
        walked.add(address)
        if prefix.count(".") > limits.DEPTH:
            raise RecordingError(f"has structures nested more than {limits.DEPTH} deep")
        names: Any = list(group)
        for name in names:
            if name.startswith("#"):
                continue
            local_link(group, name)
            member = group.get(name)
            if isinstance(member, h5py.Group):
                walk(member, f"{prefix}{name}.")
            elif isinstance(member, h5py.Dataset):
                datasets[f"{prefix}{name}"] = member

    walk(file, "")

    def channel(name: str) -> Channel:
        data = datasets[name]
        kind = attribute(data, "MATLAB_class") if "MATLAB_class" in data.attrs else b""
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if kind in ("char", "logical", "cell"):
            raise RecordingError(f"{name!r} is a {kind} array, must be an array of real numbers")
        if "MATLAB_empty" in data.attrs or data.shape is None:
            raise RecordingError(f"{name!r} is empty")
        real(name, data.dtype, data.shape)
        check_size(data)
        axes = [axis for axis, size in enumerate(data.shape) if size > 1] or [0]
        shape = tuple(data.shape[axis] for axis in reversed(axes))

        def read(trial: int, start: int, stop: int) -> np.ndarray:
            place: list[int | slice] = [0] * data.ndim
            place[axes[0]] = slice(start, stop)
            if len(axes) == 2:
                place[axes[1]] = trial
            return data[tuple(place)]

        return Channel(name, shape, data.dtype, read)

    return Contents(tuple(datasets), channel)


def _whole(path: pathlib.Path) -> Contents:
    """Channels of version 5 and older."""
    pymatreader = optional("pymatreader", "matlab", str(path))
    from scipy.io.matlab import MatReadError

    mat5.check(path)
    try:
        # Variables that SciPy leaves out are named where they are asked for.
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            content = _flat(pymatreader.read_mat(path))
    except (MatReadError, UnboundLocalError) as error:  # SciPy knows not all classes of arrays
        raise RecordingError(f"cannot be read ({error})") from error
    if any("byte ordering" in str(one.message) for one in said):
        raise RecordingError(
            "contains numbers of a VAX or Cray (MATLAB 4), which are read wrong",
            remedy="Save it again in MATLAB: save('file.mat', '-v7.3')",
        )

    def channel(name: str) -> Channel:
        array = content[name]
        if not isinstance(array, np.ndarray):
            kind = type(array).__name__
            raise RecordingError(f"{name!r} is a {kind}, must be an array of real numbers")
        return array_channel(name, array)

    return Contents(tuple(content), channel)


def _flat(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Variables by name; the fields of structures have names such as `structure.field`."""
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        elif not name.startswith("__"):
            flat[f"{prefix}{name}"] = value
    return flat
