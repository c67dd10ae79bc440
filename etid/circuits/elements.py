"""The elements: resistor, capacitor, inductors, relaxation and constant-phase element.

SPICE has no constant-phase element. Its impedance is an integral over relaxations with all corner
frequencies x [rad/s] (substitute x = s y to verify):

    1 / (Q s^α) = sin(πα) / (πQ) ∫ x^(−α) / (s + x) dx,      x from 0 to ∞, 0 < α < 1.

The trapezoidal rule at x_k = x₀ e^(kh) turns the integral into a chain of resistors with parallel
capacitors (Foster 1924). They are evenly spaced in ln x, as in Oustaloup's recursion (Oustaloup et
al. 2000):

    R_k = sin(πα) h x_k^(−α) / (πQ),      C_k = 1 / (R_k x_k).

In ln x the trapezoidal rule converges exponentially (Trefethen and Weideman 2014). For s = jω the
nearest pole lies at a distance of π/2 from the real axis, so the error of the rule is 2 e^(−π²/h).
The chain is finite. One series capacitor replaces all slower relaxations; one series resistor
replaces all faster relaxations. Both values are sums of geometric series.
"""

from typing import ClassVar

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.impedance import (
    AbstractImpedance,
    AbstractIrrational,
    AbstractRational,
    Netlist,
    Parallel,
    Quantity,
    Slopes,
    inverted,
    parallel,
    series,
)
from etid.precision import namespace
from etid.signals.filtering import StateSpace
from etid.signals.transfer import (
    AnyArray,
    Rational,
    as_complex,
    from_parts,
    reciprocal,
)

Ohm = Quantity
Farad = Quantity
Henry = Quantity
Second = Quantity
Exponent = Quantity
PseudoCapacitance = Quantity

# A ladder in time is exact from SLOWEST/N to FASTEST, times the sample rate, for N samples [rad].
SLOWEST, FASTEST = 0.3, 10.0
STEP = 0.95  # step h of ln x; the relative error of the trapezoidal rule is then 6e-5
BEYOND = np.log(600.0)  # margin of ln x beyond the band: the ends are exact to first order only


def beside(s: Complex[AnyArray, "..."], value: Quantity) -> Complex[AnyArray, "..."]:
    """A field of an element as complex numbers, in the namespace of both."""
    return as_complex(namespace(s, value).asarray(value))


