"""Impedances as trees: leaves are elements, nodes connect impedances in series or in parallel.

A tree keeps the elements and their positions; a polynomial in s does not. A tree can be evaluated
exactly at any s, even if it is not a ratio of polynomials. It can also be written as a netlist.
Everything that depends on the kind of an element is a method of its class. A new kind of element
is one subclass of `AbstractRational`, or of `AbstractIrrational` if its impedance is not a ratio of
polynomials.

**Rows.** The elements have any leading axes that broadcast with s. A tree computes in NumPy if s
and its elements are arrays of NumPy, else in JAX.

**Slopes.** `slopes` gives ∂Z/∂ln e for each field e of each element. A connection hands them up:

    in series dZ = Σ dZ_i,      in parallel dZ = −Z² Σ dY_i.
"""

import abc
import dataclasses
import itertools
import operator
from functools import reduce
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact

from etid.precision import Module, namespace
from etid.signals.filtering import StateSpace
from etid.signals.transfer import AnyArray, Rational, reciprocal

# Type of a parameter: one value, or a batch of values.
Quantity = Float[Array, "..."] | Float[np.ndarray, "..."] | float
# Z or Y, and its slopes by the logarithms of all fields, each of which broadcasts with it.
Slopes = tuple[Complex[AnyArray, "..."], list[Inexact[AnyArray, "..."]]]
STEP_OF_FIELD = 1e-5  # relative; slopes by differences are then right to 1e-10 of Z


class Names:
    """Names of parts, such as R1 and C1: neighbours of different kinds get the same number."""

    def __init__(self) -> None:
        self.used: dict[str, int] = {}

    def next(self, prefix: str) -> str:
        """A new name with this prefix."""
        number = max(self.used.get(prefix, -1) + 1, *self.used.values(), 0)
        self.used[prefix] = number
        return f"{prefix}{number}"


class Netlist(Names):
    """Resistors, capacitors and inductors between numbered nodes, one per line.

    Attributes:
        band: Lowest and highest frequency [Hz] at which a ladder must be accurate.
        lines: Parts that were written, one per line.
        remarks: Notes for the reader of the netlist.
    """

    def __init__(self, band: tuple[float, float]) -> None:
        super().__init__()
        self.band = band
        self.lines: list[str] = []
        self.remarks: set[str] = set()
        self.nodes = 0

    def node(self) -> str:
        """Name of a new node."""
        self.nodes += 1
        return f"n{self.nodes}"

    def part(self, prefix: str, value: Quantity, plus: str, minus: str) -> None:
        """Connect one resistor (`R`), capacitor (`C`) or inductor (`L`) between two nodes."""
        self.lines.append(f"{self.next(prefix)} {plus} {minus} {float(value)!r}")


class Notation(Names):
    """An impedance in the notation of impedance.py; `values` are in the order of the text."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[float] = []


class AbstractImpedance(Module):
    """A network between two terminals, as a function of s [rad/s]."""

    # Of each method that is looked up, equinox makes a module. That takes longer than a formula.
    __getattribute__ = object.__getattribute__

    @abc.abstractmethod
    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""

    def admittance(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Admittance 1/Z [S]."""
        return reciprocal(self(s))

    @abc.abstractmethod
    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slopes by the fields of all elements, in their order."""

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Admittance and its slopes by the fields of all elements, in their order."""
        return inverted(*self.slopes(s))

    @abc.abstractmethod
    def elements(self) -> "tuple[AbstractElement, ...]":
        """The elements of the network."""

    @abc.abstractmethod
    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s; ValueError if it is none."""

    @abc.abstractmethod
    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """System in continuous time from current [A] to voltage [V].

        It is exact for a ratio of polynomials in s. Other elements are ladders of relaxations,
        whose relative error is below 1e-4 at all frequencies of a record.

        Args:
            rate: Sampling rate of the record [Hz].
            samples: Length of the record.
        """

    @abc.abstractmethod
    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the network between two nodes, exactly or as a ladder for the band."""

    @abc.abstractmethod
    def text(self, notation: Notation) -> str:
        """The network in the notation of impedance.py; ValueError if it lacks an element."""

    @property
    def is_rational(self) -> bool:
        """Whether the impedance is a ratio of polynomials in s."""
        return all(isinstance(one, AbstractRational) for one in self.elements())

    @property
    def has_response(self) -> bool:
        """Whether the response in time is known, exactly or by a ladder of relaxations."""
        unknown = AbstractIrrational.state_space
        return all(type(one).state_space is not unknown for one in self.elements())

    def exponents(self) -> tuple[Quantity, ...]:
        """Exponents of the powers of s. In a passive network each exponent is at most 1."""
        return sum((one.exponents() for one in self.elements()), start=())

    def in_time(self, rate: float | Float[AnyArray, ""], samples: int) -> Rational | StateSpace:
        """The impedance for a simulation: as a ratio of polynomials if it is one."""
        return self.rational() if self.is_rational else self.state_space(rate, samples)


