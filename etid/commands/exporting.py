"""Turn fits into a table (.csv, .parquet), or recordings into .nwb."""

import argparse
import datetime
import pathlib

from etid.commands import DONE
from etid.exporting import export_fits, export_study


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
        "--session-start",
        type=datetime.datetime.fromisoformat,
        metavar="TIME",
        help="for .nwb: when the session began, such as 2026-01-31T09:30:00+01:00",
    )


def run(arguments: argparse.Namespace) -> int:
    """Write one file."""
    if arguments.target.suffix.lower() == ".nwb":
        export_study(arguments.source, arguments.target, session_start=arguments.session_start)
    elif arguments.session_start is not None:
        raise ValueError(f"{arguments.target}: --session-start is for .nwb")
    else:
        export_fits(arguments.source, arguments.target)
    return DONE
