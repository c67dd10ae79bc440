"""Entry point: `python -m benchmarks NAME`."""

import argparse
import importlib
import sys
from collections.abc import Sequence

import jax

from benchmarks.machine import pin
from benchmarks.ngspice import NgspiceError
from benchmarks.rivals import RivalError
from etid.recordings.errors import install

NAMES = (
    *("spice", "coverage", "driver_order", "delays", "noise", "tolerances", "selection", "design"),
    *("speed", "curves", "scale", "amplitudes", "amplitude_errors", "online", "control"),
    *("speed_accuracy", "which", "paper", "failure_map", "perturbations", "spectra", "rivals"),
    *("referee", "fuzz", "mutation", "live", "instruments", "directions", "inexact", "real"),
    *("excitations", "spectrum_peers"),
)
PLACES = {  # modules of other names
    "paper": "paper.causes",
    "rivals": "rivals.table",
    **{name: f"display.{name}" for name in ("online", "control", "live")},
}


def asked(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The arguments of a command line; `module` is the benchmark that it names."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(required=True)
    words = sys.argv[1:] if argv is None else argv
    for name in NAMES:
        try:
            module = importlib.import_module(f"benchmarks.{PLACES.get(name, name)}")
        except ModuleNotFoundError as error:
            needed = f"needs the package {error.name}: {install('bench')}"
            if name in words:
                sys.exit(f"{parser.prog} {name} {needed}")
            commands.add_parser(name, help=needed.replace("%", "%%"))
            continue
        summary = (module.__doc__ or "").splitlines()[0]
        command = commands.add_parser(name, help=summary, description=module.__doc__)
        for add in module.OPTIONS:
            add(command)
        command.set_defaults(module=module)
    return parser.parse_args(argv)


def main() -> None:
    """Run one benchmark; the exit status is 1 where it misses a target."""
    jax.config.update("jax_enable_x64", True)
    arguments = asked()
    if getattr(arguments.module, "PINNED", False):
        pin()
    try:
        sys.exit(0 if arguments.module.main(arguments) else 1)
    except (NgspiceError, RivalError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
