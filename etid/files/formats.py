"""The formats of files that the import reads, and what other programs can export.

The page of the schema, the help of the command, the docstring of `etid.import_file` and the errors
are made from what each reader declares.
"""

import pathlib
import textwrap

from etid.files.readers import (
    Reader,
    delimited,
    electrophysiology,
    excel,
    lvm,
    matlab,
    npz,
    tdms,
    wav,
)
from etid.recordings.errors import RecordingError
from etid.recordings.replacing import HDF5

READERS: tuple[Reader, ...] = tuple(
    module.READER for module in (delimited, matlab, tdms, electrophysiology, npz, wav, lvm, excel)
)
SUFFIXES = tuple(suffix for one in READERS for suffix in one.suffixes)
OF_TEXT = tuple(suffix for one in READERS if one.dialect for suffix in one.suffixes)

# Suffixes of known files that etid cannot read: what writes them, and what to export instead.
EXPORTS = {
    ".smrx": ("Spike2", ".smr, or as .mat"),
    ".plx .pl2": ("Plexon", ".mat, as with NeuroExplorer"),
    ".ns1 .ns2 .ns3 .ns4 .ns5 .ns6 .nev": ("Blackrock", ".mat, as with NPMK"),
    ".adicht": ("LabChart", ".mat or .txt"),
    ".acq": ("AcqKnowledge", ".mat or .txt"),
    ".cfs": ("Signal", ".mat or .txt"),
    ".wcp .edr": ("WinWCP or WinEDR", ".abf"),
    ".vhdr .vmrk .eeg .edf .bdf": ("an EEG system", ".mat or .csv"),
    ".wfm .isf .trc": ("an oscilloscope", ".csv"),
    ".mf4 .mdf": ("a data logger", ".mat or .csv"),
    ".tdm .tdx": ("DIAdem", ".tdms"),
    ".xls .xlsm .ods": ("a spreadsheet", ".xlsx"),
    ".npy .parquet .pkl": ("Python", ".npz, with numpy.savez"),
}


def reader_of(path: pathlib.Path) -> Reader:
    """The reader of a file, by its suffix.

    Raises:
        RecordingError: No format has this suffix.
    """
    suffix = path.suffix.lower()
    for one in READERS:
        if suffix in one.suffixes:
            return one
    if suffix in HDF5:
        raise RecordingError(
            "is an HDF5 file; one that etid has written needs no import",
            file=str(path),
            remedy=f"Use it as it is, as in etid check {path}; write that of another program anew, "
            "as data_schema/README.md shows",
        )
    for suffixes, (program, others) in EXPORTS.items():
        if suffix in suffixes.split():
            raise RecordingError(
                f"is a file of {program}, which etid cannot read",
                file=str(path),
                remedy=f"Export it as {others}",
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
    for one in READERS:
        extra = f" They need the extra `{one.extra}`." if one.extra else ""
        text = f"- {_suffixes(one)}: {one.channels}.{extra}"
        lines.append(textwrap.fill(text, subsequent_indent="  "))
    return "\n".join(lines)


def as_table() -> str:
    """The formats as a table in Markdown."""
    head = ("file", "channels", "unit in the file", "rate in the file", "trials", "install")
    rows = [head, ("---",) * len(head)]
    for one in READERS:
        extra = f"`.[{one.extra}]`" if one.extra else ""
        known = (cell or "no" for cell in (one.unit, one.rate, one.trials))
        rows.append((_suffixes(one), one.channels, *known, extra))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _suffixes(one: Reader) -> str:
    return ", ".join(f"`{suffix}`" for suffix in one.suffixes)
