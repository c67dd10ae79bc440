"""Reader for MATLAB files.

Version 7.3 is HDF5 and is read in blocks. Earlier versions are read completely. Channels have the
names that MATLAB has for them: `a.b` is field b of structure a, `a(2).b` that of the second of an
array of structures, `c{3}` the third cell, and `m(:,2)` the second column of a matrix. Of a whole
matrix, rows are trials and columns are times.
"""

import contextlib
import dataclasses
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
import scipy.io
from h5py import h5o  # type: ignore[attr-defined]  # compiled, without stubs

from etid.files.channel import Channel, Contents
from etid.files.readers import Reader
from etid.recordings import limits
from etid.recordings.errors import RecordingError
from etid.recordings.untrusted import attribute, check_size, guarded, local_link


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Channels of a MATLAB file of any version."""
    del folder
    if h5py.is_hdf5(path):
        # A chunk holds several trials, which are read one by one.
        with guarded(str(path), rdcc_nbytes=1 << 25) as file:
            yield _contents(_hdf5(file))
    else:
        yield _contents(_whole(path))


@dataclasses.dataclass(frozen=True)
class _Variable:
    """A variable of a file, or a part of one.

    Attributes:
        shape: Its shape in MATLAB, without axes of one element.
        dtype: Type of its elements.
        part: Function of one index for each axis; it returns these elements.
        kind: What it is, if it is no array of numbers; empty if it is one.
        check: Function that raises an error if the file does not hold its elements.
    """

    shape: tuple[int, ...] = ()
    dtype: np.dtype = dataclasses.field(default_factory=lambda: np.dtype(float))
    part: Callable[[tuple[int | slice, ...]], np.ndarray] = lambda index: np.empty(0)
    kind: str = ""
    check: Callable[[], None] = lambda: None


def _contents(variables: dict[str, _Variable]) -> Contents:
    """Channels of the variables; those of a matrix are also its rows or columns, if fewer."""
    lines: dict[str, tuple[str, int, int]] = {}  # variable, axis, place on it
    for name, one in variables.items():
        if len(one.shape) == 2 and 0 < min(one.shape) <= limits.NAMES:
            axis = int(one.shape[1] < one.shape[0])
            written = "{}(:,{})" if axis else "{}({},:)"
            lines |= {
                written.format(name, place + 1): (name, axis, place)
                for place in range(one.shape[axis])
            }

    def channel(name: str) -> Channel:
        variable, axis, place = lines.get(name, (name, 0, 0))
        one = variables[variable]
        kind = one.kind or ("one number" if one.shape == () else "")
        if kind:
            raise RecordingError(f"{name!r} is {kind}, must be an array of real numbers")
        one.check()

        def read(trial: int, start: int, stop: int) -> np.ndarray:
            index: tuple[int | slice, ...] = (slice(start, stop),)
            if name in lines:
                index = (*index, place) if axis else (place, *index)
            elif len(one.shape) == 2:
                index = (trial, *index)
            return one.part(index)

        shape = (one.shape[1 - axis],) if name in lines else one.shape
        return Channel(name, shape, one.dtype, read)

    return Contents((*variables, *lines), channel)


def _hdf5(file: h5py.File) -> dict[str, _Variable]:
    """Variables of version 7.3: HDF5 with reversed axes; names with `#` are internal to MATLAB.

    Cells, and the fields of an array of structures, are references to objects in `#refs#`.
    """
    found: dict[str, _Variable] = {}
    walked: set[int] = set()  # addresses, because links and references may form a loop

    def add(member: Any, name: str, of: str = "", field: str = "") -> None:
        """Add an object of this name, which may be a field of a structure."""
        if name.count(".") + name.count("{") > limits.DEPTH:
            raise RecordingError(f"has structures nested more than {limits.DEPTH} deep")
        references = isinstance(member, h5py.Dataset) and h5py.check_ref_dtype(member.dtype)
        if isinstance(member, h5py.Group) or references:
            address = h5o.get_info(member.id).addr
            if address in walked:
                return
            walked.add(address)
        if isinstance(member, h5py.Group):
            names: Any = list(member)
            for each in names:
                if not each.startswith("#"):
                    local_link(member, each)
                    add(member.get(each), f"{name}.{each}" if name else each, name, each)
        elif references:
            check_size(member)
            if (member.size or 0) > limits.TRIALS:
                raise RecordingError(f"{name!r} has {member.size} cells, too many")
            cells = _class(member) == "cell"
            for number, one in enumerate(np.ravel(member[()]), 1):
                whole = f"{name}{{{number}}}" if cells else f"{of}({number}).{field}"
                if one:
                    add(file[one], whole, f"{of}({number})", field)
        elif isinstance(member, h5py.Dataset):
            found[name] = _dataset(member)

    add(file, "")
    return found


def _class(data: h5py.Dataset) -> str:
    """MATLAB's class of a dataset; empty if it has none."""
    kind = attribute(data, "MATLAB_class") if "MATLAB_class" in data.attrs else b""
    return kind.decode() if isinstance(kind, bytes) else str(kind)


