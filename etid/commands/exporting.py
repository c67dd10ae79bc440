"""Convert fits into files for other programs.

A file of fits becomes a table (.csv, .parquet). One fit, chosen by --path, becomes a SPICE netlist
(.cir) or a circuit of impedance.py (.json).
"""

import argparse
import pathlib

from etid.commands import Outcome
from etid.commands.circuits import add_circuit
from etid.files.exporting import CIRCUITS, TABLES, export_circuit, export_fits


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the files, the columns, the recording and the circuit."""
    parser.add_argument("source", type=pathlib.Path, metavar="FILE", help="file of fits")
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
    add_circuit(parser, "for .cir and .json: circuit of the fits, if it is not a circuit of etid")


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The target; its ending chooses the format."""
    return {arguments.target: (*TABLES, *CIRCUITS)}


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the target file."""
    source, target = arguments.source, arguments.target
    suffix = target.suffix.lower()
    only = {
        **dict.fromkeys(("path", "circuit"), CIRCUITS),
        **dict.fromkeys(("long", "all"), TABLES),
    }
    for name, suffixes in only.items():
        if getattr(arguments, name) and suffix not in suffixes:
            raise ValueError(f"{target}: --{name} is only for {' and '.join(suffixes)}")
    if suffix in CIRCUITS:
        export_circuit(source, target, arguments.path, circuit=arguments.circuit)
    else:
        export_fits(source, target, long=arguments.long, all=arguments.all)
    return Outcome(str(target), {"source": source, "target": target})
