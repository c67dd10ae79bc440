"""Writing of a file: completely or not at all, and by one process at a time."""

import contextlib
import os
import pathlib
import secrets
from collections.abc import Iterator
from typing import Any

import filelock
import h5py

from etid.recordings.errors import RecordingError

HDF5 = (".h5", ".hdf5", ".hdf")


def check_ending(path: str | os.PathLike[str], endings: tuple[str, ...] = HDF5) -> None:
    """Raise an error if the name of a file says another format."""
    file = pathlib.Path(path)
    suffix = file.suffix.lower()
    # Formats that etid reads or writes, and formats that people expect of it.
    formats = {
        *(*HDF5, ".csv", ".txt", ".json", ".toml", ".parquet", ".nwb", ".cir", ".html", ".htm"),
        *(".mat", ".tdms", ".npz", ".npy", ".wav", ".lvm", ".xls", ".xlsx", ".dat"),
        *(".abf", ".rhd", ".rhs", ".smr", ".pdf", ".png", ".svg"),
    }
    if suffix in formats and suffix not in endings:
        name = file.with_suffix(endings[0]).name
        raise RecordingError(f"the file is not written as {suffix}; name it {name}", file=str(file))


def unwritable(path: str | os.PathLike[str], error: OSError) -> RecordingError:
    """The error for a file that the operating system does not let us write."""
    return RecordingError(
        f"cannot be written ({error.strerror or error})",
        file=os.fspath(path),
        remedy="Check folder, permissions and disk space",
    )


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Path of a temporary file for the block; it replaces the target when the block succeeds.

    The temporary file is in the folder of the target. Its name is new in each call, because several
    processes may write the same file. It has the suffix of the target, because some writers choose
    the format by the suffix. A link stays a link: the file that it leads to is the target.
    """
    name = os.fspath(path)
    target = pathlib.Path(os.path.realpath(name))
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as written:
            os.fsync(written)  # some file systems say only now that they are full
        os.replace(partial, target)
    except OSError as error:
        raise unwritable(name, error) from error
    finally:
        with contextlib.suppress(OSError):  # the file may not exist
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file to write; it replaces the target when the block succeeds.

    The library writes through a file of Python. If a write to a file of its own fails, it cannot
    close that file any more, and ends the process with a segmentation fault.
    """
    with (
        replacing(path) as partial,
        open(partial, "xb+") as raw,
        h5py.File(raw, "w", **options) as file,
    ):
        yield file


def replace_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text as a file; an existing file is replaced at the end."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def claimed(path: str | os.PathLike[str]) -> Iterator[None]:
    """Refuse the block if another process is in such a block for the same file.

    The lock is the empty file `.NAME.lock` beside it. It ends with the process, so one that a
    killed process has left locks nothing.
    """
    target = pathlib.Path(path)
    lock = filelock.FileLock(target.with_name(f".{target.name}.lock"), timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise RecordingError(
            "another program is writing it",
            file=str(target),
            remedy="Wait until it has ended, or name another file",
        ) from None
    except OSError as error:
        raise unwritable(target, error) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows removes it when it is free
            os.unlink(lock.lock_file)
        lock.release()
