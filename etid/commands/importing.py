"""Turn a file of a lab (.csv, .mat, .tdms, .abf, .npz) into an etid file."""

import argparse
import dataclasses
import pathlib

from etid.commands import Outcome
from etid.files.importing import import_file
from etid.files.mapping import CHANNELS, FIELDS
from etid.recordings.fields import DECLARED, SIGNALS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and which channel is what."""
    parser.add_argument("source", type=pathlib.Path)
    parser.add_argument("target", type=pathlib.Path)
    parser.add_argument(
        "--mapping",
        type=pathlib.Path,
        metavar="FILE",
        help="TOML file that says all of this, for several recordings (data_schema/README.md)",
    )
    channel = "channel of {}, in {} unless the file names its unit".format
    for name, signal in SIGNALS.items():
        _option(parser, name, help=channel(name, signal.unit))
    _option(parser, "time", help=f"{channel('the time', 'seconds')}, instead of --sample-rate")
    _option(parser, "scale", float, "volts at the terminal are the value divided by this")
    for name, field in DECLARED.items():
        if field.type in ("number", "label"):
            unit = f" [{field.unit}]" if field.unit else ""
            kind = float if field.type == "number" else str
            _option(parser, name, kind, f"{field.description.rstrip('.')}{unit}")


def _option(
    parser: argparse.ArgumentParser, name: str, kind: type[str] | type[float] = str, help: str = ""
) -> None:
    metavar = "NAME" if kind is str else "NUMBER"
    parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar=metavar, help=help)


def run(arguments: argparse.Namespace) -> Outcome:
    """Import one file, and say what was used for what."""
    given = {name: value for name, value in vars(arguments).items() if name in (*CHANNELS, *FIELDS)}
    used = import_file(arguments.source, arguments.target, arguments.mapping, **given)
    data = {
        "source": arguments.source,
        "target": arguments.target,
        "recordings": sum(len(each.paths) for each in used),
        "imported": [dataclasses.asdict(each) for each in used],
    }
    return Outcome("\n".join(map(str, used)), data)
