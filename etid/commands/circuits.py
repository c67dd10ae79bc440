"""The option --circuit: a circuit of etid, or one of the user's own modules."""

import argparse
import os
import sys

from etid.circuits import lookup
from etid.circuits.circuit import AbstractCircuit


def add_circuit(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Let a command ask for a circuit.

    Args:
        parser: Of the command.
        purpose: What it needs the circuit for.
    """
    parser.add_argument(
        "--circuit",
        type=_circuit,
        metavar="NAME",
        help=f"{purpose}: {', '.join(lookup.built_in())}, or module:Class, whose module is "
        "imported from the current folder or from where Python finds it",
    )


def _circuit(name: str) -> type[AbstractCircuit]:
    """The class of that name; its module may lie in the current folder."""
    if os.getcwd() not in sys.path:  # a command does not have it there; workers inherit it
        sys.path.insert(0, os.getcwd())
    try:
        return lookup.imported(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
