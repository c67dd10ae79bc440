"""Periodic steady state of one nonlinear resistor in a linear network: harmonic balance.

The network around the resistor is a Norton source, of current J and admittance Y at each harmonic:
i + Y u = J. The resistor has the voltage u(i) at the current i(t). The unknown is the wave that
travels to the resistor, at the points of a grid over one period:

    a = u + R i,      b = u − R i = B(a),      a = S b + 2 R J / (1 + R Y),
    S = (1 − R Y) / (1 + R Y)

(Fettweis 1986, "Wave digital filters: theory and practice", Proc. IEEE 74; harmonic balance:
Kundert and Sangiovanni-Vincentelli 1986, IEEE Trans. Computer-Aided Design 5). S acts on the
Fourier coefficients, B on the points in time. A passive network has |S| ≤ 1. With R as the
geometric mean of the smallest and the largest slope u′, whose ratio is κ, B has slopes of at most
(√κ − 1) / (√κ + 1). The equation is therefore a contraction: it has one solution, and its linear
systems are well conditioned.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Complex, Float

from etid.signals.transfer import as_complex, reciprocal

STEPS = 20
DIGITS = 1e-8  # error of the wave, relative to its largest value; a record has five digits


class _Patient(lx.BiCGStab):
    """A solver that never raises: a step that is no solution is 0, and the caller sees no progress.

    A fit tries elements for which there is no steady state in floating point; it must go on.
    """

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> tuple[Any, Any, Any]:
        """The solution, or zeros."""
        value, _, stats = super().compute(state, vector, options)
        return jnp.where(jnp.isfinite(value).all(), value, 0.0), lx.RESULTS.successful, stats


INNER = _Patient(rtol=1e-4, atol=1e-10, max_steps=100)  # the next Newton step corrects it
SLOPES = _Patient(rtol=1e-4, atol=1e-7, max_steps=100)


def to_time(coefficients: Complex[Array, " harmonic"], points: int) -> Float[Array, " time"]:
    """One period of a real signal, from its Fourier coefficients c₀, c₁, …."""
    return jnp.fft.irfft(coefficients, points, norm="forward")


def to_harmonics(signal: Float[Array, " time"]) -> Complex[Array, " harmonic"]:
    """Fourier coefficients c₀, c₁, … of one period of a real signal."""
    return jnp.fft.rfft(signal, norm="forward")


def steady_state(
    current: Callable[[Float[Array, " time"], Float[Array, ""]], Float[Array, " time"]],
    resistance: Float[Array, ""],
    source: Complex[Array, " harmonic"],
    admittance: Complex[Array, " harmonic"],
) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"]]:
    """Fourier coefficients of the voltage [V] and the current [A] of the resistor.

    Args:
        current: The solution i of u(i) + R i = a, as a function of a and R. A pytree, so that the
            result can be differentiated by what it contains.
        resistance: R [Ω], near the geometric mean of the smallest and the largest slope u′.
        source: Fourier coefficients of J [A], from c₀ on; the last ones are small.
        admittance: Y [S] at the same frequencies.
    """
    points = 2 * (source.size - 1)
    r = jax.lax.stop_gradient(resistance)
    mirror = reciprocal(1 + admittance * as_complex(r))
    arriving = to_time(2 * as_complex(r) * source * mirror, points)
    unit = jax.lax.stop_gradient(jnp.max(jnp.abs(arriving)))

    def off(a: Float[Array, " time"], given: Any) -> Float[Array, " time"]:
        current, arriving, mirror = given
        leaving = to_harmonics(a - 2 * r / unit * current(unit * a, r))
        return a - to_time((2 * mirror - 1) * leaving, points) - arriving / unit

    found = optx.root_find(
        off,
        optx.Newton(rtol=0.0, atol=DIGITS, norm=optx.max_norm, linear_solver=INNER),
        arriving / unit,
        (current, arriving, mirror),
        max_steps=STEPS,
        adjoint=optx.ImplicitAdjoint(linear_solver=SLOPES),
        throw=False,
    )
    settled = found.result == optx.RESULTS.successful
    a = unit * jnp.where(settled, found.value, jnp.nan)
    i = current(a, r)
    return to_harmonics(a - r * i), to_harmonics(i)
