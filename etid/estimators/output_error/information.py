"""Information of the records about the parameters: curvature and covariance.

The residual r of `etid.estimators.output_error.prediction` is coloured, because G filters the noise
of V_th. The noise in the records also makes JᵀJ too large. The covariance accounts for both:

    cov = H⁻¹ (Jᵀ Σ J) H⁻¹,      Σ = (σ_out² K Kᵀ + σ_th² G Gᵀ)/s,
    H   = JᵀJ − N ((σ_th² Σ ∂h ∂hᵀ + σ_out² Σ ∂k ∂kᵀ)/s − ∂s ∂sᵀ/(4 s²)),

H is the curvature of the *expected* objective.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.estimators.output_error.prediction import (
    IMPULSE,
    Records,
    impulse,
    measured_impulse,
    residual_variance,
)
from etid.likelihood.sandwich import Curvature
from etid.solvers.matrices import inverse


class Slopes(eqx.Module):
    """A residual, an impulse response, and their Jacobians.

    Attributes:
        residual: Scaled residual.
        jacobian: Derivatives of the residual with respect to the parameters.
        h: Impulse response of the loaded driver.
        slope: Derivatives of the impulse response with respect to the parameters.
    """

    residual: Float[Array, " interval"]
    jacobian: Float[Array, "interval n"]
    h: Float[Array, " lag"]
    slope: Float[Array, "lag n"]


def slopes(
    evaluate: Callable[
        [Float[Array, " n"]], tuple[Float[Array, " interval"], Float[Array, " lag"]]
    ],
    q: Float[Array, " n"],
) -> Slopes:
    """Evaluate a scaled residual, an impulse response, and their Jacobians at q."""

    def twice(q: Float[Array, " n"]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        both = evaluate(q)
        return both, both

    (jacobian, slope), (residual, h) = jax.jacfwd(twice, has_aux=True)(q)
    return Slopes(residual, jacobian, h, slope)


def padded_size(rows: int) -> int:
    """Length of an FFT without wrap-around of a filter [samples]."""
    return 2 ** math.ceil(math.log2(rows + IMPULSE))


def noise_power(records: Records, h: Float[Array, " lag"], size: int) -> Float[Array, " bin"]:
    """Power of the noise of the residual at each frequency of an FFT, per sample [V²]."""
    power_out = records.sigma_out**2 * jnp.abs(jnp.fft.rfft(impulse()[:, 0], size)) ** 2
    return power_out + records.sigma_th**2 * jnp.abs(jnp.fft.rfft(h, size)) ** 2


def bin_weights(size: int) -> Float[np.ndarray, " bin"]:
    """Weights with which the squares of `rfft` sum to those of the samples (Parseval)."""
    weight = np.full(size // 2 + 1, 2.0 / size)
    weight[[0, -1]] = 1.0 / size
    return weight


def curvature(records: Records, at: Slopes, precision: Float[Array, " n"]) -> Curvature:
    """H and JᵀΣJ; `precision` is that of independent priors and adds to the curvature.

    The last parameter is the delay of the record [samples].
    """
    h, slope, jacobian = at.h, at.slope, at.jacobian
    s = residual_variance(records, h)
    s_slope = 2 * records.sigma_th**2 * h @ slope
    samples, rows = records.intervals, jacobian.shape[0]
    noise = records.sigma_th**2 * slope.T @ slope / s
    noise = noise - jnp.outer(s_slope, s_slope) / (4 * s**2)
    k_slope = measured_impulse()[:, 1]
    noise = noise.at[-1, -1].add(records.sigma_out**2 * jnp.sum(k_slope**2) / s)
    # Jᵀ Σ J by Parseval; J is padded to avoid wrap-around of the filters.
    size = padded_size(rows)
    weight = jnp.asarray(bin_weights(size)) * noise_power(records, h, size)
    spectrum = jnp.fft.rfft(jacobian, size, axis=0)
    real, imaginary = spectrum.real, spectrum.imag
    score = real.T @ (weight[:, None] * real) + imaginary.T @ (weight[:, None] * imaginary)
    information, prior = jacobian.T @ jacobian, jnp.diag(precision)
    return Curvature(information - samples * noise + prior, score / s + prior)


def further(
    of: Curvature, gradient: Float[Array, " all"], kept: int
) -> tuple[Float[Array, " further"], Float[Array, " further"]]:
    """Newton step of each parameter after `kept` alone, from a minimum over those, and its error.

    The step starts from 0, and the others are free. Rao's score test has power only where
    this step is large relative to its standard error.
    """
    h = of.expected
    others = h[kept:, :kept] @ inverse(h[:kept, :kept])
    towards = jnp.concatenate([-others, jnp.eye(h.shape[0] - kept)], axis=1)
    own = jnp.diagonal(towards @ h[:, kept:])
    variance = jnp.einsum("ij,jk,ik->i", towards, of.score, towards)
    return -(towards @ gradient) / own, jnp.sqrt(variance) / own
