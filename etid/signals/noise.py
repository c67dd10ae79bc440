"""White noise of a record, estimated from the record itself.

High-order differences remove the smooth part of a pulse response and keep the white noise. The
median of their magnitude gives its standard deviation (Donoho & Johnstone 1994 use the finest
wavelet coefficients in the same way). The median ignores the few per cent of samples at the edges.
The noise of a converter is at least resolution/√12.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Order of the differences; the ringing after the edges, at a quarter of the rate, is still smooth
# to them.
ORDER = 6
# Bisection to 1e-12 of the largest difference, which is at most 1e5 times the noise (at an edge).
HALVINGS = 40
MEDIAN_TO_SIGMA = 1.482602218505602  # standard deviation over median |x|, for a normal x


def _median(x: Float[Array, " sample"]) -> Float[Array, ""]:
    """Median of numbers that are not negative, by bisection.

    For an even count the result is one of the two middle numbers. `jnp.median` sorts, which costs
    ten times as much.
    """
    half, fixed = x.shape[0] / 2, jax.lax.stop_gradient(x)

    def halve(
        _: int | Int[Array, ""], bounds: tuple[Float[Array, ""], Float[Array, ""]]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
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
        v: Samples of the record.
        resolution: Step of the converter, in the unit of `v`; 0 if it is not known.
    """
    difference = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
    gain = math.sqrt(np.sum(difference**2))
    floor = resolution / math.sqrt(12.0)
    if isinstance(v, np.ndarray):  # nothing is compiled; `np.median` takes ten times as long
        size, half = np.abs(np.convolve(v, difference, "valid")), (v.size - ORDER) // 2
        return np.asarray(max(MEDIAN_TO_SIGMA / gain * np.partition(size, half)[half], floor))
    size = jnp.abs(jnp.diff(v, ORDER))
    return jnp.maximum(MEDIAN_TO_SIGMA / gain * _median(size), floor)
