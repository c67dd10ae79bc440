"""Convert laboratory files, or a folder of them, to an etid file."""

import argparse
import dataclasses
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from etid.commands import Outcome
from etid.files import formats
from etid.files.folder import import_folder
from etid.files.importing import import_file, resistors
from etid.files.mapping import CHANNELS, FIELDS
from etid.files.readers.delimited import DIALECT
from etid.recordings.errors import RecordingError
from etid.recordings.fields import DECLARED, SIGNALS
from etid.recordings.replacing import HDF5
from etid.recordings.resistance import number

__doc__ = f"{__doc__}\n\nSuffixes of the files: {', '.join(formats.SUFFIXES)}."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the files, the mapping, the channels, and the fields."""
    parser.add_argument(
        "source",
        type=pathlib.Path,
        nargs="+",
        metavar="FILE",
        help="files to import into one file, or a folder of them",
    )
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="STUDY")
    parser.add_argument(
        "--calibration",
        dest="calibrations",
        nargs=2,
        action="append",
        default=[],
        metavar=("FILE", "OHM"),
        help="file recorded with a known resistor, and its resistance, such as 98k8; may be given "
        "several times",
    )
    parser.add_argument(
        "--labels",
        action="append",
        metavar="PATTERN",
        help="for a folder: labels in the names of its files, as in "
        "'{subject}_{session}_{condition}_{trial}.csv', and 'calibration_{r_load}.csv'; may be "
        "given several times, the first that matches counts",
    )
    parser.add_argument(
        "--mapping",
        type=pathlib.Path,
        metavar="FILE",
        help="TOML file in place of the options below, also for several recordings "
        "(data_schema/README.md)",
    )
    for name, kind, what in (
        ("delimiter", _delimiter,
         "character between the cells, default a comma; '\\t': a tab; ' ': one or more blanks"),
        ("decimal", str, "decimal sign, default a point"),
        ("header_line", int, "line with the names of the columns, default 1; 0: they are 1, 2, …"),
        ("encoding", str, "encoding of the text, default UTF-8"),
    ):  # fmt: skip
        _option(parser, name, kind, f"for tables of text: {what}")
    channel = "channel of {}; its unit is {} unless the file names a unit".format
    for name, signal in SIGNALS.items():
        other = "; FILE:NAME for a channel of another file" if name == "v_th" else ""
        _option(parser, name, help=channel(name, signal.unit) + other)
    _option(parser, "time", help=f"{channel('the time', 'second')}; replaces --sample-rate")
    _option(parser, "scale", float, "divisor of the voltages: volt at the terminal = value / scale")
    _option(
        parser,
        "split",
        help="split one long record into trials: 'pulses' at the pauses between its pulses, or the "
        "channel of a trigger; files of --calibration are not split",
    )
    for name, field in DECLARED.items():
        if field.type in ("number", "label"):
            unit = f" [{field.unit}]" if field.unit else ""
            # A resistance may be a text such as 98k8.
            kind = float if field.type == "number" and field.unit != "ohm" else str
            shape = "OHM" if field.unit == "ohm" else ""
            what, count = f"{field.description.rstrip('.')}{unit}", None
            if name == "electrode":
                what, count = f"{what}; with --split also several, in the order they fire", "+"
            _option(parser, name, kind, what, shape, count)


def _option(
    parser: argparse.ArgumentParser,
    name: str,
    kind: Callable[[str], object] = str,
    help: str = "",
    metavar: str = "",
    nargs: str | None = None,
) -> None:
    metavar = metavar or ("NUMBER" if kind in (int, float) else "NAME")
    option = f"--{name.replace('_', '-')}"
    kind = _number if kind is float else kind
    parser.add_argument(option, type=kind, nargs=nargs, metavar=metavar, help=help)


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The file of recordings, and the mapping of a folder."""
    mapping = {arguments.target.with_suffix(".toml"): (".toml",)} if arguments.labels else {}
    return {arguments.target: HDF5, **mapping}


def run(arguments: argparse.Namespace) -> Outcome:
    """Import one file, and return which channel became which signal."""
    given = {
        name: value
        for name, value in vars(arguments).items()
        if name in (*CHANNELS, *FIELDS, *DIALECT)
    }
    if arguments.electrode and len(arguments.electrode) == 1:
        given["electrode"] = arguments.electrode[0]
    folder = os.path.isdir(arguments.source[0]) and arguments.mapping is None
    if folder or arguments.labels:
        return _folder(arguments, given)
    calibrations = resistors((file, ohm) for file, ohm in arguments.calibrations)
    used = import_file(
        arguments.source,
        arguments.target,
        arguments.mapping,
        calibrations={**calibrations},
        **given,
    )
    data = {
        "source": [*arguments.source, *calibrations],
        "target": arguments.target,
        "recordings": sum(len(each.paths) for each in used),
        "imported": [dataclasses.asdict(each) for each in used],
    }
    return Outcome("\n".join(map(str, used)), data)


def _folder(arguments: argparse.Namespace, given: Mapping[str, Any]) -> Outcome:
    """Import a folder, and return what became of each file."""
    folder, *more = arguments.source
    if not arguments.labels:
        raise RecordingError(
            "is a folder; a pattern must say what the names of its files mean",
            file=str(folder),
            remedy="Name their labels, as in --labels '{subject}_{trial}.csv', and for files of "
            "known resistors --labels 'cal_{r_load}.csv'",
        )
    if more or arguments.calibrations or arguments.mapping:
        raise RecordingError(
            "a folder is imported alone, with --labels in place of --calibration and --mapping",
            file=str(folder),
            remedy="Leave out the others; a pattern such as 'cal_{r_load}.csv' names resistors",
        )
    found = import_folder(folder, arguments.target, arguments.labels, **given)
    data = {
        "source": [folder],
        "target": arguments.target,
        "recordings": sum(len(each.paths) for of in found.imported.values() for each in of),
        **dataclasses.asdict(found),
    }
    return Outcome(str(found), data)


def _number(text: str) -> float:
    """The value of --sample-rate and of other numbers."""
    try:
        return number(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no number; write it as 200e3, 200k or 200kHz"
        ) from None


def _delimiter(text: str) -> str:
    r"""The value of --delimiter; a shell passes `'\t'` as two characters."""
    return "\t" if text == r"\t" else text
