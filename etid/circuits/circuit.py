"""Circuits: named elements with units and typical values, and those that come with etid.

A circuit is a frozen module with named parameters and one method, `impedance()`, built from
`resistor`, `capacitor`, `constant_phase`, `cole`, `series` and `parallel`. Everything else (filter,
fit, covariance, printing with units, netlist) follows from these lines.
"""

import abc
import dataclasses
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.display import DISPLAY
from etid.circuits.elements import (
    Exponent,
    Farad,
    Ohm,
    Second,
    capacitor,
    cole,
    resistor,
)
from etid.circuits.impedance import AbstractImpedance, parallel, series
from etid.signals.transfer import frequency_variable

Circuit = TypeVar("Circuit", bound="AbstractCircuit")
# Powers with which a parameter goes with the impedance and with the time scale of its circuit.
SCALING = {
    "ohm": (1.0, 0.0),
    "farad": (-1.0, 1.0),
    "second": (0.0, 1.0),
    "siemens second^alpha": (-1.0, 0.8),  # of a common α; only starts of a fit are made with it
    "1": (0.0, 0.0),
}
# Standard errors by which an exponent may exceed 1: of a relaxation of one time constant it does so
# by chance, in every second fit by less than one, in one of 30 000 by more than four.
ABOVE_ONE = 4.0


def parameter(unit: str, *, typical: float) -> Any:
    """Declare a positive circuit parameter.

    Args:
        unit: `"ohm"`, `"farad"`, `"second"`, `"siemens second^alpha"` for the Q of a constant-phase
            element, or `"1"` for its exponent.
        typical: Magnitude to expect, in SI; a fit may start there.

    Returns:
        A field of a circuit, to stand behind the `=` of its declaration.

    Raises:
        ValueError: The unit is not known.
    """
    if unit not in DISPLAY:
        raise ValueError(f"unit {unit!r} is not known; use one of {sorted(DISPLAY)}")
    return eqx.field(
        default=typical, converter=jnp.asarray, metadata={"unit": unit, "typical": typical}
    )


