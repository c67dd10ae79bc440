"""Write a report about a file of fits: one HTML page."""

import argparse
import pathlib

from etid.commands import Outcome
from etid.commands.circuits import add_circuit
from etid.plotting.layout import FINGERTIP, read_layout
from etid.report.study import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the fits, the page, the recordings, the layout, and the circuit."""
    parser.add_argument("fits", type=pathlib.Path, metavar="FITS")
    parser.add_argument(
        "-o",
        dest="page",
        type=pathlib.Path,
        metavar="PAGE",
        help="page to write; default: FITS with the suffix .html",
    )
    parser.add_argument(
        "--recordings",
        type=pathlib.Path,
        metavar="FILE",
        help="recordings, for figures of the worst fits; default: the file that was fitted",
    )
    parser.add_argument(
        "--layout",
        type=pathlib.Path,
        metavar="FILE",
        help="places of the electrodes, for maps: columns electrode, x, y [m], or a probe file; "
        "default: the paper's display, E1 to E98",
    )
    add_circuit(parser, "circuit of the fits, if it is not a circuit of etid")


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The page."""
    return {_page(arguments): (".html", ".htm")}


def _page(arguments: argparse.Namespace) -> pathlib.Path:
    return arguments.page or arguments.fits.with_suffix(".html")


def run(arguments: argparse.Namespace) -> Outcome:
    """Write the page and return its path."""
    page = _page(arguments)
    layout = FINGERTIP if arguments.layout is None else read_layout(arguments.layout)
    given = {"recordings": arguments.recordings, "circuit": arguments.circuit, "layout": layout}
    write_report(arguments.fits, page, **given)
    return Outcome(str(page), {"fits": arguments.fits, "page": page})