class AbstractElement(AbstractImpedance):
    """One element, a leaf of the tree.

    Attributes:
        symbol: Name of the element in impedance.py; empty if impedance.py does not have it. The
            fields must have the same order as the values of impedance.py.
    """

    symbol: ClassVar[str] = ""

    def elements(self) -> "tuple[AbstractElement, ...]":
        """The element itself."""
        return (self,)

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Central differences; an element of etid replaces them by exact slopes."""
        fields, structure = jax.tree.flatten(self)

        def moved(place: int, factor: float) -> Complex[AnyArray, "..."]:
            of = fields[place] * factor
            return jax.tree.unflatten(structure, [*fields[:place], of, *fields[place + 1 :]])(s)

        up, down = 1 + STEP_OF_FIELD, 1 - STEP_OF_FIELD
        rows = [
            (moved(place, up) - moved(place, down)) / (2 * STEP_OF_FIELD)
            for place in range(len(fields))
        ]
        return self(s), rows

    @abc.abstractmethod
    def exponents(self) -> tuple[Quantity, ...]:
        """Exponents of the powers of s."""

    def text(self, notation: Notation) -> str:
        """The element in the notation of impedance.py."""
        if not self.symbol:
            raise ValueError(f"impedance.py has no element for {type(self).__name__}")
        notation.values += [float(getattr(self, f.name)) for f in dataclasses.fields(self)]
        return notation.next(self.symbol)


class AbstractRational(AbstractElement):
    """An element whose impedance is a ratio of polynomials in s."""

    def exponents(self) -> tuple[Quantity, ...]:
        """Empty: a ratio of polynomials has no other exponents."""
        return ()

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """System from current to voltage."""
        del samples
        return realise(self.rational(), rate)


class AbstractIrrational(AbstractElement):
    """An element whose impedance is not a ratio of polynomials in s."""

    def rational(self) -> Rational:
        """Raise ValueError: the impedance is not a ratio of polynomials."""
        raise ValueError(
            f"{type(self).__name__} is no rational function of s; use "
            "the method maximum_likelihood, which evaluates Z(s) at harmonics"
        )

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """Raise ValueError; an element with a ladder of relaxations replaces this method."""
        del rate, samples
        raise ValueError(f"{type(self).__name__} has no known response in time")

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Raise ValueError; an element with a ladder of resistors and capacitors replaces it."""
        raise ValueError(
            f"{type(self).__name__} cannot be written as resistors, capacitors and inductors"
        )


class AbstractConnection(AbstractImpedance):
    """A connection of several impedances, a node of the tree.

    Attributes:
        parts: The impedances, at least one.
    """

    parts: tuple[AbstractImpedance, ...]

    def __check_init__(self) -> None:
        if not self.parts:
            raise ValueError(
                f"{type(self).__name__.lower()}() has no arguments; give it at least one impedance"
            )

    def elements(self) -> tuple[AbstractElement, ...]:
        """The elements of all parts."""
        return sum((part.elements() for part in self.parts), start=())


class Series(AbstractConnection):
    """A series connection, Z = Z₁ + Z₂ + …."""

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return reduce(operator.add, [part(s) for part in self.parts])

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slopes."""
        return _added([part.slopes(s) for part in self.parts])

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return reduce(Rational.add, [part.rational() for part in self.parts])

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """Systems of the parts, driven by the same current."""
        return reduce(in_series, [part.state_space(rate, samples) for part in self.parts])

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the parts one after the other, with a new node between neighbours."""
        for part in self.parts[:-1]:
            node = netlist.node()
            part.connect(netlist, plus, node)
            plus = node
        self.parts[-1].connect(netlist, plus, minus)

    def text(self, notation: Notation) -> str:
        """The parts, separated by dashes."""
        return "-".join(part.text(notation) for part in self.parts)


