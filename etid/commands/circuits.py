"""The option --circuit: a circuit of etid, or a circuit from a module of the user."""

import argparse
import os
import sys
from collections.abc import Callable

from etid.circuits import lookup
from etid.circuits.circuit import AbstractCircuit
from etid.identify.options import Circuit
from etid.results.driver import AUTO


def add_circuit(parser: argparse.ArgumentParser, purpose: str, *, automatic: bool = False) -> None:
    """Add the option --circuit to a command.

    Args:
        parser: Parser of the command.
        purpose: Purpose of the circuit, the first words of the help.
        automatic: Whether the command can choose the circuit, with `--circuit auto`.
    """
    names = f"{', '.join(lookup.built_in())}, a string as R0-p(R1,C1), or module:Class"
    parser.add_argument(
        "--circuit",
        type=_circuit_or_auto if automatic else _circuit,
        metavar="NAME",
        help=f"{purpose}. NAME is {names}; the module is imported from the current folder or from "
        "the search path of Python"
        + (". auto chooses the simplest circuit that the recordings support" if automatic else ""),
    )


def _circuit_or_auto(name: str) -> Callable[[], Circuit]:
    """Circuit class of this name, or a function that returns `"auto"`."""
    return (lambda: AUTO) if name == AUTO else _circuit(name)


def _circuit(name: str) -> type[AbstractCircuit]:
    """Circuit class of this name; its module may be in the current folder."""
    if os.getcwd() not in sys.path:  # not in the path of a command; workers inherit it
        sys.path.insert(0, os.getcwd())
    try:
        return lookup.imported(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
