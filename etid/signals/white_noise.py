"""The white noise of a record, from the differences of its samples.

Methods in time take noise for white. So does a single period that has no quiet part.

High-order differences remove the smooth part of a pulse response and keep the white noise. The
median of their magnitude gives its standard deviation (Donoho & Johnstone 1994 use the finest
wavelet coefficients in the same way). The median ignores the few per cent of samples at the edges.
A tone at 0.18 of the sample rate passes these differences with a twentieth of its size. In a record
whose differences do not change their sign as often as those of white noise, the top of the band
shows the noise too. The smaller noise is taken (`quietest`).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Order of the differences; the ringing after the edges, at a quarter of the rate, is still smooth
# to them.
ORDER = 6
DIFFERENCE = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
# Noise of a sample over the median size of a difference; a normal x has σ = 1.4826 · median |x|.
PER_MEDIAN = 1.482602218505602 / math.sqrt(np.sum(DIFFERENCE**2))
# Shares of sixth differences of white noise that have another sign than the first and the second
# one after them: arccos(ρ)/π, with the correlations ρ of −6/7 and 15/28.
CHANGES = np.arccos([-6 / 7, 15 / 28]) / np.pi


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

    # To 1e-12 of the largest difference, which is at most 1e5 times the noise (at an edge).
    bounds = jnp.zeros((), x.dtype), jnp.max(fixed)
    low, high = jax.lax.fori_loop(0, 40, halve, bounds)
    return x[jnp.argmin(jnp.abs(fixed - (low + high) / 2))]


def noise_std(
    v: Float[Array | np.ndarray, "*record time"],
) -> Float[Array | np.ndarray, "*record"]:
    """Standard deviation of the white noise in `v`, in the unit of `v`.

    In records of more than 30 000 samples it comes from every second difference, in half of the
    time. Neighbouring differences share most of their samples, so the standard error grows from
    0.94 to 1.02 % only (33 330 samples). It is a weight, and enters standard errors and limits of
    tests in proportion.

    Args:
        v: Samples of the record, or of several records as an array of NumPy.
    """
    if isinstance(v, np.ndarray):  # nothing is compiled
        middle = [_middle(record) for record in v.reshape(-1, v.shape[-1])]
        return np.asarray(PER_MEDIAN * np.reshape(middle, v.shape[:-1]))
    return PER_MEDIAN * _median(jnp.abs(jnp.diff(v, ORDER)[:: _every(v.shape[0])]))


def _middle(v: Float[np.ndarray, " time"]) -> float:
    """The median size of the differences, one of them.

    Only the sizes between two limits are sorted, those around the median of every 16th size. This
    takes less than half of the time of a partition of all sizes.
    """
    sizes = np.abs(np.convolve(v, DIFFERENCE)[ORDER : v.size : _every(v.size)])
    half = sizes.size // 2
    sample = np.sort(sizes[::16])
    reach = round(1.5 * math.sqrt(sample.size))
    low = sample[max(sample.size // 2 - reach, 0)]
    high = sample[min(sample.size // 2 + reach, sample.size - 1)]
    between = np.compress((sizes >= low) & (sizes <= high), sizes)
    place = half - np.count_nonzero(sizes < low)
    if not 0 <= place < between.size:  # one record of a thousand, or it is not finite
        between, place = sizes, half
    between.partition(place)
    return float(between[place])


def quietest(v: Float[np.ndarray, " time"]) -> float:
    """`noise_std` of a record without quiet parts, or the noise at the top of its band.

    The latter if the differences do not change their sign as those of white noise do, and if it is
    surely smaller.
    """
    sigma = float(noise_std(v))
    signs = np.signbit(np.convolve(v, DIFFERENCE)[ORDER : v.size])
    changes = [np.count_nonzero(signs[lag:] != signs[:-lag]) / v.size for lag in (1, 2)]
    if np.abs(np.subtract(changes, CHANGES)).max() < 2.5 / math.sqrt(v.size):
        return sigma
    window = np.hanning(v.size)
    squares = np.abs(np.fft.rfft(v * window)) ** 2 / np.sum(window**2)
    top = squares[round(0.38 * v.size) :]
    if top.size == 0:
        return sigma
    found = math.sqrt(float(np.median(top)) / math.log(2))
    # The median of n such powers has a relative error of 1.44/√n, its root of half of it.
    return found if found < (1 - 8 * 0.72 / math.sqrt(top.size)) * sigma else sigma


def _every(samples: int) -> int:
    """Step from one difference to the next."""
    return 2 if samples > 30_000 else 1
