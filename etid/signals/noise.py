"""White noise of a record, estimated from the record itself.

High-order differences annihilate the smooth part of a pulse response and keep white noise, whose
standard deviation follows from the median of their magnitude (Donoho & Johnstone 1994 use the
finest wavelet coefficients the same way). The median ignores the few per cent of samples at the
edges. A converter adds its own floor, resolution/√12.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

ORDER = (
    6  # differences; the ringing at a quarter of the rate is still smooth to them after the edges
)
HALVINGS = 40  # to 1e-12 of the largest difference, an edge of 1e5 times the noise at most
MEDIAN_TO_SIGMA = 1.482602218505602  # of |x| for a normal x


def _median(x: Float[Array, " sample"]) -> Float[Array, ""]:
    """Median of numbers that are not negative; of an even number the one or the other of the two.

    By bisection: sorting, which `jnp.median` does, costs ten times as much.
    """
    half, fixed = x.shape[0] / 2, jax.lax.stop_gradient(x)

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) / 2
        below = jnp.sum(fixed <= middle, dtype=x.dtype) < half
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    bounds = jnp.zeros((), x.dtype), jnp.max(fixed)
    low, high = jax.lax.fori_loop(0, HALVINGS, halve, bounds)
    return x[jnp.argmin(jnp.abs(fixed - (low + high) / 2))]


def noise_std(
    v: Float[Array | np.ndarray, " time"],
    resolution: Float[Array | np.ndarray, ""] | float = 0.0,
) -> Float[Array | np.ndarray, ""]:
    """Standard deviation of the white noise in `v`, in the unit of `v`.

    Args:
        v: A record.
        resolution: Step of the converter; 0 if it is not known.
    """
    difference = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
    gain = math.sqrt(np.sum(difference**2))
    floor = resolution / math.sqrt(12.0)
    if isinstance(v, np.ndarray):  # nothing to be compiled; `np.median` takes ten times as long
        size, half = np.abs(np.convolve(v, difference, "valid")), (v.size - ORDER) // 2
        return np.asarray(max(MEDIAN_TO_SIGMA / gain * np.partition(size, half)[half], floor))
    size = jnp.abs(jnp.diff(v, ORDER))
    return jnp.maximum(MEDIAN_TO_SIGMA / gain * _median(size), floor)