def _dataset(data: h5py.Dataset) -> _Variable:
    kind = _class(data)
    if kind in ("char", "logical", "cell"):
        return _Variable(kind=f"a {kind} array")
    if "MATLAB_empty" in data.attrs or data.shape is None:
        return _Variable(kind="empty")
    # Axes in MATLAB's order; those of one element are left out.
    axes = [axis for axis, size in enumerate(data.shape) if size != 1][::-1]

    def part(index: tuple[int | slice, ...]) -> np.ndarray:
        place: list[int | slice] = [0] * data.ndim
        for axis, one in zip(axes, index, strict=True):
            place[axis] = one
        return data[tuple(place)]

    shape = tuple(data.shape[axis] for axis in axes)
    return _Variable(shape, data.dtype, part, check=lambda: check_size(data))


def _whole(path: pathlib.Path) -> dict[str, _Variable]:
    """Variables of version 5 and older."""
    try:
        # Variables that SciPy leaves out are named where they are asked for.
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            content = scipy.io.loadmat(path)
    except (scipy.io.matlab.MatReadError, UnboundLocalError) as error:  # an unknown class of array
        raise RecordingError(f"cannot be read ({error})") from error
    if any("byte ordering" in str(one.message) for one in said):
        raise RecordingError(
            "contains numbers of a VAX or Cray (MATLAB 4), which are read wrong",
            remedy="Save it again in MATLAB: save('file.mat', '-v7.3')",
        )
    return {
        part: variable
        for name, value in content.items()
        if not name.startswith("__")
        for part, variable in _parts(name, value)
    }


def _parts(name: str, value: Any) -> Iterator[tuple[str, _Variable]]:
    """The fields of structures and the cells of a value of SciPy, by name."""
    if not isinstance(value, np.ndarray) or type(value) is not np.ndarray:
        yield name, _Variable(kind=f"a {type(value).__name__}")
    elif value.dtype.names is not None:
        for number, one in enumerate(value.ravel("F"), 1):
            prefix = name if value.size == 1 else f"{name}({number})"
            for field in value.dtype.names:
                yield from _parts(f"{prefix}.{field}", one[field])
    elif value.dtype == object:
        for number, one in enumerate(value.ravel("F"), 1):
            yield from _parts(f"{name}{{{number}}}", one)
    elif value.dtype.kind in "US":
        yield name, _Variable(kind="a text")
    else:
        array = value.squeeze()
        yield name, _Variable(array.shape, array.dtype, array.__getitem__)


READER = Reader(
    (".mat",),
    opened,
    "variables of MATLAB: `a.b` for field b of structure a, `a(2).b` in an array of structures, "
    "`c{3}` for a cell, `m(:,2)` for a column of a matrix",
    trials="rows",
)
