"""List the faults of a file of recordings, field by field."""

import argparse
import pathlib

from etid.circuits.display import several
from etid.commands import DONE, WRONG_DATA, Outcome
from etid.recordings import hdf5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument of the command: the file."""
    parser.add_argument("file", type=pathlib.Path)


def run(arguments: argparse.Namespace) -> Outcome:
    """Return all faults of the file."""
    problems = hdf5.check(arguments.file)
    places = [
        {"path": each.path, "field": each.field, "message": each.message, "remedy": each.remedy}
        for each in problems
    ]
    data = {"file": arguments.file, "recordings": None, "problems": places}
    if problems:
        return Outcome("\n".join(map(str, problems)), data, WRONG_DATA)
    with hdf5.read(arguments.file) as study:
        data["recordings"] = len(study)
    return Outcome(
        f"{arguments.file}: {several(data['recordings'], 'recording')}, no faults", data, DONE
    )
