"""Readers for files of other formats, one module per format.

A module declares its format as `READER`. `etid.files.formats` collects the readers.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

from etid.files.channel import Contents
from etid.recordings.errors import optional


@dataclasses.dataclass(frozen=True)
class Reader:
    """A format of files, and what reads it.

    Attributes:
        suffixes: Suffixes of the names of its files.
        opened: Function of a path and of a folder for temporary files; it returns the contents
            of the file for a `with` statement.
        channels: What its channels are, in Markdown.
        unit: Where a file names the units of its channels; empty if nowhere.
        rate: Where a file names its sample rate; empty if nowhere.
        trials: What of a channel becomes trials; empty if nothing.
        extra: Extra of etid that installs the package; empty if the format needs none.
        package: Package that the format needs.
        dialect: Whether the user may tell how the text is written (`delimited.Dialect`).
    """

    suffixes: tuple[str, ...]
    opened: Callable[..., contextlib.AbstractContextManager[Contents]]
    channels: str
    unit: str = ""
    rate: str = ""
    trials: str = ""
    extra: str = ""
    package: str = ""
    dialect: bool = False

    def open(
        self, path: pathlib.Path, folder: pathlib.Path, **told: Any
    ) -> contextlib.AbstractContextManager[Contents]:
        """The contents of a file.

        Raises:
            RecordingError: The package of this format is missing.
        """
        if self.package:
            optional(self.package.lower(), self.extra, str(path), self.package)
        return self.opened(path, folder, **told)
