"""Reader for NumPy archives: named arrays, or converter codes with all fields of the recordings."""

import contextlib
import math
import pathlib
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from etid.files.channel import Channel, Contents, array_channel, chosen
from etid.recordings import limits
from etid.recordings.recording import Recording, RecordingError, Samples

KEYS = ("adc_th", "adc_out", "adc_ref", "R_ref", "fs", "f0", "lsb", "scale")


@contextlib.contextmanager
def _archive(path: pathlib.Path) -> Iterator[Any]:
    """The archive; `np.load` would leave a damaged file open."""
    if not zipfile.is_zipfile(path):
        raise RecordingError("is not an npz file")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        yield archive


def is_complete(path: pathlib.Path) -> bool:
    """Whether an archive has all fields of its recordings, under the names of `recordings`."""
    with _archive(path) as archive:
        return all(key in archive.files for key in KEYS[:2])


@contextlib.contextmanager
def opened(path: pathlib.Path, folder: pathlib.Path) -> Iterator[Contents]:
    """Arrays of any other archive; each is a channel of shape (time,) or (trial, time)."""
    del folder
    with _archive(path) as archive:

        def channel(name: str) -> Channel:
            _check_size(archive, name)
            return array_channel(name, np.atleast_1d(archive[name]))

        yield Contents(tuple(archive.files), channel)


def recordings(path: pathlib.Path, labels: Mapping[str, Any]) -> list[Recording]:
    """All recordings of an archive, with these labels.

    `adc_th`, `adc_out` (trial, time) and `adc_ref` (resistor, time) are converter codes. `R_ref`
    has the resistance of each resistor. `fs`, `f0`, `lsb` and `scale` are numbers. The recordings
    are `calibration/0`, … and `loaded/0`, …. The archive has no unloaded records for the
    calibrations, so all calibrations share `adc_th[0]`.
    """
    with _archive(path) as archive:
        for key in KEYS:
            chosen(archive.files, key, key)
            _check_size(archive, key)
        held = {key: archive[key] for key in KEYS}
    th, out, ref, r_ref = (held[key] for key in ("adc_th", "adc_out", "adc_ref", "R_ref"))
    if th.ndim != 2 or th.shape != out.shape or ref.ndim != 2 or r_ref.shape != ref.shape[:1]:
        shapes = ", ".join(f"{key} {held[key].shape}" for key in KEYS[:4])
        raise RecordingError(
            f"shapes do not fit each other: {shapes}",
            remedy="adc_th and adc_out are (trial, time), adc_ref (resistor, time), "
            "R_ref (resistor,)",
        )
    for key in ("adc_th", "adc_out", "adc_ref"):
        if held[key].dtype.kind not in "iu" or held[key].dtype != th.dtype:
            raise RecordingError(
                f"has dtype {held[key].dtype}; all codes must have the same integer dtype",
                field=key,
            )
    rate, pulses, step, scale = (_number(held[key], key) for key in KEYS[4:])
    if scale == 0:
        raise RecordingError("is 0", field="scale")
    conversion = step / scale
    codes = np.iinfo(th.dtype)
    common: dict[str, Any] = {
        "sample_rate": rate,
        "pulse_rate": pulses,
        **labels,
        "adc_range": (codes.min * conversion, codes.max * conversion),
    }
    first = Samples(th[0], conversion)
    calibrations = [
        Recording(
            first,
            Samples(record, conversion),
            r_load=r_ref[index],
            path=f"calibration/{index}",
            **common,
        )
        for index, record in enumerate(ref)
    ]
    paths = tuple(recording.path for recording in calibrations)
    loaded = [
        Recording(
            Samples(th[trial], conversion),
            Samples(out[trial], conversion),
            trial=trial,
            calibration=paths,
            path=f"loaded/{trial}",
            **common,
        )
        for trial in range(len(out))
    ]
    return calibrations + loaded


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
