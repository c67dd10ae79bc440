"""Both voltages of a recording and their noise: the input of every estimator."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.signals.harmonics import namespace
from etid.signals.noise import noise_std

RIPPLE = 1e-5  # error of the interpolation relative to the signal: a lower limit of the noise


class Measurement(eqx.Module):
    """Both voltages of a recording and the noise of each.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        sigma_th: Standard deviation of the noise of `v_th` [V].
        sigma_out: Standard deviation of the noise of `v_out` [V].
        sample_rate: Sampling rate [Hz].
    """

    v_th: Float[Array, "*lane time"]
    v_out: Float[Array, "*lane time"]
    sigma_th: Float[Array, "*lane"]
    sigma_out: Float[Array, "*lane"]
    sample_rate: Float[Array, "*lane"]


def measure(
    v_th: Float[Array, " time"],
    v_out: Float[Array, " time"],
    resolution_th: Float[Array, ""],
    resolution_out: Float[Array, ""],
    sample_rate: Float[Array, ""],
) -> Measurement:
    """Both voltages with their estimated noise; `resolution` is the converter's step [V] or 0."""
    sigma_th, sigma_out = noise(v_th, resolution_th), noise(v_out, resolution_out)
    return Measurement(v_th, v_out, jnp.asarray(sigma_th), jnp.asarray(sigma_out), sample_rate)


def noise(
    v: Float[Array | np.ndarray, " time"], resolution: Float[Array | np.ndarray, ""]
) -> Float[Array | np.ndarray, ""]:
    """Standard deviation of the noise of a record, in its unit and limited by `trusted`."""
    return trusted(v, noise_std(v, resolution))


def trusted(
    v: Float[Array | np.ndarray, " time"], sigma: Float[Array | np.ndarray, ""]
) -> Float[Array | np.ndarray, ""]:
    """Noise of a record, at least as large as the error of the interpolation."""
    of = namespace(v)
    return of.asarray(of.maximum(sigma, RIPPLE * of.ptp(v)))
