"""Reader for NumPy archives: named arrays, or converter codes with all fields of the recordings."""

import contextlib
import math
import pathlib
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from etid.files.channel import Channel, Contents, array_channel, chosen
from etid.recordings import limits
from etid.recordings.recording import RecordingError

CODES = ("adc_th", "adc_out", "adc_ref")
KEYS = (*CODES, "R_ref", "fs", "f0", "lsb", "scale")


@contextlib.contextmanager
def _archive(path: pathlib.Path) -> Iterator[Any]:
    """The archive; `np.load` would leave a damaged file open."""
    if not zipfile.is_zipfile(path):
        raise RecordingError("is not an npz file")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        yield archive


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Arrays of an archive; each is a channel of shape (time,) or (trial, time)."""
    del folder
    with _archive(path) as archive:

        def channel(name: str) -> Channel:
            _check_size(archive, name)
            codes = name in CODES and _is_complete(archive)
            own = {"conversion": _volts(archive), "unit": "V"} if codes else {}
            return array_channel(name, np.atleast_1d(archive[name]), **own)

        yield Contents(tuple(archive.files), channel)


def own_mapping(path: pathlib.Path) -> dict[str, Any] | None:
    """Mapping for an archive that contains all fields of its recordings; None for another one.

    `adc_th`, `adc_out` (trial, time) and `adc_ref` (resistor, time) are converter codes. `R_ref`
    has the resistance of each resistor. `fs`, `f0`, `lsb` and `scale` are numbers. The recordings
    are `calibration/0`, … and `loaded/0`, …. The archive has no unloaded records for the
    calibrations, so all calibrations share `adc_th[0]`.
    """
    with _archive(path) as archive:
        if not _is_complete(archive):
            return None
        for key in KEYS:
            chosen(archive.files, key, key)
            _check_size(archive, key)
        th, out, ref, r_ref = (archive[key] for key in KEYS[:4])
        rate, pulses = (_number(archive[key], key) for key in ("fs", "f0"))
        volts = _volts(archive)
    if th.ndim != 2 or th.shape != out.shape or ref.ndim != 2 or r_ref.shape != ref.shape[:1]:
        shapes = ", ".join(
            f"{key} {array.shape}" for key, array in zip(KEYS, (th, out, ref, r_ref), strict=False)
        )
        raise RecordingError(
            f"shapes do not fit each other: {shapes}",
            remedy="adc_th and adc_out are (trial, time), adc_ref (resistor, time), "
            "R_ref (resistor,)",
        )
    for key, codes in zip(CODES, (th, out, ref), strict=True):
        if codes.dtype.kind not in "iu" or codes.dtype != th.dtype:
            raise RecordingError(
                f"has dtype {codes.dtype}; all codes must have the same integer dtype", field=key
            )
    range_of = np.iinfo(th.dtype)
    paths = [f"calibration/{number}" for number in range(len(ref))]
    calibrations = [
        {
            "path": path,
            "r_load": r_ref[number],
            "v_th": {"channel": "adc_th", "rows": 0},
            "v_out": {"channel": "adc_ref", "rows": number},
        }
        for number, path in enumerate(paths)
    ]
    both = {"v_th": {"channel": "adc_th"}, "v_out": {"channel": "adc_out"}}
    return {
        "sample_rate": rate,
        "pulse_rate": pulses,
        "scale": 1.0,  # that of the archive is in its channels
        "adc_range": (range_of.min * volts, range_of.max * volts),
        "recording": [*calibrations, {"path": "loaded", "calibration": paths, **both}],
    }


def _is_complete(archive: Any) -> bool:
    return all(key in archive.files for key in CODES[:2])


def _volts(archive: Any) -> float:
    """Volts at the terminal per code."""
    step, scale = (_number(archive[key], key) for key in ("lsb", "scale"))
    if scale == 0:
        raise RecordingError("is 0", field="scale")
    return step / scale


def _check_size(archive: Any, key: str) -> None:
    """Raise an error if an array declares more data than the archive holds, before allocation."""
    info = archive.zip.getinfo(f"{key}.npy")
    with archive.zip.open(info) as member:
        version = np.lib.format.read_magic(member)
        head = np.lib.format.read_array_header_1_0 if version == (1, 0) else (
            np.lib.format.read_array_header_2_0
        )  # fmt: skip
        shape, _, dtype = head(member)
        declared = math.prod(shape) * dtype.itemsize + member.tell()
    if dtype.hasobject:
        return  # NumPy refuses this array
    unpacked = max(limits.FREE, limits.COMPRESSION * info.compress_size)
    if declared != info.file_size or declared > unpacked or min(shape, default=1) < 0:
        raise RecordingError(
            f"declares {dtype} of shape {shape}, but has {info.file_size} bytes",
            field=key,
            remedy="The file is damaged: copy or write it again",
        )


def _number(array: npt.NDArray, field: str) -> float:
    if array.size != 1 or array.dtype.kind not in "iuf":
        raise RecordingError(f"is {array!r}, must be one number", field=field)
    return float(array.item())
