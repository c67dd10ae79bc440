"""Circuits: parameters with names, units and typical values; and the circuits of etid.

A circuit is a frozen module with named parameters and one method, `impedance()`. This method builds
the impedance from `resistor`, `capacitor`, `inductor`, `constant_phase`, `cole`, `series` and
`parallel`. etid derives everything else from the circuit: filter, fit, covariance, text with units,
and netlist.
"""

import abc
import dataclasses
import functools
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.diffusion import diffusion
from etid.circuits.elements import (
    Exponent,
    Farad,
    Ohm,
    Second,
    capacitor,
    cole,
    resistor,
)
from etid.circuits.impedance import AbstractImpedance, Quantity, parallel, series
from etid.precision import Module, in_float64, namespace, unmasked
from etid.printing import Overview, Overviewed, element_rows
from etid.signals.transfer import AnyArray, frequency_variable, widened

_Same = TypeVar("_Same", bound="AbstractCircuit")

STEP = 3e-6  # of ln element; differences of ln (τ^α / R) are then right to 1e-10
STEP_OF_EXPONENT = 1e-5  # of ln element, for the slope of an exponent
STEEP = 4.0  # standard errors by which an exponent exceeds 1: by chance once in 30 000


def parameter(unit: str, *, typical: float) -> Any:
    """Declare a positive circuit parameter.

    Args:
        unit: `"ohm"`, `"farad"`, `"henry"`, `"second"`, `"ampere"`, `"siemens second^alpha"` for
            the Q of a constant-phase element, `"1"` for its exponent, `"ohm second^-1/2"` for a
            Warburg element, or `"second ohm^(1/alpha)"` for a modified inductance.
        typical: Expected magnitude in the SI unit; a fit may start at this value.

    Returns:
        A field for the class body of a circuit, as in `r: Ohm = parameter("ohm", typical=1e5)`.

    Raises:
        ValueError: The unit is not known.
    """
    if unit not in (known := dimensions(1.0)):
        raise ValueError(f"unit {unit!r} is not known; use one of {sorted(known)}")
    return eqx.field(
        default=typical, converter=_numbers, metadata={"unit": unit, "typical": typical}
    )


def dimensions(alpha: Any) -> dict[str, tuple[Any, Any]]:
    """Powers of impedance and of time in each unit, for a circuit with the exponent α."""
    return {
        "ohm": (1.0, 0.0),
        "farad": (-1.0, 1.0),
        "henry": (1.0, 1.0),
        "second": (0.0, 1.0),
        "ampere": (-1.0, 0.0),
        "siemens second^alpha": (-1.0, alpha),
        "ohm second^-1/2": (1.0, -0.5),
        "second ohm^(1/alpha)": (1 / alpha, 1.0),
        "1": (0.0, 0.0),
    }


def _numbers(value: Any) -> Any:
    """The value of a parameter as an array of NumPy, which has float64 in every process."""
    if isinstance(value, jax.Array):
        return value
    numbers = np.asarray(unmasked(value))
    return numbers.astype(float) if numbers.dtype.kind in "biu" else numbers


class _Titled:
    """A title in print; what JAX makes of a circuit has none."""

    __slots__ = ("_title",)  # equinox would make an entry of `__dict__` part of the tree structure


