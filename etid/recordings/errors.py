"""The error that says where something is wrong, what, and what to do."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator


class RecordingError(ValueError):
    """Something is wrong with a recording or its file; says where, what, and what to do.

    Attributes:
        message: What was found and what was expected.
        file: Path of the file; empty for a recording in memory.
        path: HDF5 path of the recording inside the file.
        field: Name of the attribute, dataset or argument.
        remedy: What to do about it.
    """

    def __init__(
        self, message: str, *, file: str = "", path: str = "", field: str = "", remedy: str = ""
    ) -> None:
        super().__init__(message)
        self.message = message
        self.file = file
        self.path = path
        self.field = field
        self.remedy = remedy

    def __str__(self) -> str:
        place = ", ".join(
            part for part in (self.file, repr(self.path) if self.path else "", self.field) if part
        )
        text = f"{place}: {self.message}" if place else self.message
        return f"{text}. {self.remedy}." if self.remedy else f"{text}."

    def __reduce__(self) -> tuple:
        # exceptions pickle by their positional arguments alone; workers send these across processes
        return (_rebuild_error, (self.message, self.file, self.path, self.field, self.remedy))

    def located(self, *, file: str = "", path: str = "", field: str = "") -> "RecordingError":
        """The same error with the parts of its place that it did not know yet."""
        return RecordingError(
            self.message,
            file=self.file or file,
            path=self.path or path,
            field=self.field or field,
            remedy=self.remedy,
        )


def _rebuild_error(message: str, file: str, path: str, field: str, remedy: str) -> RecordingError:
    return RecordingError(message, file=file, path=path, field=field, remedy=remedy)


@contextlib.contextmanager
def located(
    file: str = "",
    path: str = "",
    field: str = "",
    *,
    foreign: tuple[type[Exception], ...] = (),
    message: str = "cannot be read",
    remedy: str = "",
) -> Iterator[None]:
    """Give an error of this block its place, and make a `RecordingError` of a library's error.

    Args:
        file: Path of the file.
        path: HDF5 path of the recording.
        field: Name of the attribute, dataset or argument.
        foreign: Errors of a library.
        message: What such an error means; its own text stands behind.
        remedy: What to do about it.

    Raises:
        RecordingError: In place of every error of the block; one of etid keeps its text.
    """
    try:
        yield
    except RecordingError as error:
        raise error.located(file=file, path=path, field=field) from None
    except foreign as error:
        raise RecordingError(
            f"{message} ({type(error).__name__}: {error})",
            file=file,
            path=path,
            field=field,
            remedy=remedy,
        ) from error


def near_miss(name: str, known: Iterable[str]) -> str | None:
    """The known name that an unknown one was probably meant to be."""
    simple = {_simple(other): other for other in known}
    close = difflib.get_close_matches(_simple(name), simple, n=1, cutoff=0.8)
    return simple[close[0]] if close else None


def _simple(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")
