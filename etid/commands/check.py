"""Say what is wrong with a file, field by field."""

import argparse
import pathlib

from etid import hdf5
from etid.commands import DONE, WRONG_DATA


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The file."""
    parser.add_argument("file", type=pathlib.Path)


def run(arguments: argparse.Namespace) -> int:
    """Print what is wrong."""
    problems = hdf5.check(arguments.file)
    if not problems:
        with hdf5.read(arguments.file) as study:
            print(f"{arguments.file}: {len(study)} recordings, nothing wrong")
        return DONE
    for problem in problems:
        print(problem)
    return WRONG_DATA
