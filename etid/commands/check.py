"""List the faults of a file of recordings, field by field."""

import argparse
import concurrent.futures
import contextlib
import multiprocessing
import os
import pathlib
import signal
from concurrent.futures.process import BrokenProcessPool

import numpy as np

from etid.commands import DONE, WRONG_DATA, Outcome
from etid.identify.options import instrument_of
from etid.printing import several
from etid.recordings import hdf5
from etid.recordings.causes import how_shifted, sizes
from etid.recordings.errors import RecordingError
from etid.recordings.faults import is_plausible
from etid.recordings.preflight import Inspected
from etid.recordings.study import Study
from etid.recordings.untrusted import DAMAGED
from etid.results.verdicts import message

SECONDS = 60  # of the processor, and one more for each megabyte of the file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument of the command: the file."""
    parser.add_argument("file", type=pathlib.Path)


def run(arguments: argparse.Namespace) -> Outcome:
    """Return all faults of the file, or remarks on recordings without a fault.

    A process of its own reads the file, with limits of time and memory: damage may crash or stop
    the HDF5 library.
    """
    file = str(arguments.file)
    alone = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, alone, _limit, (file,)) as process:
        try:
            places, count, found = process.submit(_faults, file).result()
        except BrokenProcessPool:
            said = "the process that read it has crashed, or took too much time or memory"
            places, count, found = [_place(RecordingError(said, remedy=DAMAGED))], None, []
    data = {"file": arguments.file, "recordings": count, "problems": places, "remarks": found}
    if count is None:
        lines = [str(RecordingError(**one, file=file)) for one in places]
        return Outcome("\n".join(lines), data, WRONG_DATA)
    lines = [f"{file}: {several(count, 'recording')}, no faults"]
    lines += [f"{one['path']}: {one['message']}" for one in found]
    return Outcome("\n".join(lines), data, DONE)


def _limit(file: str) -> None:
    """Limit the time and the memory of this process, where the platform can."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        size = os.path.getsize(file)
        for kind, most in (
            (resource.RLIMIT_DATA, memory),
            (resource.RLIMIT_CPU, SECONDS + size // 1_000_000),
        ):
            hard = resource.getrlimit(kind)[1]
            given = most if hard == resource.RLIM_INFINITY else min(most, hard)
            resource.setrlimit(kind, (given, hard))


def _faults(file: str) -> tuple[list[dict[str, str]], int | None, list[dict[str, str]]]:
    """The faults of a file, or the number of its recordings, and remarks on them."""
    problems = hdf5.check(file)
    if not problems:
        with hdf5.read(file) as study:
            problems = _unreadable(study)
            if not problems:
                return [], len(study), _remarks(study)
    return [_place(each) for each in problems], None, []


def _place(error: RecordingError) -> dict[str, str]:
    """What an error says, but for its file."""
    return {name: getattr(error, name) for name in ("path", "field", "message", "remedy")}


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
