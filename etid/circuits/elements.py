"""Impedances of networks of resistors, capacitors and constant-phase elements, as trees.

Leaves are elements, nodes connect them in series or in parallel. A tree keeps what a polynomial in
s has lost, which elements there are and where: it is evaluated exactly at any s, a constant phase
too, and becomes a netlist (`etid.netlist`). Where polynomials are needed, `rational()` makes them.
"""

import abc
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.transfer import Rational, as_complex, reciprocal

# What a parameter may hold: one value, or a batch of them.
Quantity = Float[Array, "..."] | Float[np.ndarray, "..."] | float
Ohm = Quantity
Farad = Quantity
Second = Quantity
Exponent = Quantity
PseudoCapacitance = Quantity


class AbstractImpedance(eqx.Module):
    """A network between two terminals, as a function of s [rad/s]."""

    @abc.abstractmethod
    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""

    @abc.abstractmethod
    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""

    @abc.abstractmethod
    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s.

        Raises:
            ValueError: It is none: there is a constant-phase element.
        """


class Resistance(AbstractImpedance):
    """A resistor, Z = R."""

    r: Ohm

    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""
        return jnp.broadcast_to(as_complex(jnp.asarray(self.r)), s.shape)

    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""
        return jnp.broadcast_to(as_complex(1 / jnp.asarray(self.r)), s.shape)

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return Rational(jnp.stack([jnp.asarray(self.r)]), jnp.ones(1))


class Capacitance(AbstractImpedance):
    """A capacitor, Z = 1 / (s C)."""

    c: Farad

    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S]."""
        return s * as_complex(jnp.asarray(self.c))

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        c = jnp.asarray(self.c)
        return Rational(jnp.ones(1), jnp.stack([jnp.zeros_like(c), c]))


class ConstantPhase(AbstractImpedance):
    """A constant-phase element, Z = 1 / (Q s^α), whose phase is −90° α at every frequency."""

    q: PseudoCapacitance
    alpha: Exponent

    def __call__(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Admittance 1/Z [S], with the branch of s^α that is real for s > 0."""
        log, alpha = jnp.log(s), jnp.asarray(self.alpha)
        power = jnp.exp(jax.lax.complex(alpha * log.real, alpha * log.imag))
        return as_complex(jnp.asarray(self.q)) * power

    def rational(self) -> Rational:
        """There is none."""
        raise ValueError(
            "a constant-phase element is no rational function of s; it is exact at harmonics "
            "(method='maximum_likelihood' or 'non_parametric') and as Z(s)"
        )


class Series(AbstractImpedance):
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


class Parallel(AbstractImpedance):
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


def exponents(impedance: AbstractImpedance) -> list[Exponent]:
    """α of every constant-phase element."""

    def is_phase(node):
        return isinstance(node, ConstantPhase)

    leaves = jax.tree.leaves(impedance, is_leaf=is_phase)
    return [leaf.alpha for leaf in leaves if is_phase(leaf)]


def resistor(r: Ohm) -> Resistance:
    """Impedance of a resistor, Z = R [Ω].

    Args:
        r: R [Ω].

    Returns:
        An impedance, to be connected with others.
    """
    return Resistance(r)


def capacitor(c: Farad) -> Capacitance:
    """Impedance of a capacitor, Z = 1 / (s C) [Ω].

    Args:
        c: C [F].

    Returns:
        An impedance, to be connected with others.
    """
    return Capacitance(c)


def constant_phase(q: PseudoCapacitance, alpha: Exponent) -> ConstantPhase:
    """Impedance of a constant-phase element, Z = 1 / (Q s^α) [Ω], the `CPE` of impedance.py.

    Args:
        q: Q [S s^α], a capacitance if α = 1.
        alpha: α, above 0 and at most 1.

    Returns:
        An impedance, to be connected with others.
    """
    return ConstantPhase(q, alpha)


def cole(r: Ohm, tau: Second, alpha: Exponent) -> Parallel:
    """Impedance of a relaxation that is spread over time constants, Z = R / (1 + (s τ)^α) [Ω].

    K. S. Cole, Permeability and impermeability of cell membranes for ions, 1940. It is R in
    parallel with a constant-phase element of Q = τ^α / R, but unlike those of Q, the errors of τ
    and α hardly go together, and the unit of τ is that of a time whatever α is.

    Args:
        r: R [Ω].
        tau: τ [s].
        alpha: α, above 0 and at most 1; 1 is a resistor and a capacitor.

    Returns:
        An impedance, to be connected with others.
    """
    r, tau, alpha = map(jnp.asarray, (r, tau, alpha))
    return parallel(resistor(r), constant_phase(tau**alpha / r, alpha))


def series(*impedances: AbstractImpedance) -> Series:
    """Series connection, Z = Z₁ + Z₂ + ….

    Args:
        *impedances: What is connected, at least one.

    Returns:
        An impedance, to be connected with others.

    Raises:
        ValueError: There is none.
    """
    return Series(_connected("series", impedances))


def parallel(*impedances: AbstractImpedance) -> Parallel:
    """Parallel connection, 1/Z = 1/Z₁ + 1/Z₂ + ….

    Args:
        *impedances: What is connected, at least one.

    Returns:
        An impedance, to be connected with others.

    Raises:
        ValueError: There is none.
    """
    return Parallel(_connected("parallel", impedances))


def _connected(
    how: str, impedances: tuple[AbstractImpedance, ...]
) -> tuple[AbstractImpedance, ...]:
    if not impedances:
        raise ValueError(f"{how}() connects nothing; give it at least one impedance")
    return impedances
