"""List the faults of a file of recordings, field by field."""

import argparse
import pathlib

import numpy as np

from etid.circuits.display import several
from etid.commands import DONE, WRONG_DATA, Outcome
from etid.identify.options import instrument_of
from etid.recordings import hdf5
from etid.recordings.causes import how_shifted, sizes
from etid.recordings.errors import RecordingError
from etid.recordings.faults import is_plausible
from etid.recordings.preflight import Inspected
from etid.recordings.study import Study
from etid.results.verdicts import message


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument of the command: the file."""
    parser.add_argument("file", type=pathlib.Path)


def run(arguments: argparse.Namespace) -> Outcome:
    """Return all faults of the file, or remarks on recordings without a fault."""
    problems, count, found = hdf5.check(arguments.file), None, []
    if not problems:
        with hdf5.read(arguments.file) as study:
            problems = _unreadable(study)
            if not problems:
                count, found = len(study), _remarks(study)
    places = [
        {"path": each.path, "field": each.field, "message": each.message, "remedy": each.remedy}
        for each in problems
    ]
    data = {"file": arguments.file, "recordings": count, "problems": places, "remarks": found}
    if count is None:
        return Outcome("\n".join(map(str, problems)), data, WRONG_DATA)
    lines = [f"{arguments.file}: {several(count, 'recording')}, no faults"]
    lines += [f"{one['path']}: {one['message']}" for one in found]
    return Outcome("\n".join(lines), data, DONE)


def _unreadable(study: Study) -> list[RecordingError]:
    """A fault for each calibration whose instrument cannot be read."""
    found = []
    for path in study.calibrations:
        try:
            instrument_of([study.metadata(path)])
        except RecordingError as error:
            found.append(error)
    return found


def _remarks(study: Study) -> list[dict[str, str]]:
    """Path and text for each recording that lost samples, or whose impedance no electrode has."""
    found = []
    for path in study:
        if shifted := how_shifted(Inspected.of(study[path])):
            found.append({"path": path, "message": shifted})
        if all(of.name != "current" for of in study.source(path).layout):
            continue
        samples = study[path].samples
        spans = [float(np.ptp(samples[name].values)) for name in ("v_out", "current")]
        if not is_plausible(*spans):
            found.append({"path": path, "message": f"{sizes(*spans)} {message('wrong_unit')}"})
    return found
