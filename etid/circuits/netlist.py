"""Circuits in the languages of others: a SPICE netlist, and impedance.py's string."""

import re

import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.impedance import Netlist, Notation

BAND = (1.0, 10e6)  # [Hz] where a ladder replaces an element that SPICE does not have


def netlist(
    circuit: AbstractCircuit, *, name: str = "load", band: tuple[float, float] = BAND
) -> str:
    """SPICE subcircuit of a circuit, of resistors and capacitors alone, between `plus` and `minus`.

    A constant phase becomes a chain of RC pairs, good to `LADDER_ERROR` of its impedance in `band`.
    Use it as in `X1 out 0 load`.

    Args:
        circuit: One circuit, such as `fit.circuit`.
        name: Name of the subcircuit.
        band: Lowest and highest frequency [Hz] at which a constant phase has to be right.

    Returns:
        The text of the subcircuit, elements in SI units.

    Raises:
        ValueError: The name or the band is none, the circuit is a batch, or an element is not
            positive or an exponent above 1, so that no such network exists.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name, flags=re.ASCII):
        raise ValueError(
            f"{name!r} cannot name a subcircuit; use letters, digits and _, a letter first"
        )
    if not 0 < band[0] < band[1] < np.inf:
        raise ValueError(f"band is {band}; it must be two rising frequencies [Hz] above 0")
    values = _checked(circuit)
    lines = [f"* {type(circuit).__name__}, written by etid, in SI units"]
    lines += [f"* {key} = {value:.6g}" for key, value in values.items()]
    written = Netlist(band)
    circuit.impedance().connect(written, "plus", "minus")
    lines += [f"* {remark}" for remark in sorted(written.remarks)]
    return "\n".join([*lines, f".subckt {name} plus minus", *written.lines, f".ends {name}", ""])


def circuit_string(circuit: AbstractCircuit) -> tuple[str, list[float]]:
    """A circuit in the notation of impedance.py, as `R0-p(R1,C1)`, and its values in that order.

        CustomCircuit(string, initial_guess=values)

    Its `CPE` has two values, Q [S s^α] and α.

    Args:
        circuit: One circuit, such as `fit.circuit`.

    Returns:
        The string, and the values in SI units.

    Raises:
        ValueError: The circuit is a batch, an element is not a positive number, or impedance.py has
            no such element.
    """
    _checked(circuit)
    notation = Notation()
    return circuit.impedance().text(notation), notation.values


def _checked(circuit: AbstractCircuit) -> dict[str, float]:
    """Parameters by name."""
    if jnp.ndim(circuit.values()) != 1:
        raise ValueError("the circuit is a batch; give one of them, such as fits[0].circuit")
    values = dict(zip(circuit.names(), circuit.values().tolist(), strict=True))
    for key, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{key} is {value}; a circuit with such an element cannot be written")
    return values
