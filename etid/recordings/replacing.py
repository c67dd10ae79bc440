"""Files are written whole or not at all."""

import contextlib
import os
import pathlib
import secrets
from collections.abc import Iterator

from etid.recordings.errors import RecordingError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """Give a temporary name beside a file, and rename it to the file when the block succeeds.

    The name is new in each call, because several processes may write the same file. It keeps the
    suffix, because some writers choose the format by it.

    Args:
        path: The file; one that exists is replaced at the end.

    Raises:
        RecordingError: The block or the renaming has raised an OSError.
    """
    name = os.fspath(path)
    target = pathlib.Path(name)
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}")
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        raise RecordingError(
            f"cannot be written ({error})", file=name, remedy="Check folder, rights and disk space"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # where nothing can be written, there is no such file
            partial.unlink(missing_ok=True)
