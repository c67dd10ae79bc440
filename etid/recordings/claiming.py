"""One process at a time computes a file."""

import contextlib
import os
import pathlib
import platform
from collections.abc import Iterator

from etid.recordings.errors import RecordingError
from etid.recordings.replacing import unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


@contextlib.contextmanager
def claimed(path: str | os.PathLike[str]) -> Iterator[None]:
    """Refuse the block if another process is in such a block for the same file.

    The operating system locks `path.lock` during the block. It ends the lock with the process, so a
    file that a killed process has left locks nothing. Where there are no locks, as on some network
    file systems, no process is refused.

    Args:
        path: File that the block computes.

    Raises:
        RecordingError: Another process computes the file, or its folder cannot be written.
    """
    target = pathlib.Path(path)
    lock = target.with_name(f"{target.name}.lock")
    held = _locked(lock, target)
    with contextlib.suppress(OSError):  # on a full disk the lock holds, but names nobody
        os.truncate(held, 0)
        os.write(held, f"process {os.getpid()} on {platform.node()}".encode())
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(held)


def _locked(lock: pathlib.Path, target: pathlib.Path) -> int:
    """Descriptor of the lock file, locked.

    Raises:
        RecordingError: As `claimed`.
    """
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