class Parallel(AbstractConnection):
    """A parallel connection, 1/Z = 1/Z₁ + 1/Z₂ + …."""

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Admittance 1/Z [S]."""
        return reduce(operator.add, [part.admittance(s) for part in self.parts])

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slopes."""
        return inverted(*self.admittance_slopes(s))

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Admittance and its slopes."""
        return _added([part.admittance_slopes(s) for part in self.parts])

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        parts = [part.rational().reciprocal() for part in self.parts]
        return reduce(Rational.add, parts).reciprocal()

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """Systems of the parts, which share the current so that their voltages are equal."""
        return reduce(_in_parallel, [part.state_space(rate, samples) for part in self.parts])

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write all parts between the same nodes."""
        for part in self.parts:
            part.connect(netlist, plus, minus)

    def text(self, notation: Notation) -> str:
        """The parts, separated by commas, in p()."""
        return f"p({','.join(part.text(notation) for part in self.parts)})"


def inverted(value: Complex[AnyArray, "..."], slopes: list[Inexact[AnyArray, "..."]]) -> Slopes:
    """Admittance and its slopes from those of an impedance, or the other way."""
    inverse = reciprocal(value)
    square = -(inverse * inverse)
    return inverse, [square * of for of in slopes]


def _added(parts: list[Slopes]) -> Slopes:
    """The sum of the values, and the slopes of all of them."""
    values, slopes = zip(*parts, strict=True)
    return reduce(operator.add, values), list(itertools.chain(*slopes))


def realise(impedance: Rational, rate: float | Float[AnyArray, ""]) -> StateSpace:
    """State space of a load impedance, from current [A] to voltage [V]."""
    order = impedance.den.shape[0] - 1
    if impedance.num.shape[0] > order + 1:
        raise ValueError(
            "the impedance of the load grows without bound at high frequency (an inductor in "
            "series?); a load must stay finite: put a resistor in parallel"
        )
    xp = namespace(impedance.num, impedance.den, rate)
    scale = xp.stack([xp.asarray(rate**k, float) for k in range(order + 1)])
    num = xp.pad(impedance.num, (0, order + 1 - impedance.num.shape[0])) * scale
    den = impedance.den * scale
    num, den = num / den[-1], den / den[-1]
    direct = num[-1]
    A = xp.concatenate([np.eye(order, k=1)[:-1], -den[None, :-1]])[:order]
    B = np.eye(order, 1, k=1 - order)
    return StateSpace(rate * A, rate * B, num[:-1] - direct * den[:-1], direct[None])


def in_series(one: StateSpace, other: StateSpace) -> StateSpace:
    """Two systems under the same current, whose voltages add."""
    xp, count = namespace(one.A, other.A), (one.C.size, other.C.size)
    above = xp.pad(one.A, ((0, 0), (0, count[1])))
    below = xp.pad(other.A, ((0, 0), (count[0], 0)))
    return StateSpace(
        xp.concatenate([above, below]),
        xp.concatenate([one.B, other.B]),
        xp.concatenate([one.C, other.C]),
        one.D + other.D,
    )


def divider(source: StateSpace, load: StateSpace) -> StateSpace:
    """The system V_th → V_out of a load behind a source impedance, both from current to voltage.

    The current i = (V_th − C₁x₁ − C₂x₂) / (D₁ + D₂) drives both impedances. x₁ are the states of
    the source, x₂ the states of the load. It holds in continuous and in discrete time.
    """
    xp, both = namespace(source.A, load.A), in_series(source, load)
    total = source.D[0] + load.D[0]
    B, share = both.B / total, load.D[0] / total
    C = xp.concatenate([np.zeros(source.C.size), load.C]) - share * both.C
    return StateSpace(both.A - B * both.C[None, :], B, C, share[None])


def _in_parallel(one: StateSpace, other: StateSpace) -> StateSpace:
    """The current i₁ = (C₂x₂ − C₁x₁ + D₂ i) / (D₁ + D₂) flows through the first part."""
    xp, first, second = namespace(one.A, other.A), np.ones(one.C.size), np.ones(other.C.size)
    total, both = one.D[0] + other.D[0], in_series(one, other)
    towards = xp.concatenate([-one.C, other.C]) / total
    share = xp.concatenate([first * other.D[0], second * one.D[0]]) / total
    flows = both.B[:, 0] * np.concatenate([first, -second])
    return StateSpace(
        both.A + flows[:, None] * towards[None, :],
        both.B * share[:, None],
        both.C * share,
        one.D * other.D / total,
    )


def series(*impedances: AbstractImpedance) -> Series:
    """Series connection of at least one impedance, Z = Z₁ + Z₂ + …."""
    return Series(impedances)


def parallel(*impedances: AbstractImpedance) -> Parallel:
    """Parallel connection of at least one impedance, 1/Z = 1/Z₁ + 1/Z₂ + …."""
    return Parallel(impedances)