class Resistance(AbstractRational):
    """A resistor, Z = R."""

    symbol: ClassVar[str] = "R"
    r: Ohm

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return _wide(beside(s, self.r), s)

    def admittance(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Admittance 1/Z [S]."""
        return _wide(self._inverse(s), s)

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slope, as numbers that broadcast with s."""
        r = beside(s, self.r)
        return r, [r]

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Admittance and its slope, as numbers that broadcast with s."""
        y = self._inverse(s)
        return y, [-y]

    def _inverse(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        return beside(s, 1 / namespace(s, self.r).asarray(self.r))

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return Rational(namespace(self.r).asarray(self.r)[None], np.ones(1))

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the resistor into the netlist."""
        netlist.part("R", self.r, plus, minus)


class Capacitance(AbstractRational):
    """A capacitor, Z = 1 / (s C)."""

    symbol: ClassVar[str] = "C"
    c: Farad

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Admittance 1/Z [S]."""
        return s * beside(s, self.c)

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slope."""
        z = self(s)
        return z, [-z]

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Admittance and its slope."""
        y = self.admittance(s)
        return y, [y]

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return Rational(np.ones(1), _of_first_order(self.c))

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the capacitor into the netlist."""
        netlist.part("C", self.c, plus, minus)


class Inductance(AbstractRational):
    """An inductor, Z = s L."""

    symbol: ClassVar[str] = "L"
    inductance: Henry

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return s * beside(s, self.inductance)

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slope."""
        z = self(s)
        return z, [z]

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        return Rational(_of_first_order(self.inductance), np.ones(1))

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the inductor into the netlist."""
        netlist.part("L", self.inductance, plus, minus)


class ModifiedInductance(AbstractIrrational):
    """A modified inductance, Z = (s L)^α, whose phase is 90° α at every frequency.

    Source: `La` of impedance.py 1.7. Its docstring has L (jω)^α, its code (L jω)^α, as here.
    """

    symbol: ClassVar[str] = "La"
    inductance: Quantity
    alpha: Exponent

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω], with the branch that is real for s > 0."""
        return namespace(s, self.alpha).exp(self._log(s))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance, and its slopes α Z and Z ln Z."""
        log = self._log(s)
        z = namespace(s, self.alpha).exp(log)
        return z, [beside(s, self.alpha) * z, z * log]

    def _log(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """α ln (s L)."""
        xp = namespace(s, self.inductance, self.alpha)
        return beside(s, self.alpha) * xp.log(s * beside(s, self.inductance))

    def exponents(self) -> tuple[Exponent, ...]:
        """Exponent α."""
        return (self.alpha,)


class Relaxation(AbstractRational):
    """A resistor parallel to a capacitor of C = τ / R, Z = R / (1 + s τ).

    Source: `K` of impedance.py, an element of the linear Kramers-Kronig test (Boukamp 1995).
    """

    symbol: ClassVar[str] = "K"
    r: Ohm
    tau: Second

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return beside(s, self.r) * reciprocal(beside(s, 1.0) + s * beside(s, self.tau))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance, and its slopes Z and −Z s τ / (1 + s τ)."""
        x = s * beside(s, self.tau)
        share = reciprocal(beside(s, 1.0) + x)
        z = beside(s, self.r) * share
        return z, [z, -z * x * share]

    def rational(self) -> Rational:
        """Impedance [Ω] as a ratio of polynomials in s."""
        xp = namespace(self.r, self.tau)
        return Rational(xp.asarray(self.r)[None], xp.append(1.0, self.tau))

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the resistor and the capacitor into the netlist."""
        parallel(resistor(self.r), capacitor(self.tau / self.r)).connect(netlist, plus, minus)


class ConstantPhase(AbstractIrrational):
    """A constant-phase element, Z = 1 / (Q s^α), whose phase is −90° α at every frequency."""

    symbol: ClassVar[str] = "CPE"
    q: PseudoCapacitance
    alpha: Exponent

    def __call__(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Impedance [Ω]."""
        return reciprocal(self.admittance(s))

    def admittance(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Admittance 1/Z [S], with the branch of s^α that is real for s > 0."""
        return beside(s, self.q) * namespace(s, self.alpha).exp(self._log_power(s))

    def slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Impedance and its slopes."""
        return inverted(*self.admittance_slopes(s))

    def admittance_slopes(self, s: Complex[AnyArray, "..."]) -> Slopes:
        """Admittance and its slopes."""
        log_power = self._log_power(s)
        y = beside(s, self.q) * namespace(s, self.alpha).exp(log_power)
        return y, [y, y * log_power]

    def _log_power(self, s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """α ln s."""
        xp = namespace(s, self.alpha)
        log, alpha = xp.log(s), xp.asarray(self.alpha)
        return from_parts(alpha * log.real, alpha * log.imag)

    def exponents(self) -> tuple[Exponent, ...]:
        """Exponent α."""
        return (self.alpha,)

    def state_space(self, rate: float | Float[AnyArray, ""], samples: int) -> StateSpace:
        """The ladder of relaxations from below the slowest to above the fastest time of a record.

        R_k and C_k of the pairs cover eight decades. The states are scaled so that the system stays
        nearly symmetric in a loop with a source; its matrix exponential loses no digits then.
        """
        xp, x = namespace(self.q, self.alpha, rate), _corners(SLOWEST / samples, FASTEST) * rate
        alpha, q = xp.asarray(self.alpha), xp.asarray(self.q)
        level, slower, faster = _ladder(q, alpha, x)
        rises = xp.append(level * x ** (1 - alpha), slower)  # R_k x_k and 1/C [Ω/s]
        unit = 1 / (q * rate ** (1 + alpha))  # |Z| at the sample rate, divided by it [Ω s]
        share = xp.append(xp.full(x.shape, 1 - alpha), 1.0)
        return StateSpace(
            xp.diag(xp.append(-x, 0.0)),
            xp.sqrt(rises / unit)[:, None],
            xp.sqrt(rises * unit) * share,
            faster[None],
        )

    def connect(self, netlist: Netlist, plus: str, minus: str) -> None:
        """Write the ladder that replaces the element into the netlist."""
        low, high = netlist.band
        netlist.remarks.add(
            f"constant-phase element as RC pairs, error below 0.01 % from {low:g} Hz to {high:g} Hz"
        )
        ladder(float(self.q), float(self.alpha), netlist.band).connect(netlist, plus, minus)


def _of_first_order(value: Quantity) -> Float[AnyArray, "2"]:
    """The polynomial value · s."""
    xp = namespace(value)
    value = xp.asarray(value)
    return xp.stack([xp.zeros_like(value), value])


def _wide(z: Complex[AnyArray, "..."], s: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """Numbers that do not depend on s, for every s."""
    return namespace(s, z).broadcast_to(z, np.broadcast_shapes(z.shape, s.shape))


def _corners(low: float, high: float) -> Float[np.ndarray, " n"]:
    """x_k from far below `low` to far above `high` [rad/s]."""
    return np.exp(np.arange(np.log(low) - BEYOND, np.log(high) + BEYOND + STEP, STEP))


def _ladder(
    q: Quantity, alpha: Quantity, x: Float[AnyArray, " n"]
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """sin(πα) h / (πQ) without the factor 1 − α, 1/C of all slower and R of all faster pairs."""
    xp = namespace(q, alpha, x)
    level = xp.sinc(1 - alpha) * STEP / q
    slower = level * x[0] ** (1 - alpha) * (1 - alpha) / xp.expm1(STEP * (1 - alpha))
    faster = level * x[-1] ** -alpha * (1 - alpha) / xp.expm1(STEP * alpha)
    return level, slower, faster


def ladder(q: float, alpha: float, band: tuple[float, float]) -> AbstractImpedance:
    """Resistors and capacitors that approximate a constant-phase element in a frequency band.

    A capacitor replaces it exactly if α is 1.

    Args:
        q: Q [S s^α].
        alpha: α.
        band: Lowest and highest frequency [Hz].
    """
    if alpha > 1:
        raise ValueError(
            f"an exponent is {alpha:.6g}; no passive network has an exponent above 1: fit a "
            "circuit with a capacitor instead of the constant-phase element"
        )
    if alpha == 1:
        return capacitor(q)
    x = _corners(2 * np.pi * band[0], 2 * np.pi * band[1])
    level, slower, faster = map(float, _ladder(q, alpha, x))
    r = level * (1 - alpha) * x**-alpha
    pairs = [parallel(resistor(a), capacitor(1 / (a * b))) for a, b in zip(r, x, strict=True)]
    return series(resistor(faster), *pairs, capacitor(1 / slower))


def resistor(r: Ohm) -> Resistance:
    """A resistor, Z = R, from R [Ω]."""
    return Resistance(r)


def capacitor(c: Farad) -> Capacitance:
    """A capacitor, Z = 1 / (s C), from C [F]."""
    return Capacitance(c)


def inductor(inductance: Henry) -> Inductance:
    """An inductor, Z = s L, from L [H].

    In series it makes the impedance grow with the frequency. Such a load has no response in time;
    maximum likelihood and `identify_impedance` need none.
    """
    return Inductance(inductance)


def constant_phase(q: PseudoCapacitance, alpha: Exponent) -> ConstantPhase:
    """A constant-phase element, Z = 1 / (Q s^α); impedance.py calls it `CPE`.

    Args:
        q: Q [S s^α]; it is a capacitance [F] if α = 1.
        alpha: α, above 0 and at most 1.
    """
    return ConstantPhase(q, alpha)


def cole(r: Ohm, tau: Second, alpha: Exponent) -> Parallel:
    """A relaxation with a distribution of time constants, Z = R / (1 + (s τ)^α).

    Source: K. S. Cole, Permeability and impermeability of cell membranes for ions, 1940. It is R in
    parallel with a constant-phase element of Q = τ^α / R. Unlike those of Q and α, the errors of τ
    and α are almost uncorrelated, and the unit of τ does not depend on α.

    Args:
        r: R [Ω].
        tau: τ [s].
        alpha: α, above 0 and at most 1. With α = 1 it is a resistor parallel to a capacitor.
    """
    r, tau, alpha = map(namespace(r, tau, alpha).asarray, (r, tau, alpha))
    return parallel(resistor(r), constant_phase(tau**alpha / r, alpha))
