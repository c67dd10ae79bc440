"""Turn .npz, .csv or .mat into an etid file."""

import argparse
import pathlib

from etid.commands import DONE
from etid.importing import import_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, and which column is what."""
    parser.add_argument("source", type=pathlib.Path)
    parser.add_argument("target", type=pathlib.Path)
    for name, text in {
        "v-th": "column or variable of the unloaded output",
        "v-out": "column or variable of the output with the load",
        "current": "column or variable of the current [A]",
        "time": "column or variable of the time [s], instead of --sample-rate",
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


def run(arguments: argparse.Namespace) -> int:
    """Import one file."""
    names = ("v_th", "v_out", "current", "time", "sample_rate", "pulse_rate", "scale", "r_load")
    given = {name: getattr(arguments, name) for name in (*names, "subject", "condition")}
    import_file(arguments.source, arguments.target, **given)
    return DONE
