"""The option --circuit: a circuit of etid, or a circuit from a module of the user."""

import argparse
import os
import sys

from etid.circuits import lookup
from etid.circuits.circuit import AbstractCircuit


def add_circuit(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add the option --circuit to a command.

    Args:
        parser: Parser of the command.
        purpose: Purpose of the circuit, the first words of the help.
    """
    parser.add_argument(
        "--circuit",
        type=_circuit,
        metavar="NAME",
        help=f"{purpose}. NAME is {', '.join(lookup.built_in())}, or module:Class; the module is "
        "imported from the current folder or from the search path of Python",
    )


def _circuit(name: str) -> type[AbstractCircuit]:
    """Circuit class of this name; its module may be in the current folder."""
    if os.getcwd() not in sys.path:  # not in the path of a command; workers inherit it
        sys.path.insert(0, os.getcwd())
    try:
        return lookup.imported(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
