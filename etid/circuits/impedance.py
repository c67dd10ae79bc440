"""Impedances as trees: leaves are elements, nodes connect them in series or in parallel.

A tree keeps what a polynomial in s has lost, which elements there are and where. It is evaluated
exactly at any s, whether or not it is a ratio of polynomials, and it writes itself as a netlist.
Everything that depends on the kind of an element is a method of that element: a new kind of element
is one subclass of `AbstractRational`, or of `AbstractIrrational` if it is no ratio of polynomials.
"""

import abc
import dataclasses
from functools import reduce
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.transfer import Rational, reciprocal

# What a parameter may hold: one value, or a batch of them.
Quantity = Float[Array, "..."] | Float[np.ndarray, "..."] | float


class Names:
    """Names of parts: each kind counts, and what stands together has equal numbers."""

    def __init__(self):
        self.used: dict[str, int] = {}

    def next(self, prefix: str) -> str:
        """A name that was not given before."""
        number = max(self.used.get(prefix, -1) + 1, *self.used.values(), 0)
        self.used[prefix] = number
        return f"{prefix}{number}"


class Netlist:
    """Resistors and capacitors between numbered nodes, one per line.

    Attributes:
        band: Lowest and highest frequency [Hz] at which a ladder has to be right.
        lines: What was written.
        remarks: What a reader of the netlist should know.
    """

    def __init__(self, band: tuple[float, float]):
        self.band = band
        self.lines: list[str] = []
        self.remarks: set[str] = set()
        self.names = Names()
        self.nodes = 0

    def node(self) -> str:
        """A node that nothing is connected to yet."""
        self.nodes += 1
        return f"n{self.nodes}"

    def part(self, prefix: str, value: Quantity, plus: str, minus: str) -> None:
        """Connect one resistor (`R`) or capacitor (`C`) between two nodes."""
        self.lines.append(f"{self.names.next(prefix)} {plus} {minus} {float(value)!r}")


class Notation:
    """An impedance in the notation of impedance.py, such as `R0-p(R1,C1)`.

    Attributes:
        values: Values of the elements, in the order in which they stand in the text.
    """

    def __init__(self):
        self.names = Names()
        self.values: list[float] = []


class AbstractImpedance(eqx.Module):
    """A network between two terminals, as a function of s [rad/s]."""

    @abc.abstractmethod
    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""

    @abc.abstractmethod
    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""

    @property
    @abc.abstractmethod
    def is_rational(self) -> bool:
        """Whether the impedance is a ratio of polynomials in s."""

    @abc.abstractmethod
    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s.

        Raises:
            ValueError: It is none.
        """

    @abc.abstractmethod
    def exponents(self) -> tuple[Quantity, ...]:
        """Exponents of powers of s, each of which is at most 1 in a passive network."""

    @abc.abstractmethod
    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the network between two nodes, exactly or as a ladder that is right in the band.

        Raises:
            ValueError: No passive network has these values.
        """

    @abc.abstractmethod
    def text(self, notation: Notation) -> str:
        """The network in the notation of impedance.py.

        Raises:
            ValueError: impedance.py has no such element.
        """


class AbstractElement(AbstractImpedance):
    """A leaf: one element.

    Attributes:
        symbol: Its name in impedance.py, whose values are the fields in their order; empty if
            impedance.py does not have it.
    """

    symbol: ClassVar[str] = ""

    def text(self, notation: Notation) -> str:
        """The element in the notation of impedance.py."""
        if not self.symbol:
            raise ValueError(f"impedance.py has no element for {type(self).__name__}")
        notation.values += [float(getattr(self, f.name)) for f in dataclasses.fields(self)]
        return notation.names.next(self.symbol)


class AbstractRational(AbstractElement):
    """An element that is a ratio of polynomials in s, without powers of other exponents."""

    @property
    def is_rational(self) -> bool:
        """Yes."""
        return True

    def exponents(self) -> tuple[Quantity, ...]:
        """None."""
        return ()


class AbstractIrrational(AbstractElement):
    """An element that is no ratio of polynomials in s."""

    @property
    def is_rational(self) -> bool:
        """No."""
        return False

    def rational(self) -> Rational:
        """There is none."""
        raise ValueError(
            f"{type(self).__name__} is no rational function of s; it is exact at harmonics "
            "(method='maximum_likelihood' or 'non_parametric') and as Z(s)"
        )


class AbstractConnection(AbstractImpedance):
    """A node: several impedances that are connected.

    Attributes:
        parts: The impedances, at least one.
    """

    parts: eqx.AbstractVar[tuple[AbstractImpedance, ...]]

    def __check_init__(self):
        if not self.parts:
            raise ValueError(
                f"{type(self).__name__.lower()}() connects nothing; give it at least one impedance"
            )

    @property
    def is_rational(self) -> bool:
        """Whether all parts are ratios of polynomials in s."""
        return all(part.is_rational for part in self.parts)

    def exponents(self) -> tuple[Quantity, ...]:
        """Exponents of all parts."""
        return sum((part.exponents() for part in self.parts), start=())


class Series(AbstractConnection):
    """A series connection, Z = Z₁ + Z₂ + …."""

    parts: tuple[AbstractImpedance, ...]

    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""
        return reduce(jnp.add, [part(s) for part in self.parts])

    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""
        return reciprocal(self(s))

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return reduce(Rational.add, [part.rational() for part in self.parts])

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the parts one behind the other."""
        for part in self.parts[:-1]:
            node = netlist.node()
            part.connect(netlist, plus, node)
            plus = node
        self.parts[-1].connect(netlist, plus, minus)

    def text(self, notation: Notation) -> str:
        """The parts with dashes between them."""
        return "-".join(part.text(notation) for part in self.parts)


class Parallel(AbstractConnection):
    """A parallel connection, 1/Z = 1/Z₁ + 1/Z₂ + …."""

    parts: tuple[AbstractImpedance, ...]

    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""
        return reduce(jnp.add, [part.admittance(s) for part in self.parts])

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        parts = [part.rational().reciprocal() for part in self.parts]
        return reduce(Rational.add, parts).reciprocal()

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write all parts between the same nodes."""
        for part in self.parts:
            part.connect(netlist, plus, minus)

    def text(self, notation: Notation) -> str:
        """The parts within p()."""
        return f"p({','.join(part.text(notation) for part in self.parts)})"


def series(*impedances: AbstractImpedance) -> Series:
    """Series connection, Z = Z₁ + Z₂ + ….

    Args:
        *impedances: What is connected, at least one.

    Returns:
        An impedance, to be connected with others.

    Raises:
        ValueError: There is none.
    """
    return Series(impedances)


def parallel(*impedances: AbstractImpedance) -> Parallel:
    """Parallel connection, 1/Z = 1/Z₁ + 1/Z₂ + ….

    Args:
        *impedances: What is connected, at least one.

    Returns:
        An impedance, to be connected with others.

    Raises:
        ValueError: There is none.
    """
    return Parallel(impedances)
