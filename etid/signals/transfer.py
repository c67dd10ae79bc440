"""Rational functions: evaluation, sum, poles, stability.

Coefficients are stored in *ascending* powers of the variable. In z⁻¹ this is SciPy's order of `b`
and `a`; in s it is the reverse of `scipy.signal`. Polynomials are multiplied with shifts, not with
`jnp.convolve`: under `vmap` it becomes a grouped convolution over all lanes, so that a NaN in one
lane spoils the others.

The functions of numbers at frequencies compute in the namespace of their arrays: arrays of NumPy
give arrays of NumPy, and nothing is traced.
"""

import functools
import math
import operator
from types import ModuleType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Inexact

from etid.precision import Module, namespace

AnyArray = Any  # of NumPy or JAX; a result has the namespace of the arguments
Values = TypeVar("Values", Array, np.ndarray)


def multiply_polynomials(p: Float[AnyArray, " p"], q: Float[AnyArray, " q"]) -> AnyArray:
    """Multiply two polynomials given by ascending coefficients."""
    xp, length = namespace(p, q), p.shape[0] + q.shape[0] - 1
    parts = [xp.pad(p[i] * q, (i, length - i - q.shape[0])) for i in range(p.shape[0])]
    return functools.reduce(operator.add, parts)


def add_polynomials(p: Float[AnyArray, " p"], q: Float[AnyArray, " q"]) -> Float[AnyArray, " pq"]:
    """Add two polynomials given by ascending coefficients."""
    xp, length = namespace(p, q), max(p.shape[0], q.shape[0])
    return xp.pad(p, (0, length - p.shape[0])) + xp.pad(q, (0, length - q.shape[0]))


