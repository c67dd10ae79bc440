"""Convert fits or recordings into files for other programs.

A file of fits becomes a table (.csv, .parquet). One fit, chosen by --path, becomes a SPICE netlist
(.cir) or a circuit of impedance.py (.json). A file of recordings becomes .nwb.
"""

import argparse
import datetime
import pathlib

from etid.commands import Outcome
from etid.commands.circuits import add_circuit
from etid.files.exporting import CIRCUITS, TABLES, export_circuit, export_fits, export_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the files, the recording, the start of the session, and the circuit."""
    parser.add_argument(
        "source", type=pathlib.Path, metavar="FILE", help="file of fits or recordings"
    )
    parser.add_argument(
        "-o",
        dest="target",
        type=pathlib.Path,
        required=True,
        metavar="FILE",
        help="file to write; its suffix chooses the format",
    )
    parser.add_argument(
        "--long", action="store_true", help="for .csv and .parquet: one line per element"
    )
    parser.add_argument(
        "--all",
        action="store_true",
        help="for .csv and .parquet: also the columns of changes and of quality",
    )
    parser.add_argument(
        "--path", metavar="RECORDING", help="for .cir and .json: path of the recording"
    )
    parser.add_argument(
        "--session-start",
        type=moment,
        metavar="TIME",
        help="for .nwb: start of the session, such as 2026-01-31T09:30:00+01:00",
    )
    add_circuit(parser, "for .cir and .json: circuit of the fits, if it is not a circuit of etid")


def moment(text: str) -> datetime.datetime:
    """Date and time from a text in the format of ISO 8601."""
    return datetime.datetime.fromisoformat(text)


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The target; its ending chooses the format."""
    return {arguments.target: (*TABLES, *CIRCUITS, ".nwb")}


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the target file."""
    source, target = arguments.source, arguments.target
    suffix = target.suffix.lower()
    only = {
        **dict.fromkeys(("path", "circuit"), CIRCUITS),
        **dict.fromkeys(("long", "all"), TABLES),
        "session_start": (".nwb",),
    }
    for name, suffixes in only.items():
        if getattr(arguments, name) and suffix not in suffixes:
            option = name.replace("_", "-")
            raise ValueError(f"{target}: --{option} is only for {' and '.join(suffixes)}")
    if suffix == ".nwb":
        export_study(source, target, session_start=arguments.session_start)
    elif suffix in CIRCUITS:
        export_circuit(source, target, arguments.path, circuit=arguments.circuit)
    else:
        export_fits(source, target, long=arguments.long, all=arguments.all)
    return Outcome(str(target), {"source": source, "target": target})
