"""Turn fits or recordings into files of other programs.

Fits become a table (.csv, .parquet); one of them, with --path, a SPICE netlist (.cir) or a circuit
of impedance.py (.json); recordings become .nwb.
"""

import argparse
import datetime
import pathlib

from etid.commands import Outcome
from etid.commands.circuits import add_circuit
from etid.files.exporting import CIRCUITS, export_circuit, export_fits, export_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and what NWB has to know."""
    parser.add_argument("source", type=pathlib.Path, metavar="FILE", help="fits or recordings")
    parser.add_argument(
        "-o",
        dest="target",
        type=pathlib.Path,
        required=True,
        metavar="FILE",
        help="its suffix says what it becomes",
    )
    parser.add_argument(
        "--path", metavar="RECORDING", help="for .cir and .json: the recording whose fit it is"
    )
    parser.add_argument(
        "--session-start",
        type=moment,
        metavar="TIME",
        help="for .nwb: when the session began, such as 2026-01-31T09:30:00+01:00",
    )
    add_circuit(parser, "for .cir and .json: the circuit of the fits, if it is not one of etid")


def moment(text: str) -> datetime.datetime:
    """A date and time as ISO 8601 writes it."""
    return datetime.datetime.fromisoformat(text)


def run(arguments: argparse.Namespace) -> Outcome:
    """Write one file."""
    source, target = arguments.source, arguments.target
    suffix = target.suffix.lower()
    for name in ("path", "circuit"):
        if getattr(arguments, name) is not None and suffix not in CIRCUITS:
            raise ValueError(f"{target}: --{name} is for {' and '.join(CIRCUITS)}")
    if arguments.session_start is not None and suffix != ".nwb":
        raise ValueError(f"{target}: --session-start is for .nwb")
    if suffix == ".nwb":
        export_study(source, target, session_start=arguments.session_start)
    elif suffix in CIRCUITS:
        export_circuit(source, target, arguments.path, circuit=arguments.circuit)
    else:
        export_fits(source, target)
    return Outcome(data={"source": source, "target": target})
