"""The formats of files that the import reads, each declared once.

The reader, the page of the schema, the help of the command, the docstring of `etid.import_file` and
the errors take a format from here.
"""

import contextlib
import dataclasses
import pathlib
import textwrap
from collections.abc import Callable

from etid.files.channel import Contents
from etid.files.readers import abf, delimited, excel, lvm, matlab, npz, tdms, wav
from etid.recordings.errors import RecordingError
from etid.recordings.replacing import HDF5


@dataclasses.dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes:
        suffixes: Suffixes of the names of its files.
        opened: The reader (`etid.files.readers`).
        channels: What its channels are, in Markdown.
        contains: What a file says of its channels.
        trials: What of a channel becomes trials.
        extra: Extra of etid with the package that the reader needs; empty if it needs none.
        dialect: Whether the user may tell how the text is written (`delimited.Dialect`).
    """

    suffixes: tuple[str, ...]
    opened: Callable[..., contextlib.AbstractContextManager[Contents]]
    channels: str
    contains: str
    trials: str
    extra: str = ""
    dialect: bool = False


FORMATS = (
    Format(
        (".csv", ".txt", ".dat"),
        delimited.opened,
        "columns of a table of text, by the line with their names",
        "units: `open [mV]`, or a second line of them",
        "none",
        dialect=True,
    ),
    Format(
        (".mat",),
        matlab.opened,
        "variables of MATLAB: `a.b` for field b of structure a, `a(2).b` in an array of "
        "structures, `c{3}` for a cell, `m(:,2)` for a column of a matrix",
        "nothing",
        "rows",
    ),
    Format(
        (".tdms",),
        tdms.opened,
        "`group/channel` of NI files",
        "units (`unit_string`), rate (`wf_increment`)",
        "none",
        "tdms",
    ),
    Format(
        (".abf",),
        abf.opened,
        "ADC channels of Axon files, or `channel 0`, …",
        "units and rate",
        "sweeps",
        "abf",
    ),
    Format((".npz",), npz.opened, "arrays of NumPy", "nothing", "rows"),
    Format((".wav",), wav.opened, "`1`, `2`, …, as fractions of full scale", "rate", "none"),
    Format(
        (".lvm",),
        lvm.opened,
        "columns of LabVIEW, one header per file",
        "units, rate (`Delta_X`)",
        "none",
    ),
    Format(
        (".xlsx",),
        excel.opened,
        "columns of Excel; further sheets `sheet/column`",
        "units as in a table of text",
        "none",
        "excel",
    ),
)
SUFFIXES = tuple(suffix for one in FORMATS for suffix in one.suffixes)
OF_TEXT = tuple(suffix for one in FORMATS if one.dialect for suffix in one.suffixes)
EXTRAS = tuple(one.extra for one in FORMATS if one.extra)


def format_of(path: pathlib.Path) -> Format:
    """The format of a file, by its suffix.

    Raises:
        RecordingError: No format has this suffix.
    """
    suffix = path.suffix.lower()
    for one in FORMATS:
        if suffix in one.suffixes:
            return one
    if suffix in HDF5:
        raise RecordingError(
            "is an HDF5 file; one that etid has written needs no import",
            file=str(path),
            remedy=f"Use it as it is, as in etid check {path}; write that of another program anew, "
            "as data_schema/README.md shows",
        )
    raise RecordingError(
        f"etid cannot import files with the suffix {path.suffix!r}",
        file=str(path),
        remedy=f"Export it as one of {', '.join(SUFFIXES)}, name a table of text .txt, or write an "
        "etid file with h5py",
    )


def as_list() -> str:
    """The formats as a list in Markdown."""
    lines = []
    for one in FORMATS:
        suffixes = ", ".join(f"`{suffix}`" for suffix in one.suffixes)
        extra = f" They need the extra `{one.extra}`." if one.extra else ""
        lines.append(textwrap.fill(f"- {suffixes}: {one.channels}.{extra}", subsequent_indent="  "))
    return "\n".join(lines)


def as_table() -> str:
    """The formats as a table in Markdown."""
    lines = ["| file | channels | the file contains | trials | install |", "|---|---|---|---|---|"]
    for one in FORMATS:
        suffixes = ", ".join(f"`{suffix}`" for suffix in one.suffixes)
        extra = f"`.[{one.extra}]` " if one.extra else ""
        lines.append(f"| {suffixes} | {one.channels} | {one.contains} | {one.trials} | {extra}|")
    return "\n".join(lines)