class AbstractCircuit(eqx.Module):
    """A passive two-terminal circuit with positive parameters.

    Attributes:
        formula: Its impedance as a methods section writes it; may be empty.
    """

    formula: ClassVar[str] = ""

    @abc.abstractmethod
    def impedance(self) -> AbstractImpedance:
        """Impedance [Ω] as a function of s [rad/s], built from elements."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Parameter names, in the order of `log_values`."""
        return tuple(f.name for f in dataclasses.fields(cls))

    @classmethod
    def units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {f.name: f.metadata["unit"] for f in dataclasses.fields(cls)}

    @classmethod
    def scaling(cls) -> Float[Array, "2 parameter"]:
        """Powers with which each parameter goes with the impedance and with the time scale."""
        return jnp.array([SCALING[unit] for unit in cls.units().values()]).T

    def response(self, frequency: Float[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance Z(j 2π f).

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            Impedance [Ω] at each.
        """
        return self.impedance()(frequency_variable(jnp.asarray(frequency)))

    def values(self) -> Float[Array, "*lane parameter"]:
        """Parameters in SI units."""
        return jnp.stack([getattr(self, name) for name in self.names()], axis=-1)

    def log_values(self) -> Float[Array, "*lane parameter"]:
        """Natural logarithms of the parameters in SI units."""
        return jnp.log(self.values())

    def with_log_values(self: Circuit, log_values: Float[Array, "*lane parameter"]) -> Circuit:
        """The same circuit with other parameters.

        Args:
            log_values: Natural logarithms of the parameters in SI units, in the order of `names`.

        Returns:
            A circuit of the same kind; this one stays as it is.
        """
        values = jnp.exp(log_values)
        return type(self)(**{name: values[..., i] for i, name in enumerate(self.names())})

    @property
    def is_rational(self) -> bool:
        """Whether the impedance is a ratio of polynomials in s."""
        return self.impedance().is_rational

    def is_too_steep(self, cov: Float[Array, "parameter parameter"]) -> Bool[Array, ""]:
        """Whether an exponent α exceeds 1 by more than its standard error explains.

        No passive element is steeper than a capacitor.

        Args:
            cov: Covariance of `log_values`.
        """

        def alphas(log_values):
            found = self.with_log_values(log_values).impedance().exponents()
            return jnp.stack([jnp.asarray(alpha) for alpha in found])

        if not self.impedance().exponents():
            return jnp.array(False)
        slope = jax.jacfwd(alphas)(self.log_values())
        error = jnp.sqrt(jnp.diagonal(slope @ cov @ slope.T))
        return jnp.any(alphas(self.log_values()) - 1 > ABOVE_ONE * error)


class SkinRC(AbstractCircuit):
    """Skin as a series resistor and one relaxation, Z = R_s + R_p / (1 + s R_p C_p) (paper, eq. 7).

    Equal to eq. 7, Z_bio(s) = ((R_s + R_p) + R_s R_p C_p s) / (1 + R_p C_p s). Typical values lie
    between those of dry and damp fingertips (paper, Tables II and III): 186 and 17.4 kΩ, 0.12 and
    0.66 nF, 33.4 and 6.1 kΩ.
    """

    formula: ClassVar[str] = "R_s + R_p / (1 + s R_p C_p)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of eq. 7."""
        return series(resistor(self.r_s), parallel(resistor(self.r_p), capacitor(self.c_p)))

    @property
    def f_c(self) -> Float[Array, "..."]:
        """Corner frequency 1 / (2π R_p C_p) [Hz]."""
        return 1 / (2 * jnp.pi * jnp.asarray(self.r_p * self.c_p))


class SkinCole(AbstractCircuit):
    """Skin whose relaxation is spread over time constants, Z = R_s + R_p / (1 + (s τ)^α).

    The formula is that of Cole (1940). Typical values are those of `SkinRC`, with τ = R_p C_p. The
    typical α is that of dry skin below 100 MHz, 1 - 0.2 (Gabriel, Lau and Gabriel, The dielectric
    properties of biological tissues: III, 1996, Table 1).
    """

    formula: ClassVar[str] = "R_s + R_p / (1 + (s tau)^alpha)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    tau: Second = parameter("second", typical=30e-6)
    alpha: Exponent = parameter("1", typical=0.8)

    def impedance(self) -> AbstractImpedance:
        """Impedance of Cole's formula."""
        return series(resistor(self.r_s), cole(self.r_p, self.tau, self.alpha))


class SkinLayers(AbstractCircuit):
    """Skin of two layers, each one relaxation, Z = R_s + R_1/(1 + s R_1 C_1) + R_2/(1 + s R_2 C_2).

    The first layer is the faster one by its typical values. The sum of the typical resistances is
    that of `SkinRC`. The typical time constants, 21 and 120 µs, lie in the ranges that Birlea,
    Birlea and Culea found in human skin, 10 to 40 and 100 to 200 µs (The Skin's Electrical Time
    Constants, 2011, doi 10.1007/978-3-642-22586-4_34).
    """

    formula: ClassVar[str] = "R_s + R_1 / (1 + s R_1 C_1) + R_2 / (1 + s R_2 C_2)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_1: Ohm = parameter("ohm", typical=70e3)
    c_1: Farad = parameter("farad", typical=0.3e-9)
    r_2: Ohm = parameter("ohm", typical=30e3)
    c_2: Farad = parameter("farad", typical=4e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of both layers."""
        first = parallel(resistor(self.r_1), capacitor(self.c_1))
        second = parallel(resistor(self.r_2), capacitor(self.c_2))
        return series(resistor(self.r_s), first, second)


class ParallelRC(AbstractCircuit):
    """A resistor and a capacitor in parallel, Z = R_p / (1 + s R_p C_p).

    It is skin whose series resistance is too small to be seen. Typical values are those of
    `SkinRC` (paper, Tables II and III).
    """

    formula: ClassVar[str] = "R_p / (1 + s R_p C_p)"
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of one relaxation."""
        return parallel(resistor(self.r_p), capacitor(self.c_p))


class Resistor(AbstractCircuit):
    """One resistor, Z = R: the loads of the paper's Table I, 21.62 to 555 kΩ."""

    formula: ClassVar[str] = "R"
    r: Ohm = parameter("ohm", typical=100e3)

    def impedance(self) -> AbstractImpedance:
        """Impedance R."""
        return resistor(self.r)