class AbstractCircuit(_Titled, Overviewed, Module):
    """A passive two-terminal circuit with positive parameters.

    Attributes:
        formula: Impedance of the circuit as text for a methods section; may be empty.
    """

    formula: ClassVar[str] = ""

    @abc.abstractmethod
    def impedance(self) -> AbstractImpedance:
        """Impedance [Ω] as a function of s [rad/s], built from elements."""

    def __check_init__(self) -> None:
        """Refuse an element that is 0 or negative. NaN is one that is not known."""
        for name in self.names():
            value = getattr(self, name)
            if isinstance(value, jax.core.Tracer) or not np.any(np.asarray(value) <= 0):
                continue
            raise ValueError(
                f"{name} of {type(self).__name__} is {np.min(value):g}; the elements of a circuit "
                "must be positive"
            )

    @classmethod
    def of_fit(cls: type[_Same], numbers: Iterable[Any]) -> _Same:
        """A circuit of the results of a fit, in the order of `names`: they may be 0 or negative."""
        return jax.tree.unflatten(_structure(cls), list(numbers))

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Parameter names, in the order of `log_values`."""
        return _names(cls)

    @classmethod
    def units(cls) -> dict[str, str]:
        """Unit of each parameter."""
        return {f.name: f.metadata["unit"] for f in dataclasses.fields(cls)}

    @classmethod
    def scaling(cls) -> Float[np.ndarray, "2 parameter"]:
        """Powers of impedance and of time scale to which each parameter is proportional."""
        powers = dimensions(0.8)  # for a typical α; used only for starts of a fit
        return np.array([powers[unit] for unit in cls.units().values()]).T

    @in_float64
    @np.errstate(all="ignore")  # elements of a fit that failed may be 0
    def response(self, frequency: Quantity) -> Complex[AnyArray, "..."]:
        """Impedance Z(j 2π f).

        Args:
            frequency: Real frequencies [Hz].

        Returns:
            Impedance [Ω] at each frequency, an array of NumPy outside of transformations of JAX.
        """
        circuit = self.of_fit(_plain(getattr(self, name)) for name in self.names())
        z = circuit.impedance()(frequency_variable(_plain(frequency, float)))
        return _plain(z)

    @in_float64
    def values(self) -> Float[AnyArray, "*lane parameter"]:
        """Parameters in SI units, as an array of NumPy outside of transformations of JAX."""
        values = [_plain(getattr(self, name)) for name in self.names()]
        return namespace(*values).stack(values, axis=-1)

    @in_float64
    @np.errstate(all="ignore")  # elements of a fit that failed may be 0
    def log_values(self) -> Float[AnyArray, "*lane parameter"]:
        """Natural logarithms of the parameters in SI units, in the namespace of `values`."""
        values = self.values()
        return namespace(values).log(values)

    def with_log_values(
        self: _Same, log_values: Float[Array | np.ndarray, "*lane parameter"]
    ) -> _Same:
        """A circuit of the same class with other parameters.

        Args:
            log_values: Natural logarithms of the parameters in SI units, in the order of `names`.

        Returns:
            A new circuit; this circuit does not change.
        """
        return self.with_values(namespace(log_values).exp(log_values))

    def with_values(self: _Same, values: Float[Array | np.ndarray, "*lane parameter"]) -> _Same:
        """A circuit of the same class with these parameters in SI units."""
        return type(self)(**{name: values[..., i] for i, name in enumerate(self.names())})

    @property
    def is_rational(self) -> bool:
        """Whether the impedance is a ratio of polynomials in s."""
        return self.impedance().is_rational

    def titled(self: _Same, title: str) -> _Same:
        """The same circuit; print shows this title above its elements."""
        same = self.of_fit([getattr(self, name) for name in self.names()])
        object.__setattr__(same, "_title", title)
        return same

    def exponents(self) -> tuple[Quantity, ...]:
        """Exponents α of the powers of s in the impedance; empty for a ratio of polynomials."""
        return self.impedance().exponents() if _has_exponents(type(self)) else ()

    def _overview(self) -> Overview:
        kind, values = type(self).__name__, np.asarray(self.values())
        batch = f", batch of {values.shape[:-1]}" if values.ndim > 1 else ""
        if title := getattr(self, "_title", ""):
            return Overview(f"{title}{batch}", element_rows(self.units(), values))
        if not self._may_be_one(values):
            # Such as a derivative by the elements, which JAX returns in a circuit: it has no unit.
            rows = [(n, *of) for n, *of in element_rows(dict.fromkeys(self.names(), "1"), values)]
            return Overview(f"{kind}{batch}: numbers by element in SI units, no circuit", rows)
        formula = f": {self.formula}" if self.formula not in ("", kind) else ""
        return Overview(f"{kind}{batch}{formula}", element_rows(self.units(), values))

    def _may_be_one(self, values: np.ndarray) -> bool:
        """Whether elements are of a size that they can have: not negative, not 1e12 times another.

        Elements that are not a finite number, or 0, are those of a fit that failed.
        """
        typical = np.asarray(type(self)().values())
        size = np.abs(values / typical)
        known = np.isfinite(values) & (size > 0)
        return bool(np.all(values[np.isfinite(values)] >= 0)) and not np.any(
            known & ((size > 1e12) | (size < 1e-12))  # batteries have 1 mΩ and 100 F
        )

    def __repr__(self) -> str:
        try:
            overview = self._overview()
        except Exception:  # as in `Overviewed`
            return eqx.tree_pformat(self)
        elements = (f"{name}={text.strip()} {unit}".rstrip() for name, text, unit in overview.rows)
        return f"{type(self).__name__}({', '.join(elements)})"


Circuit = TypeVar("Circuit", bound=AbstractCircuit)


@np.errstate(all="ignore")  # a row whose fit fails may have any elements
def impedance_at(
    circuit: AbstractCircuit,
    logs: Float[AnyArray, "*row element"],
    frequency: Float[AnyArray, "*#row band"],
) -> Complex[AnyArray, "*row band"]:
    """Z [Ω] of a circuit whose elements have these logarithms, in the namespace of the arrays."""
    xp, tree = namespace(logs, frequency), impedance_tree(circuit, logs)
    shape = (*logs.shape[:-1], frequency.shape[-1])
    return _as_rows(xp, tree(frequency_variable(widened(frequency, len(shape)))), shape)


@np.errstate(all="ignore")
def with_slopes(
    circuit: AbstractCircuit,
    logs: Float[AnyArray, "*row element"],
    frequency: Float[AnyArray, "*#row band"],
) -> tuple[Complex[AnyArray, "*row band"], Complex[AnyArray, "*row element band"]]:
    """Z [Ω] of a circuit whose elements have these logarithms, and its derivatives by them.

    JAX differentiates what is in arrays of JAX. In NumPy the tree hands up exact slopes by the
    fields of its elements, and central differences only tell how fields follow from the elements of
    the circuit, as in Q = τ^α / R. They have no frequency, so that they cost little.
    """
    if namespace(logs, frequency) is jnp:

        def z(logs: Float[Array, "*row element"]) -> Complex[Array, "*row band"]:
            return impedance_at(circuit, logs, frequency)

        def along(way: Float[AnyArray, " element"]) -> Any:
            return jax.jvp(z, (logs,), (jnp.broadcast_to(way, logs.shape),))

        return jax.vmap(along, out_axes=(None, -2))(np.eye(logs.shape[-1]))

    tree, parts = _tree_and_parts(type(circuit), logs)
    value, by_field = tree.slopes(frequency_variable(widened(frequency, logs.ndim)))
    rows, band = logs.shape[:-1], frequency.shape[-1]
    sums: list[Any] = [None] * logs.shape[-1]
    for field, place, part in parts:
        slope = by_field[field] if part is None else by_field[field] * part
        sums[place] = slope if sums[place] is None else sums[place] + slope
    by_element = np.empty((*rows, logs.shape[-1], band), complex)
    for place, slope in enumerate(sums):
        by_element[..., place, :] = 0.0 if slope is None else slope
    return _as_rows(np, value, (*rows, band)), by_element


@np.errstate(all="ignore")
def too_steep(
    circuit: AbstractCircuit,
    logs: Float[AnyArray, "*row element"],
    cov: Float[AnyArray, "*row element element"],
) -> Bool[AnyArray, "*row"]:
    """Whether an exponent α exceeds 1 by more than four standard errors.

    The impedance of a passive element cannot fall faster than that of a capacitor (α = 1). If the
    true α is 1, noise makes the fitted α exceed 1 in every second fit, mostly by less than one
    standard error, and by more than four in one of 30 000 fits.

    Args:
        circuit: Structure of the circuits.
        logs: Logarithms of their elements.
        cov: Covariance of the logarithms.
    """
    xp, size = namespace(logs, cov), logs.shape[-1]
    if not circuit.exponents():
        return xp.zeros(logs.shape[:-1], bool)

    def alphas(logs: Float[AnyArray, "*row element"]) -> Float[AnyArray, "*row exponent"]:
        values = xp.exp(logs)
        of = circuit.of_fit([values[..., place] for place in range(size)])
        return xp.stack([xp.broadcast_to(one, logs.shape[:-1]) for one in of.exponents()], -1)

    steps = STEP_OF_EXPONENT * np.eye(size)
    slopes = [(alphas(logs + one) - alphas(logs - one)) / (2 * STEP_OF_EXPONENT) for one in steps]
    slope = xp.stack(slopes, -1)
    error = xp.sqrt(((slope @ cov) * slope).sum(-1))
    return (alphas(logs) - 1 > STEEP * error).any(-1)


def impedance_tree(
    circuit: AbstractCircuit, logs: Float[AnyArray, "*row element"]
) -> AbstractImpedance:
    """The tree of elements with these logarithms, which have an axis of one for frequencies."""
    return _tree(type(circuit), _by_element(namespace(logs).exp(logs)))


def _tree(kind: type[AbstractCircuit], values: Sequence[AnyArray]) -> AbstractImpedance:
    """The tree of elements of a circuit."""
    structure, places = _fields(kind)
    if places is None:
        return kind.impedance(kind.of_fit(values))
    return jax.tree.unflatten(structure, [values[place] for place in places])


def _tree_and_parts(
    kind: type[AbstractCircuit], logs: Float[np.ndarray, "*row element"]
) -> tuple[AbstractImpedance, list[tuple[int, int, Float[np.ndarray, "*row 1"] | None]]]:
    """The tree, and ∂ ln field / ∂ ln element by their places, without zeros; None stands for 1."""
    values, count = np.exp(logs), logs.shape[-1]
    _, places = _fields(kind)
    if places is not None:
        return _tree(kind, _by_element(values)), [(f, e, None) for f, e in enumerate(places)]
    ways = np.exp(STEP * np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)]))
    moved = values * ways.reshape(-1, *[1] * (logs.ndim - 1), count)
    fields, structure = jax.tree.flatten(_tree(kind, _by_element(moved)))
    parts, fields = [], [np.asarray(of) for of in fields]
    for place, of in enumerate(fields):
        if of.ndim == moved.ndim:  # else it is a constant
            fields[place] = of[0]
            by_element = np.log(of[1 : count + 1] / of[count + 1 :]) / (2 * STEP)
            parts += [(place, element, by_element[element]) for element in range(count)
                      if by_element[element].any()]  # fmt: skip
    return jax.tree.unflatten(structure, fields), parts


@functools.cache
def _fields(kind: type[AbstractCircuit]) -> tuple[Any, tuple[int, ...] | None]:
    """Structure of the tree of a class, and which of its elements each field is.

    The places are None if a field is computed from the elements, or is a constant.
    """
    circuit = kind()
    fields, structure = jax.tree.flatten(circuit.impedance())
    known = {id(getattr(circuit, name)): place for place, name in enumerate(kind.names())}
    places = tuple(known.get(id(of), -1) for of in fields)
    return structure, None if -1 in places else places


def _by_element(values: Float[AnyArray, "*row element"]) -> list[AnyArray]:
    """The values of each element, which broadcast with a band."""
    if values.ndim == 1 and namespace(values) is jnp:  # traced sooner than with an axis of one
        return [values[place] for place in range(values.shape[-1])]
    return [values[..., place : place + 1] for place in range(values.shape[-1])]


def _as_rows(xp: ModuleType, z: AnyArray, shape: tuple[int, ...]) -> AnyArray:
    """Z at every frequency of every row, in this namespace."""
    return xp.asarray(z) if z.shape == shape else xp.broadcast_to(z, shape)


def _plain(of: Any, kind: Any = None) -> Any:
    """An array of NumPy, unless JAX traces it."""
    xp = jnp if isinstance(of, jax.core.Tracer) else np
    return xp.asarray(of, kind)


@functools.cache  # a fit asks a thousand times
def _names(kind: type[AbstractCircuit]) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind))


@functools.cache
def _structure(kind: type[AbstractCircuit]) -> Any:
    """Structure of a circuit, to which numbers are given without a check."""
    return jax.tree.structure(kind())


@functools.cache
def _has_exponents(kind: type[AbstractCircuit]) -> bool:
    """Whether the impedance of a class has exponents; building an impedance takes long."""
    return bool(kind().impedance().exponents())


class SkinRC(AbstractCircuit):
    """Skin as a series resistor and one relaxation, Z = R_s + R_p / (1 + s R_p C_p) (paper, eq. 7).

    The paper writes eq. 7 as Z_bio(s) = ((R_s + R_p) + R_s R_p C_p s) / (1 + R_p C_p s). The
    typical values lie between the values of dry and damp fingertips (paper, Tables II and III).
    These are 186 and 17.4 kΩ for R_p, 0.12 and 0.66 nF for C_p, and 33.4 and 6.1 kΩ for R_s.
    """

    formula: ClassVar[str] = "R_s + R_p / (1 + s R_p C_p)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of eq. 7."""
        return series(resistor(self.r_s), parallel(resistor(self.r_p), capacitor(self.c_p)))

    @property
    @in_float64
    def f_c(self) -> Float[AnyArray, "..."]:
        """Corner frequency 1 / (2π R_p C_p) [Hz]."""
        return 1 / (2 * np.pi * _plain(self.r_p) * _plain(self.c_p))