def as_complex(x: Inexact[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """The same numbers with a complex type; works with JAX's strict type promotion too."""
    kind = np.result_type(x.dtype, np.complex64)
    if namespace(x) is np:
        return x.astype(kind, copy=False)
    return jax.lax.convert_element_type(x, kind)


def from_parts(
    real: Float[AnyArray, "..."], imaginary: Float[AnyArray, "..."]
) -> Complex[AnyArray, "..."]:
    """The complex numbers with these parts, which have one shape."""
    if namespace(real, imaginary) is np:
        z = np.empty(np.shape(real), np.result_type(real, np.complex64))
        z.real, z.imag = real, imaginary
        return z
    return jax.lax.complex(real, imaginary)


def power(z: Complex[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    """|z|²."""
    if namespace(z) is np:
        return z.real**2 + z.imag**2
    # These functions are in all formulas. Operations of `lax` are traced in a third of the time.
    real, imag = jax.lax.real(z), jax.lax.imag(z)
    return jax.lax.add(jax.lax.mul(real, real), jax.lax.mul(imag, imag))


def reciprocal(z: Complex[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """1/z, for |z| between 1e-150 and 1e150.

    XLA's complex division guards against overflow. The guard costs thirty times the division
    itself.
    """
    if namespace(z) is np:
        return np.reciprocal(z)
    scale = jax.lax.integer_pow(power(z), -1)
    real, imag = jax.lax.mul(jax.lax.real(z), scale), jax.lax.mul(jax.lax.imag(z), scale)
    return jax.lax.complex(real, jax.lax.neg(imag))


def combined(
    z: Float[AnyArray, "*row z"], slope: Complex[AnyArray, "z harmonic"]
) -> Complex[AnyArray, "*row harmonic"]:
    """Σ z ∂/∂z, in real arithmetic, because complex matrix products take ten times as long."""
    if namespace(z, slope) is np:  # real and imaginary parts are columns of one product
        return (z @ np.ascontiguousarray(slope).view(slope.real.dtype)).view(slope.dtype)
    return jax.lax.complex(z @ slope.real, z @ slope.imag)


class Rational(Module):
    """A ratio of polynomials, `(num[0] + num[1] x + …) / (den[0] + den[1] x + …)`.

    The variable x is s [rad/s] for impedances in continuous time and z⁻¹ for discrete filters.
    """

    num: Float[AnyArray, " num"]
    den: Float[AnyArray, " den"]

    def __call__(self, x: Inexact[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
        """Evaluate at `x`."""
        xp = namespace(x, self.num, self.den)
        x, num, den = (as_complex(xp.asarray(of)) for of in (x, self.num, self.den))
        return xp.polyval(num[::-1], x) * reciprocal(xp.polyval(den[::-1], x))

    def add(self, other: "Rational") -> "Rational":
        """The sum `self + other`."""
        return Rational(
            add_polynomials(
                multiply_polynomials(self.num, other.den),
                multiply_polynomials(other.num, self.den),
            ),
            multiply_polynomials(self.den, other.den),
        )

    def reciprocal(self) -> "Rational":
        """The reciprocal `1 / self`."""
        return Rational(self.den, self.num)


def frequency_variable(frequency: Float[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """The variable s = j 2π f [rad/s] at real frequencies [Hz]."""
    if namespace(frequency) is np:
        return 2j * np.pi * np.asarray(frequency)
    return jax.lax.complex(jnp.zeros_like(frequency), 2 * np.pi * frequency)


def delayed(
    value: Complex[AnyArray, "*row harmonic"],
    frequency: Float[AnyArray, "*#row harmonic"],
    delay_samples: Float[AnyArray, "*#row"] | float,
    sample_rate: Float[AnyArray, "*#row"] | float,
) -> Complex[AnyArray, "*row harmonic"]:
    """`value` · e^(−j 2π f τ) at frequencies [Hz], for a delay τ in samples, or one per row."""
    xp = namespace(value, frequency, delay_samples, sample_rate)
    late = _by_row(xp, delay_samples / sample_rate)
    turn = -2 * np.pi * widened(frequency, np.ndim(late)) * late
    if xp is np:
        return value * from_parts(np.cos(turn), np.sin(turn))
    return value * jax.lax.complex(jax.lax.cos(turn), jax.lax.sin(turn))


def turns(cycles: Float[AnyArray, "*row"], count: int) -> Complex[AnyArray, "*row harmonic"]:
    """e^{j2πkc} for k = 1 … count along a last axis, as products of about 2 √count sines.

    A sine costs as much as the rest of the computation.
    """
    xp, side = namespace(cycles), math.isqrt(count) + 1
    each = 2 * np.pi * _by_row(xp, cycles)
    first, steps = (widened(np.arange(start, side + start), each.ndim) for start in (1.0, 0.0))
    fine, coarse = each * first, each * side * steps
    if xp is np:
        left, right = (from_parts(np.cos(of), np.sin(of)) for of in (coarse, fine))
        return (left[..., :, None] * right[..., None, :]).reshape(*cycles.shape, -1)[..., :count]
    left = jnp.stack([jax.lax.cos(coarse), jax.lax.sin(coarse)], axis=-1)
    c, s = jax.lax.cos(fine), jax.lax.sin(fine)
    # A matrix product, because XLA would move sines back into the loop over all harmonics.
    parts = (left @ jnp.stack(one, axis=-2) for one in ([c, -s], [s, c]))
    return jax.lax.complex(*(of.reshape(*cycles.shape, -1)[..., :count] for of in parts))


def widened(values: Inexact[AnyArray, "..."], axes: int) -> Inexact[AnyArray, "..."]:
    """The values with so many axes at least, for JAX: it may be told to add none by itself."""
    more = axes - values.ndim
    return values.reshape(*[1] * more, *values.shape) if more > 0 else values


def _by_row(xp: ModuleType, value: Any) -> Any:
    """One number as it is, those of rows with an axis for their harmonics."""
    return xp.expand_dims(value, -1) if np.ndim(value) else value


def delay_variable(
    frequency: Float[AnyArray, "..."], sample_rate: float | Float[AnyArray, ""]
) -> Complex[AnyArray, "..."]:
    """The variable z⁻¹ = exp(−j 2π f / fs) at real frequencies [Hz]."""
    cycles = frequency / sample_rate
    return namespace(cycles).exp(-frequency_variable(cycles))


def poles(a: Float[AnyArray, " order1"]) -> Complex[AnyArray, " order"]:
    """Poles in z of 1 / (a[0] + a[1] z⁻¹ + …)."""
    if namespace(a) is not np:
        return jnp.roots(a, strip_zeros=False)
    if not np.isfinite(a).all():
        return np.full(a.size - 1, np.nan, complex)  # as JAX does
    found = np.zeros(a.size - 1, complex)
    roots = np.roots(a)
    found[: roots.size] = roots
    return found


def is_stable(a: Float[AnyArray, " order1"]) -> Bool[AnyArray, ""]:
    """Whether all poles of 1 / (a[0] + a[1] z⁻¹ + …) lie inside the unit circle.

    Schur-Cohn step-down recursion (Oppenheim & Schafer, *Discrete-Time Signal Processing*, lattice
    filters): stable if and only if every reflection coefficient is smaller than one in magnitude.
    No eigenvalues are needed, so it runs on every backend. NaN coefficients are not stable.
    """
    xp, a = namespace(a), a / a[0]
    stable = xp.isfinite(a).all()
    for order in range(a.shape[0] - 1, 0, -1):
        k = a[order]
        stable = stable & (xp.abs(k) < 1)
        a = (a[:order] - k * a[order:0:-1]) / (1 - k**2)
    return stable


def reflect_poles(a: Float[AnyArray, " order1"]) -> Float[AnyArray, " order1"]:
    """Reflect poles outside the unit circle into it; the shape of |A(e^{jω})| stays the same."""
    xp, roots = namespace(a), poles(a)
    outside = xp.abs(roots) > 1
    inside = xp.where(outside, 1 / xp.conj(xp.where(outside, roots, 2.0)), roots)
    coefficients = xp.ones(1, inside.dtype)
    for i in range(inside.shape[0]):
        shifted = xp.pad(coefficients, (1, 0)) * -inside[i]
        coefficients = xp.pad(coefficients, (0, 1)) + shifted
    return coefficients.real if xp is np else jax.lax.stop_gradient(coefficients.real)
