"""Write the recordings of several files into one file, each in a group of its own."""

import argparse
import pathlib

from etid.commands import Outcome
from etid.printing import several
from etid.recordings.hdf5 import merge_files
from etid.recordings.replacing import HDF5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the files."""
    parser.add_argument("source", type=pathlib.Path, nargs="+", metavar="FILE")
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="STUDY")


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The file of recordings."""
    return {arguments.target: HDF5}


def run(arguments: argparse.Namespace) -> Outcome:
    """Merge the files, and return how many recordings came from each."""
    counts = merge_files(arguments.source, arguments.target)
    lines = [f"{group}: {several(count, 'recording')}" for group, count in counts.items()]
    data = {
        "source": arguments.source,
        "target": arguments.target,
        "recordings": sum(counts.values()),
    }
    return Outcome("\n".join(lines), data)
