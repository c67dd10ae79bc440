"""Circuits for other programs: a SPICE netlist, and the string of impedance.py."""

import re

import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.impedance import Netlist, Notation
from etid.precision import in_float64


@in_float64
def netlist(
    circuit: AbstractCircuit, *, name: str = "load", band: tuple[float, float] = (1.0, 10e6)
) -> str:
    """SPICE subcircuit of resistors, capacitors and inductors between the nodes `plus` and `minus`.

    A chain of RC pairs replaces a constant-phase element, and diffusion (W, Wo, Ws and G of circuit
    strings). Its relative error in `band` is at most 1e-4. A line such as `X1 out 0 load` connects
    the subcircuit.

    Args:
        circuit: One circuit, such as `fit.circuit`.
        name: Name of the subcircuit.
        band: Lowest and highest frequency [Hz] at which RC pairs must be accurate.

    Returns:
        Text of the subcircuit, with elements in SI units.

    Raises:
        ValueError: The name or the band is invalid, the circuit is a batch, an element is not a
            positive number, an exponent is above 1, or an element is no network of such parts (La
            and T).
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name, flags=re.ASCII):
        raise ValueError(
            f"{name!r} cannot be the name of a subcircuit; use letters, digits and _, and begin "
            "with a letter"
        )
    if not 0 < band[0] < band[1] < np.inf:
        raise ValueError(f"band is {band}; it must be two increasing frequencies [Hz] above 0")
    values = _checked(circuit)
    lines = [f"* {type(circuit).__name__}, written by etid, in SI units"]
    lines += [f"* {key} = {value:.6g}" for key, value in values.items()]
    written = Netlist(band)
    circuit.impedance().connect(written, "plus", "minus")
    lines += [f"* {remark}" for remark in sorted(written.remarks)]
    return "\n".join([*lines, f".subckt {name} plus minus", *written.lines, f".ends {name}", ""])


@in_float64
def circuit_string(circuit: AbstractCircuit) -> tuple[str, list[float]]:
    """A circuit in the notation of impedance.py, such as `R0-p(R1,C1)`, and the element values.

        CustomCircuit(string, initial_guess=values)

    The values have the order of the elements in the string, and those of an element the order of
    impedance.py. A `CPE` has two values: Q [S s^α] and α.

    Args:
        circuit: One circuit, such as `fit.circuit`.

    Returns:
        String, and values in SI units.

    Raises:
        ValueError: The circuit is a batch, an element is not a positive number, or impedance.py has
            no such element.
    """
    _checked(circuit)
    notation = Notation()
    return circuit.impedance().text(notation), notation.values


def _checked(circuit: AbstractCircuit) -> dict[str, float]:
    """Parameters by name, if the circuit is not a batch and all parameters are positive."""
    if jnp.ndim(circuit.values()) != 1:
        raise ValueError("the circuit is a batch; give one circuit, such as fits[0].circuit")
    values = dict(zip(circuit.names(), circuit.values().tolist(), strict=True))
    for key, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{key} is {value}; a circuit with such an element cannot be written")
    return values
