"""Identify the drivers and the loads of a file of recordings."""

import argparse
import concurrent.futures
import contextlib
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from etid.commands import DONE, WRONG_DATA, Outcome
from etid.commands.circuits import add_circuit
from etid.estimators import registry
from etid.identify.arguments import order_of
from etid.identify.file import fit_file, kept, processes
from etid.identify.jointly import identify_jointly
from etid.recordings import hdf5
from etid.recordings.errors import RecordingError, install
from etid.recordings.replacing import HDF5, claimed
from etid.recordings.resistance import number
from etid.results.driver import Order
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE, StudyFits
from etid.results.verdicts import USABLE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: files, method, circuit, driver, and processes."""
    parser.add_argument("source", type=pathlib.Path, metavar="FILE")
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="FITS")
    parser.add_argument(
        "--method",
        choices=registry.names(),
        help="default maximum_likelihood",
    )
    add_circuit(parser, "circuit of the loads, default SkinRC", automatic=True)
    parser.add_argument(
        "--driver",
        type=pathlib.Path,
        metavar="DRIVER",
        help="file of the driver of all recordings, from etid calibrate",
    )
    parser.add_argument(
        "--order",
        type=order,
        default=5,
        metavar="N",
        help="number of poles of the driver, or auto: from 7 on, as the calibrations need it; "
        "default 5",
    )
    for option, example, shape, purpose in (
        ("--fix", "r_s=500", "ELEMENT=VALUE", "known value of an element [SI], such as r_s=500"),
        ("--prior", "r_s=500,50", "ELEMENT=VALUE,ERROR",
         "value of an element with its standard deviation [SI], such as r_s=500,50"),
        ("--bound", "r_s=100:2000", "ELEMENT=LOWER:UPPER",
         "bounds of an element [SI], such as r_s=100:2000, or r_s=100: without an upper one"),
    ):  # fmt: skip
        parser.add_argument(
            option,
            type=_written_as(option, example),
            action="append",
            default=[],
            metavar=shape,
            help=f"{purpose}; may be repeated",
        )
    parser.add_argument(
        "--tolerance",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="standard deviation of an error of the instrument: gain, r_load, crosstalk or drift "
        "[relative], c_load or capacitance [F], delay [s], such as gain=1e-3; may be repeated",
    )
    parser.add_argument(
        "--accept",
        type=float,
        metavar="PART",
        help="part of the signal that a circuit may leave beyond the noise; default 0.02",
    )
    parser.add_argument(
        "--plausible",
        type=_written_as("--plausible", "300:300e3"),
        default=PLAUSIBLE,
        metavar="LOWEST:HIGHEST",
        help="range of |Z_th| at 1 kHz [ohm] that is accepted; default 300:300e3",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="fit each driver together with its recordings, by maximum likelihood",
    )
    parser.add_argument("--resume", action="store_true", help="continue a run that was killed")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=_workers,
        metavar="N",
        help="number of processes on this machine, one core each",
    )
    where.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="scheduler of a cluster that can read the file (etid[dask])",
    )


def order(text: str) -> Order:
    """The value of --order."""
    try:
        return order_of(int(text) if text.lstrip("-").isdecimal() else text)
    except RecordingError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _written_as(option: str, example: str) -> Callable[[str], Any]:
    """The type of an option that is written as an example: a name, and one number or two.

    Two numbers have a comma or a colon between them. Both ends of a range may be open.
    """
    between = "," if "," in example else ":"
    is_range, count = ":" in example, example.count(between) + 1

    def parsed(text: str) -> tuple:
        name, _, numbers = text.rpartition("=")
        try:
            values = [
                None if is_range and not one else number(one) for one in numbers.split(between)
            ]
        except ValueError:
            values = []
        if len(values) != count or bool(name) != ("=" in example):
            raise argparse.ArgumentTypeError(f"{text!r} cannot be read; write {option} {example}")
        value = values[0] if count == 1 else tuple(values)
        return (name, value) if name else tuple(values)

    return parsed


def _by_name(option: str, known: list[tuple[str, Any]]) -> dict[str, Any]:
    """The values of an option that may be repeated, by element."""
    names = [name for name, _ in known]
    if len(set(names)) < len(names):
        raise ValueError(f"{option} names an element twice: {', '.join(names)}")
    return dict(known)


def _instrument(told: list[str]) -> Instrument | None:
    """The tolerances of --tolerance."""
    try:
        return Instrument.read(" ".join(told)) if told else None
    except ValueError as error:
        raise ValueError(f"--tolerance {error}") from None


def _workers(text: str) -> int:
    """The value of --workers."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes, 1 or more")
    return int(text)


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The file of fits."""
    return {arguments.target: HDF5}


def run(arguments: argparse.Namespace) -> Outcome:
    """Identify the drivers and loads, and write the file of fits."""
    if arguments.joint and arguments.method not in (None, "maximum_likelihood"):
        raise ValueError(f"--joint uses maximum_likelihood; remove --method {arguments.method}")
    if arguments.joint and arguments.driver:
        raise ValueError("--joint identifies the driver itself; remove --driver, or --joint")
    options = {
        "circuit": None if arguments.circuit is None else arguments.circuit(),
        "fixed": _by_name("--fix", arguments.fix),
        "prior": _by_name("--prior", arguments.prior),
        "bounds": _by_name("--bound", arguments.bound),
        "accept": arguments.accept,
        "plausible": arguments.plausible,
        "instrument": _instrument(arguments.tolerance),
    }
    progress = sys.stderr.isatty()
    if arguments.joint:
        if arguments.resume or arguments.workers or arguments.dask:
            raise ValueError("--joint is one fit per driver; remove --resume, --workers and --dask")
        with hdf5.read(arguments.source) as study, claimed(arguments.target):
            outcome = identify_jointly(
                study,
                **options,
                order=arguments.order,
                progress=progress,
            )
            outcome.write(arguments.target)
    else:
        with claimed(arguments.target):  # a run that goes on is not unfinished
            unfinished = "" if arguments.resume or arguments.force else kept(arguments.target)
        if unfinished:
            raise ValueError(f"{unfinished}; add --resume to continue, or --force to begin again")
        with _executor(arguments) as executor:
            outcome = fit_file(
                arguments.source,
                arguments.target,
                **options,
                driver=arguments.driver,
                order=arguments.order,
                method=arguments.method,
                resume=arguments.resume,
                executor=executor,
                progress=progress,
            )
    status = DONE if outcome.fits.fit.usable.any() else WRONG_DATA
    files = {"source": arguments.source, "target": arguments.target}
    alone = len(outcome.fits) == 1 and status == DONE
    text = f"{outcome}\n\n{outcome.fits[0]}" if alone else str(outcome)
    return Outcome(text, {**files, **_data(outcome)}, status)


def after_interrupt(arguments: argparse.Namespace) -> str:
    """Message after Ctrl-C: what was kept of a fit, and how to continue."""
    left = "" if arguments.joint else kept(arguments.target)
    if left:
        return f"{left}; to continue, add --resume to the same command"
    return f"{arguments.target} was not written, and nothing was kept: run the same command again"


@contextlib.contextmanager
def _executor(arguments: argparse.Namespace) -> Iterator[concurrent.futures.Executor | None]:
    if arguments.dask:
        try:
            import distributed
        except ImportError as error:
            raise ValueError(f"--dask needs distributed: {install('dask')}") from error
        with distributed.Client(arguments.dask) as client:
            yield client.get_executor()
    elif arguments.workers:
        with processes(arguments.workers) as executor:
            yield executor
    else:
        yield None


def _data(outcome: StudyFits) -> dict[str, Any]:
    """Data for scripts; the numbers of single recordings are only in the file of fits."""
    fits = outcome.fits
    drivers = [
        {
            "calibrations": paths,
            "verdict": driver.verdict,
            "order": driver.order,
            "rrse": driver.rrse,
            "chi2": driver.chi2,
            "note": driver.note,
        }
        for paths, driver in outcome.drivers.items()
    ]
    drivers += [{"calibrations": paths, "error": text} for paths, text in outcome.failures.items()]
    labelled = zip(fits.labels["path"], fits.verdicts, fits.notes, strict=True)
    return {
        "method": fits.fit.method,
        "recordings": len(fits),
        "verdicts": fits.counts(),
        "drivers": drivers,
        "units": fits.circuit.units(),
        "groups": fits.summary("subject", "condition"),
        "unusable": [
            {"path": path, "verdict": verdict, "note": note}
            for path, verdict, note in labelled
            if verdict not in USABLE
        ],
    }
