"""Circuits: elements, series and parallel connection, the skin, and the driver.

A circuit is a frozen module with named parameters and one method, `impedance()`, built from
`resistor`, `capacitor`, `series` and `parallel`. Everything else (filter, fit, covariance, printing
with units) follows from these lines.
"""

import abc
import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.transfer import Rational, frequency_variable

# What a parameter may hold: one value, or a batch of them.
Quantity = Float[Array, "..."] | Float[np.ndarray, "..."] | float
Ohm = Quantity
Farad = Quantity
Circuit = TypeVar("Circuit", bound="AbstractCircuit")
DISPLAY = {"ohm": (1e3, "kΩ"), "farad": (1e-9, "nF")}  # scaled units exist only in print


def parameter(unit: str, *, typical: float) -> Any:
    """Declare a positive circuit parameter.

    Args:
        unit: `"ohm"` or `"farad"`.
        typical: Magnitude to expect, in SI; a fit may start there.
    """
    if unit not in DISPLAY:
        raise ValueError(f"unit {unit!r} is not known; use one of {sorted(DISPLAY)}")
    return eqx.field(
        default=typical, converter=jnp.asarray, metadata={"unit": unit, "typical": typical}
    )


def resistor(r: Ohm) -> Rational:
    """Impedance of a resistor, Z = R [Ω]."""
    return Rational(jnp.stack([jnp.asarray(r)]), jnp.ones(1))


def capacitor(c: Farad) -> Rational:
    """Impedance of a capacitor, Z = 1 / (s C) [Ω]."""
    c = jnp.asarray(c)
    return Rational(jnp.ones(1), jnp.stack([jnp.zeros_like(c), c]))


def series(*impedances: Rational) -> Rational:
    """Series connection, Z = Z₁ + Z₂ + …."""
    total = impedances[0]
    for z in impedances[1:]:
        total = total.add(z)
    return total


def parallel(*impedances: Rational) -> Rational:
    """Parallel connection, 1/Z = 1/Z₁ + 1/Z₂ + …."""
    return series(*(z.reciprocal() for z in impedances)).reciprocal()


class AbstractCircuit(eqx.Module):
    """A passive two-terminal circuit with positive parameters."""

    @abc.abstractmethod
    def impedance(self) -> Rational:
        """Impedance [Ω] as a rational function of s [rad/s]."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Parameter names, in the order of `log_values`."""
        return tuple(f.name for f in dataclasses.fields(cls))

    @classmethod
    def units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {f.name: f.metadata["unit"] for f in dataclasses.fields(cls)}

    def response(self, frequency: Float[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω] at real frequencies [Hz]."""
        return self.impedance()(frequency_variable(jnp.asarray(frequency)))

    def values(self) -> Float[Array, "*lane parameter"]:
        """Parameters in SI units."""
        return jnp.stack([getattr(self, name) for name in self.names()], axis=-1)

    def log_values(self) -> Float[Array, "*lane parameter"]:
        """Natural logarithms of the parameters in SI units."""
        return jnp.log(self.values())

    def with_log_values(self: Circuit, log_values: Float[Array, "*lane parameter"]) -> Circuit:
        """The same circuit with other parameters."""
        values = jnp.exp(log_values)
        return type(self)(**{name: values[..., i] for i, name in enumerate(self.names())})


class SkinRC(AbstractCircuit):
    """Skin as a series resistor and one relaxation, Z = R_s + R_p / (1 + s R_p C_p) (paper, eq. 7).

    Equal to eq. 7, Z_bio(s) = ((R_s + R_p) + R_s R_p C_p s) / (1 + R_p C_p s).
    """

    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)

    def impedance(self) -> Rational:
        """Impedance of eq. 7."""
        return series(resistor(self.r_s), parallel(resistor(self.r_p), capacitor(self.c_p)))

    @property
    def f_c(self) -> Float[Array, "..."]:
        """Corner frequency 1 / (2π R_p C_p) [Hz]."""
        return 1 / (2 * jnp.pi * jnp.asarray(self.r_p * self.c_p))


class Resistor(AbstractCircuit):
    """One resistor, Z = R: the paper's Table I loads."""

    r: Ohm = parameter("ohm", typical=100e3)

    def impedance(self) -> Rational:
        """Impedance R."""
        return resistor(self.r)
