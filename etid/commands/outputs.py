"""Checks on the files that a command will write, before its work begins."""

import pathlib
from collections.abc import Mapping

from etid.recordings.replacing import check_ending


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
        if path.exists() and not path.is_file():  # it would be replaced
            raise ValueError(f"{path}: this is a device or a pipe; name a file")
        if not path.absolute().parent.is_dir():
            raise ValueError(f"{path}: the folder of this file does not exist")
        check_ending(path, endings)
        if path.exists() and not force:
            raise ValueError(f"{path}: this file exists; add --force to replace it")
