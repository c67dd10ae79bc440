"""Circuits in the languages of others: a SPICE netlist, and impedance.py's string.

SPICE has no constant-phase element, but its impedance is a sum of relaxations of all time constants
(x [rad/s] are their corner frequencies; put x = s y to verify),

    1 / (Q s^α) = sin(πα) / (πQ) ∫ x^(−α) / (s + x) dx,      x from 0 to ∞, 0 < α < 1,

and sampled at x_k = x₀ e^(kh) the integral is a chain of resistors with capacitors in parallel
(Foster 1924), evenly spaced over ln x as in Oustaloup's recursion (Oustaloup et al. 2000):

    R_k = sin(πα) h x_k^(−α) / (πQ),      C_k = 1 / (R_k x_k).

In ln x the trapezoidal rule converges exponentially (Trefethen and Weideman 2014): the nearest pole
for s = jω lies π/2 off the real axis, so that its error is 2 e^(−π²/h). The slower relaxations that
are left out are, at higher frequencies, one capacitor in series, the faster ones one resistor; both
are geometric series.
"""

import re

import jax.numpy as jnp
import numpy as np

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.elements import (
    AbstractImpedance,
    Capacitance,
    ConstantPhase,
    Parallel,
    Resistance,
    Series,
    capacitor,
    parallel,
    resistor,
    series,
)

BAND = (1.0, 10e6)  # [Hz] where a ladder replaces a constant phase
LADDER_ERROR = 1e-4  # relative, at most, in the band
STEP = 0.95  # of ln x; the rule itself is off by 6e-5 then
BEYOND = np.log(600.0)  # ln x on both sides of the band, for what ends leave out to second order
PREFIX = {Resistance: "R", Capacitance: "C", ConstantPhase: "CPE"}


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
    tree = _passive(circuit.impedance(), band)
    lines = [f"* {type(circuit).__name__}, written by etid, in SI units"]
    lines += [f"* {key} = {value:.6g}" for key, value in values.items()]
    if not circuit.is_rational:
        lines.append(
            f"* constant phase as RC pairs, within {100 * LADDER_ERROR:g} % "
            f"from {band[0]:g} Hz to {band[1]:g} Hz"
        )
    writer = _Writer()
    writer.write(tree, "plus", "minus")
    return "\n".join([*lines, f".subckt {name} plus minus", *writer.lines, f".ends {name}", ""])


def circuit_string(circuit: AbstractCircuit) -> tuple[str, list[float]]:
    """A circuit in the notation of impedance.py, as `R0-p(R1,C1)`, and its values in that order.

        CustomCircuit(string, initial_guess=values)

    Its `CPE` has two values, Q [S s^α] and α.

    Args:
        circuit: One circuit, such as `fit.circuit`.

    Returns:
        The string, and the values in SI units.

    Raises:
        ValueError: The circuit is a batch, or an element is not a positive number.
    """
    _checked(circuit)
    names = _Names()
    values: list[float] = []

    def text(tree: AbstractImpedance) -> str:
        if isinstance(tree, Series):
            return "-".join(map(text, tree.parts))
        if isinstance(tree, Parallel):
            return f"p({','.join(map(text, tree.parts))})"
        values.extend(_values(tree))
        return names.next(PREFIX[type(tree)])

    return text(circuit.impedance()), values


class _Names:
    """Names of elements: each kind counts, and what stands together has equal numbers."""

    def __init__(self):
        self.used: dict[str, int] = {}

    def next(self, prefix: str) -> str:
        """A name that was not given before."""
        number = max(self.used.get(prefix, -1) + 1, *self.used.values(), 0)
        self.used[prefix] = number
        return f"{prefix}{number}"


class _Writer:
    """Parts of a netlist, one per line, with numbered parts and nodes."""

    def __init__(self):
        self.names = _Names()
        self.nodes = 0
        self.lines: list[str] = []

    def write(self, tree: AbstractImpedance, plus: str, minus: str) -> None:
        """Connect a network between two nodes."""
        if isinstance(tree, Parallel):
            for part in tree.parts:
                self.write(part, plus, minus)
        elif isinstance(tree, Series):
            for part in tree.parts[:-1]:
                self.nodes += 1
                node = f"n{self.nodes}"
                self.write(part, plus, node)
                plus = node
            self.write(tree.parts[-1], plus, minus)
        else:
            [value] = _values(tree)
            self.lines.append(f"{self.names.next(PREFIX[type(tree)])} {plus} {minus} {value!r}")


def _values(element: AbstractImpedance) -> list[float]:
    """The values of one element [SI]."""
    if isinstance(element, Resistance):
        return [float(element.r)]
    if isinstance(element, Capacitance):
        return [float(element.c)]
    if isinstance(element, ConstantPhase):
        return [float(element.q), float(element.alpha)]
    raise TypeError(f"{type(element).__name__} is no element of etid.circuits.elements")


def _checked(circuit: AbstractCircuit) -> dict[str, float]:
    """Parameters by name."""
    if jnp.ndim(circuit.values()) != 1:
        raise ValueError("the circuit is a batch; give one of them, such as fits[0].circuit")
    values = dict(zip(circuit.names(), circuit.values().tolist(), strict=True))
    for key, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{key} is {value}; a circuit with such an element cannot be written")
    return values


def _passive(tree: AbstractImpedance, band: tuple[float, float]) -> AbstractImpedance:
    """The same with resistors and capacitors in the place of constant phases."""
    if isinstance(tree, ConstantPhase):
        return ladder(float(tree.q), float(tree.alpha), band)
    if isinstance(tree, Series):
        return Series(tuple(_passive(part, band) for part in tree.parts))
    if isinstance(tree, Parallel):
        return Parallel(tuple(_passive(part, band) for part in tree.parts))
    return tree


def ladder(q: float, alpha: float, band: tuple[float, float] = BAND) -> AbstractImpedance:
    """Resistors and capacitors that are a constant-phase element in a band of frequencies.

    Args:
        q: Q [S s^α].
        alpha: α.
        band: Lowest and highest frequency [Hz].

    Raises:
        ValueError: α is above 1.
    """
    if alpha > 1:
        raise ValueError(
            f"an exponent is {alpha:.6g}; above 1 there is no passive network: fit a circuit with "
            "a capacitor in the place of the constant-phase element"
        )
    if alpha == 1:
        return capacitor(q)
    low, high = np.log(2 * np.pi * np.array(band)) + np.array([-BEYOND, BEYOND])
    x = np.exp(np.arange(low, high + STEP, STEP))
    level = (1 - alpha) * np.sinc(1 - alpha) * STEP / q  # sin(πα) h / (πQ)
    r = level * x**-alpha
    slower = level * x[0] ** (1 - alpha) / np.expm1(STEP * (1 - alpha))
    faster = level * x[-1] ** -alpha / np.expm1(STEP * alpha)
    pairs = [parallel(resistor(a), capacitor(1 / (a * b))) for a, b in zip(r, x, strict=True)]
    return series(resistor(faster), *pairs, capacitor(1 / slower))