class SkinCole(AbstractCircuit):
    """Skin with a distribution of time constants, Z = R_s + R_p / (1 + (s τ)^α).

    The formula is from Cole (1940). The typical resistances are those of `SkinRC`. The typical τ is
    R_p C_p of `SkinRC`. The typical α is the value of dry skin below 100 MHz, 1 - 0.2 (Gabriel, Lau
    and Gabriel, The dielectric properties of biological tissues: III, 1996, Table 1).
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

    The first layer is the faster one, in all fits. The sum of the typical resistances equals that
    of `SkinRC`. The typical time constants are 21 and 120 µs. Birlea, Birlea and Culea
    measured 10 to 40 and 100 to 200 µs in human skin (The Skin's Electrical Time Constants, 2011,
    doi 10.1007/978-3-642-22586-4_34).
    """

    formula: ClassVar[str] = "R_s + R_1 / (1 + s R_1 C_1) + R_2 / (1 + s R_2 C_2)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_1: Ohm = parameter("ohm", typical=70e3)
    c_1: Farad = parameter("farad", typical=0.3e-9)
    r_2: Ohm = parameter("ohm", typical=30e3)
    c_2: Farad = parameter("farad", typical=4e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of the series resistor and both layers."""
        first = parallel(resistor(self.r_1), capacitor(self.c_1))
        second = parallel(resistor(self.r_2), capacitor(self.c_2))
        return series(resistor(self.r_s), first, second)


class SkinWarburg(AbstractCircuit):
    """Skin as a layer through which charge diffuses, Z = R_s + R_p tanh √(s τ) / √(s τ).

    It is a line of many equal resistors and capacitors, such as ducts and cells in a layer (finite
    Warburg element). The typical resistances are those of `SkinRC`. τ is three times the mean time
    constant, which is that of `SkinRC`.
    """

    formula: ClassVar[str] = "R_s + R_p tanh(sqrt(s tau_d)) / sqrt(s tau_d)"
    r_s: Ohm = parameter("ohm", typical=20e3)
    r_p: Ohm = parameter("ohm", typical=100e3)
    tau_d: Second = parameter("second", typical=90e-6)

    def impedance(self) -> AbstractImpedance:
        """Impedance of the series resistor and the layer."""
        return series(resistor(self.r_s), diffusion(self.r_p, self.tau_d))


class ParallelRC(AbstractCircuit):
    """A resistor and a capacitor in parallel, Z = R_p / (1 + s R_p C_p).

    It describes skin whose series resistance is too small to be measured. The typical values are
    those of `SkinRC` (paper, Tables II and III).
    """

    formula: ClassVar[str] = "R_p / (1 + s R_p C_p)"
    r_p: Ohm = parameter("ohm", typical=100e3)
    c_p: Farad = parameter("farad", typical=0.3e-9)

    def impedance(self) -> AbstractImpedance:
        """Impedance of one relaxation."""
        return parallel(resistor(self.r_p), capacitor(self.c_p))


class Resistor(AbstractCircuit):
    """One resistor, Z = R, like the loads of the paper's Table I, 21.62 to 555 kΩ."""

    formula: ClassVar[str] = "R"
    r: Ohm = parameter("ohm", typical=100e3)

    def impedance(self) -> AbstractImpedance:
        """Impedance R."""
        return resistor(self.r)
