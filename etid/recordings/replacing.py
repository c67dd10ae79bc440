"""Writing of a file completely or not at all."""

import contextlib
import os
import pathlib
import secrets
from collections.abc import Iterator

from etid.recordings.errors import RecordingError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Path of a temporary file for the block; it replaces the target when the block succeeds.

    The temporary file is in the folder of the target. Its name is new in each call, because several
    processes may write the same file. It has the suffix of the target, because some writers choose
    the format by the suffix.

    Args:
        path: Path of the target. An existing file is replaced at the end.

    Raises:
        RecordingError: The block or the renaming raised an OSError.
    """
    name = os.fspath(path)
    target = pathlib.Path(name)
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}")
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        raise RecordingError(
            f"cannot be written ({error})",
            file=name,
            remedy="Check folder, permissions and disk space",
        ) from error
    finally:
        with contextlib.suppress(OSError):  # the file may not exist
            partial.unlink(missing_ok=True)
