"""Checks on the files that a command will write, before its work begins."""

import pathlib
from collections.abc import Mapping

HDF5 = (".h5", ".hdf5", ".hdf")

# Endings of the formats that etid reads or writes, and of formats that people expect of it.
_FORMATS = {
    *(*HDF5, ".csv", ".txt", ".json", ".toml", ".parquet", ".nwb", ".cir", ".html", ".htm", ".pdf"),
    *(".mat", ".tdms", ".abf", ".npz", ".npy", ".wav", ".lvm", ".xls", ".xlsx", ".png", ".svg"),
}


def check_outputs(outputs: Mapping[pathlib.Path, tuple[str, ...]], *, force: bool) -> None:
    """Raise an error if a file cannot be written, or would be overwritten.

    Args:
        outputs: The endings that the name of each file may have. A name without the ending of a
            known format is always right.
        force: Whether existing files may be replaced.

    Raises:
        ValueError: The folder of a file does not exist, the ending of its name says another format,
            or the file exists and `force` is not set.
    """
    for path, endings in outputs.items():
        if path.is_dir():
            raise ValueError(f"{path}: this is a folder; name a file")
        if not path.absolute().parent.is_dir():
            raise ValueError(f"{path}: the folder of this file does not exist")
        suffix = path.suffix.lower()
        if suffix in _FORMATS and suffix not in endings:
            name = path.with_suffix(endings[0]).name
            raise ValueError(f"{path}: the file is not written as {suffix}; name it {name}")
        if path.exists() and not force:
            raise ValueError(f"{path}: this file exists; add --force to replace it")
