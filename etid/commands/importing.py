"""Turn a file of a lab (.csv, .mat, .tdms, .abf, .npz) into an etid file."""

import argparse
import dataclasses
import pathlib

from etid.commands import Outcome
from etid.files.importing import import_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and which channel is what."""
    parser.add_argument("source", type=pathlib.Path)
    parser.add_argument("target", type=pathlib.Path)
    parser.add_argument(
        "--mapping",
        type=pathlib.Path,
        metavar="FILE",
        help="TOML file that says all of this, for several recordings (data_schema/README.md)",
    )
    for name, text in {
        "v-th": "channel of the unloaded output, in volts unless the file names its unit",
        "v-out": "channel of the output with the load, likewise",
        "current": "channel of the current, in amperes unless the file names its unit",
        "time": "channel of the time, in seconds likewise, instead of --sample-rate",
    }.items():
        parser.add_argument(f"--{name}", metavar="NAME", help=text)
    for name, text in {
        "sample-rate": "samples per second [Hz]",
        "pulse-rate": "pulses per second [Hz]",
        "scale": "volts at the terminal are the value divided by this",
        "r-load": "known resistor [ohm], for calibrations",
    }.items():
        parser.add_argument(f"--{name}", type=float, metavar="NUMBER", help=text)
    parser.add_argument("--subject", default="")
    parser.add_argument("--condition", default="")


def run(arguments: argparse.Namespace) -> Outcome:
    """Import one file, and say what was used for what."""
    names = ("v_th", "v_out", "current", "time", "sample_rate", "pulse_rate", "scale", "r_load")
    given = {name: getattr(arguments, name) for name in (*names, "subject", "condition")}
    used = import_file(arguments.source, arguments.target, arguments.mapping, **given)
    data = {
        "source": arguments.source,
        "target": arguments.target,
        "recordings": sum(len(each.paths) for each in used),
        "imported": [dataclasses.asdict(each) for each in used],
    }
    return Outcome("\n".join(map(str, used)), data)
