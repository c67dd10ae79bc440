"""The elements: resistor, capacitor and constant-phase element.

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

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from etid.circuits.impedance import (
    AbstractImpedance,
    AbstractIrrational,
    AbstractRational,
    Netlist,
    Parallel,
    Quantity,
    parallel,
    series,
)
from etid.signals.transfer import Rational, as_complex, reciprocal

Ohm = Quantity
Farad = Quantity
Second = Quantity
Exponent = Quantity
PseudoCapacitance = Quantity

LADDER_ERROR = 1e-4  # relative, at most, in the band
STEP = 0.95  # of ln x; the rule itself is off by 6e-5 then
BEYOND = np.log(600.0)  # ln x on both sides of the band, for what ends leave out to second order


class Resistance(AbstractRational):
    """A resistor, Z = R."""

    symbol: ClassVar[str] = "R"
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

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the resistor."""
        netlist.part("R", self.r, plus, minus)


class Capacitance(AbstractRational):
    """A capacitor, Z = 1 / (s C)."""

    symbol: ClassVar[str] = "C"
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

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the capacitor."""
        netlist.part("C", self.c, plus, minus)


class ConstantPhase(AbstractIrrational):
    """A constant-phase element, Z = 1 / (Q s^α), whose phase is −90° α at every frequency."""

    symbol: ClassVar[str] = "CPE"
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

    def exponents(self) -> tuple[Exponent, ...]:
        """α."""
        return (self.alpha,)

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write a ladder."""
        low, high = netlist.band
        netlist.remarks.add(
            f"constant phase as RC pairs, within {100 * LADDER_ERROR:g} % "
            f"from {low:g} Hz to {high:g} Hz"
        )
        ladder(float(self.q), float(self.alpha), netlist.band).connect(netlist, plus, minus)


def ladder(q: float, alpha: float, band: tuple[float, float]) -> AbstractImpedance:
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
