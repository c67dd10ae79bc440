"""The error that names the place of a fault, the fault, and a remedy."""

import contextlib
import difflib
import importlib
import os
import stat
from collections.abc import Iterable, Iterator
from typing import Any


class RecordingError(ValueError):
    """Fault of a recording or its file: names the place, the fault, and a remedy.

    Attributes:
        message: The fault: what was found and what was expected.
        file: Path of the file; empty for a recording in memory.
        path: HDF5 path of the recording in the file.
        field: Name of the attribute, dataset or argument.
        remedy: What the user can do.
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
        return " ".join(map(_ended, filter(None, (text, self.remedy))))

    def located(self, *, file: str = "", path: str = "", field: str = "") -> "RecordingError":
        """The same error; parts of its place that are empty are filled in."""
        return RecordingError(
            self.message,
            file=self.file or file,
            path=self.path or path,
            field=self.field or field,
            remedy=self.remedy,
        )


def _ended(text: str) -> str:
    """A sentence with its mark at the end; a question has its own."""
    return text if text.endswith("?") else f"{text}."


def in_one_line(error: BaseException) -> str:
    """What an error and its notes say."""
    text, *notes = (" ".join(str(one).split()) for one in (error, *getattr(error, "__notes__", ())))
    return "; ".join([text.rstrip("."), *notes]).removeprefix("; ") if notes else text


def require_file(path: str) -> None:
    """Raise an error if a path is not a file that can be read; pipes and devices are not opened."""
    try:
        if stat.S_ISREG(os.stat(path).st_mode):
            with open(path, "rb"):
                return
    except (FileNotFoundError, NotADirectoryError):
        pass  # as for a folder and a pipe
    except OSError as error:
        raise RecordingError(
            f"cannot be opened ({error.strerror})",
            file=path,
            remedy="Check its name, and the permissions of the file and of its folders",
        ) from error
    raise RecordingError("there is no such file", file=path, remedy="Check the path")


def not_recorded(path: str, field: str, remedy: str) -> RecordingError:
    """The error for a record that the recording at a path does not have."""
    return RecordingError("was not recorded", path=path, field=field, remedy=remedy)


@contextlib.contextmanager
def located(
    file: str = "",
    path: str = "",
    field: str = "",
    *,
    foreign: type[Exception] | tuple[type[Exception], ...] = (),
    message: str = "cannot be read",
    remedy: str = "",
) -> Iterator[None]:
    """Add the place to an error of this block, and convert a library's error to `RecordingError`.

    Args:
        file: Path of the file.
        path: HDF5 path of the recording.
        field: Name of the attribute, dataset or argument.
        foreign: Types of a library's errors.
        message: Message for a library's error; the error's own text follows in brackets.
        remedy: Remedy for a library's error.
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
    """Known name that is similar to an unknown name; None if there is none."""
    simple = {_simple(other): other for other in known}
    close = difflib.get_close_matches(_simple(name), simple, n=1, cutoff=0.8)
    return simple[close[0]] if close else None


def _simple(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")


def install(extra: str) -> str:
    """What installs an extra of etid, as the remedy of a package that is missing."""
    return f"pip install 'etid[{extra}]' (in a clone: '.[{extra}]')"


def optional(module: str, extra: str, file: str = "", package: str = "") -> Any:
    """A module of a package that only users of one format need.

    Args:
        module: Name of the module.
        extra: Extra of etid that installs the package.
        file: The file that needs it.
        package: Name of the package if it is not that of the module.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RecordingError(
            f"needs the package {package or module}",
            file=file,
            remedy=f"Run {install(extra)}",
        ) from error
