"""Entry point: `python -m benchmarks NAME`."""

import argparse
import importlib
import sys

import jax

from benchmarks.ngspice import NgspiceError

NAMES = (
    "spice",
    "coverage",
    "driver_order",
    "delays",
    "noise",
    "selection",
    "design",
    "timing",
    "speed",
    "curves",
    "scale",
    "amplitudes",
    "amplitude_errors",
    "online",
    "control",
    "speed_accuracy",
    "which",
    "paper",
    "failure_map",
    "perturbations",
    "spectra",
    "rivals",
    "referee",
    "fuzz",
    "mutation",
)


def main() -> None:
    """Run one benchmark; the exit status is 1 where it misses a target.

    Each is a module with `add_arguments(parser)` and `main(arguments)`, which returns whether every
    target is met; the first line of its docstring is its help.
    """
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(required=True)
    for name in NAMES:
        module = importlib.import_module(f"benchmarks.{name}")
        summary = (module.__doc__ or "").splitlines()[0]
        command = commands.add_parser(name, help=summary, description=module.__doc__)
        module.add_arguments(command)
        command.set_defaults(main=module.main)
    arguments = parser.parse_args()
    try:
        sys.exit(0 if arguments.main(arguments) else 1)
    except NgspiceError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
