"""Writing of a file: completely or not at all, and by one process at a time."""

import contextlib
import os
import pathlib
import platform
import secrets
from collections.abc import Iterator
from typing import Any

import h5py

from etid.recordings.errors import RecordingError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

HDF5 = (".h5", ".hdf5", ".hdf")
OWNER = "process "  # the first word in a lock, before its number


def check_ending(path: str | os.PathLike[str], endings: tuple[str, ...] = HDF5) -> None:
    """Raise an error if the name of a file says another format."""
    file = pathlib.Path(path)
    suffix = file.suffix.lower()
    # Formats that etid reads or writes, and formats that people expect of it.
    formats = {
        *(*HDF5, ".csv", ".txt", ".json", ".toml", ".parquet", ".nwb", ".cir", ".html", ".htm"),
        *(".mat", ".tdms", ".abf", ".npz", ".npy", ".wav", ".lvm", ".xls", ".xlsx"),
        *(".pdf", ".png", ".svg"),
    }
    if suffix in formats and suffix not in endings:
        name = file.with_suffix(endings[0]).name
        raise RecordingError(f"the file is not written as {suffix}; name it {name}", file=str(file))


def unwritable(path: str | os.PathLike[str], error: OSError) -> RecordingError:
    """The error for a file that the operating system does not let us write."""
    return RecordingError(
        f"cannot be written ({error})",
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

    The operating system locks `path.lock` during the block. It ends the lock with the process, so a
    file that a killed process has left locks nothing. Where there are no locks, as on some network
    file systems, no process is refused.
    """
    target = pathlib.Path(path)
    lock = target.with_name(f"{target.name}.lock")
    held = _locked(lock, target)
    before = os.read(held, len(OWNER))
    if before not in (b"", OWNER.encode()):
        os.close(held)
        raise RecordingError(
            f"{lock.name} beside it is no lock of etid",
            file=str(target),
            remedy="Move or rename that file, or name another file to write",
        )
    with contextlib.suppress(OSError):  # on a full disk the lock holds, but names nobody
        os.truncate(held, 0)
        os.lseek(held, 0, os.SEEK_SET)
        os.write(held, f"{OWNER}{os.getpid()} on {platform.node()}".encode())
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(held)


def _locked(lock: pathlib.Path, target: pathlib.Path) -> int:
    """Descriptor of the lock file, locked."""
    while True:
        try:
            held = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise unwritable(target, error) from error
        try:
            if fcntl is not None:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(held, 1000).decode("utf-8", "replace")
            os.close(held)
            raise RecordingError(
                f"{owner or 'another process'} is writing it",
                file=str(target),
                remedy="Wait until it has ended, or name another file",
            ) from None
        except OSError:  # this file system has no locks
            return held
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(held), os.stat(lock)):
                return held
        os.close(held)  # its process has ended and removed it since it was opened
