"""Identify a driver, and say what it is worth."""

import argparse
import pathlib

from etid.commands import Outcome
from etid.commands.fit import order
from etid.plotting import figure_of
from etid.plotting.style import save
from etid.recordings.replacing import HDF5
from etid.results.driver import Driver
from etid.simulation.calibration import calibrate, calibrations_in, read_driver


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the files of calibrations, the driver's file, and a former one."""
    parser.add_argument(
        "source", type=pathlib.Path, nargs="+", metavar="FILE", help="files with calibrations"
    )
    parser.add_argument("-o", dest="target", type=pathlib.Path, required=True, metavar="DRIVER")
    parser.add_argument(
        "--order",
        type=order,
        default=5,
        metavar="N",
        help="number of poles of the driver, or auto: from 7 on, as the calibrations need it; "
        "default 5",
    )
    parser.add_argument(
        "--former",
        type=pathlib.Path,
        metavar="DRIVER",
        help="driver of a former day, to which this one is compared",
    )
    parser.add_argument(
        "--picture",
        type=pathlib.Path,
        metavar="FILE",
        help="also draw |Z_th| beside the former one, as .png or .svg",
    )


def outputs(arguments: argparse.Namespace) -> dict[pathlib.Path, tuple[str, ...]]:
    """The file of the driver, and the picture."""
    picture = {} if arguments.picture is None else {arguments.picture: (".png", ".svg")}
    return {arguments.target: HDF5, **picture}


def run(arguments: argparse.Namespace) -> Outcome:
    """Identify the driver, write its calibrations, and return what it is worth."""
    records = calibrations_in(arguments.source)
    drivers: dict[str, Driver] = {}
    if arguments.former is not None:
        drivers[arguments.former.stem] = read_driver(arguments.former, order=arguments.order)
    found = calibrate(records, order=arguments.order, former=next(iter(drivers.values()), None))
    found.driver.write(arguments.target)
    if arguments.picture is not None:
        save(figure_of({arguments.target.stem: found.driver} | drivers), arguments.picture)
    data = {
        "source": arguments.source,
        "target": arguments.target,
        "verdict": found.driver.verdict,
        "order": found.driver.order,
        "expected": found.expected,
        "moved": found.moved,
        "shifts": found.shifts,
        "r_load": found.r_load,
    }
    return Outcome(str(found), data)
