"""Write a report on a file of fits: one HTML page."""

import argparse
import pathlib

from etid.commands import Outcome
from etid.commands.circuits import add_circuit
from etid.report.study import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The fits, the page, and where the recordings are."""
    parser.add_argument("fits", type=pathlib.Path, metavar="FITS")
    parser.add_argument(
        "-o", dest="page", type=pathlib.Path, metavar="PAGE", help="default: FITS with .html"
    )
    parser.add_argument(
        "--recordings",
        type=pathlib.Path,
        metavar="FILE",
        help="what was identified, to draw the worst; default: where the fits came from",
    )
    add_circuit(parser, "the circuit of the fits, if it is not one of etid")


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the page and say where it is."""
    page = arguments.page or arguments.fits.with_suffix(".html")
    write_report(arguments.fits, page, recordings=arguments.recordings, circuit=arguments.circuit)
    return Outcome(str(page), {"fits": arguments.fits, "page": page})
