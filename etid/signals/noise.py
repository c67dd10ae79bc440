"""The noise of a record, estimated from the record itself.

**White noise.** High-order differences remove the smooth part of a pulse response and keep the
white noise. The median of their magnitude gives its standard deviation (Donoho & Johnstone 1994 use
the finest wavelet coefficients in the same way). The median ignores the few per cent of samples at
the edges. The noise of a converter is at least resolution/√12.

A multisine or a chirp has no quiet samples, and a tone at 0.18 of the sample rate passes these
differences with a twentieth of its size. In a record whose differences do not change their sign as
often as those of white noise, the spectrum shows the noise too: by the bins between the harmonics
of the pulse rate, or at the top of the band in a single period. The smaller noise is taken
(`quietest`).

**Rounding.** Without noise, the rounding error of a converter is not white. Where the signal is
slow, it is a saw-tooth that is the same in each period, so averaging over periods does not reduce
it. Its size at each harmonic is found by rounding the waveform again. The waveform v is known to a
fraction of a step: where it is slow, it crosses half a step between two codes when the code
changes. It is rounded with noise n and with several offsets o of a fraction of a step,

    E|e_k|² = mean over o of |DFT_k(Q(v + o + n) − v − o)|².

**1/f noise** has the power of white noise times 1 + f_c/f. The bins between the harmonics of the
pulse rate contain no pulses, only noise and what differs from period to period: a drift, a load
that changes, the remainder of a period that is no whole number of samples. The drift of the means
of the periods is subtracted. Multiplied by the square of the frequency, the rest is smooth along
the harmonics, once the delay of the pulses is removed. Noise is not smooth. So noise determines the
second differences

    b = c(k − 1) − 2 c(k) + c(k + 1)

of the bins k P + r, for each r from 1 to P − 1. |b|² has an exponential distribution, whose mean is
known for each f_c. The likeliest f_c is taken where the likelihood surely prefers it to white noise
(P. Whittle, Arkiv för Matematik 2, 1953, 423-434).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.precision import Module
from etid.signals.harmonics import DRIFT_DEGREE, WINDOW, harmonics, namespace

# Order of the differences; the ringing after the edges, at a quarter of the rate, is still smooth
# to them.
ORDER = 6
DIFFERENCE = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
# Noise of a sample over the median size of a difference; a normal x has σ = 1.4826 · median |x|.
PER_MEDIAN = 1.482602218505602 / math.sqrt(np.sum(DIFFERENCE**2))
# Shares of sixth differences of white noise that have another sign than the first and the second
# one after them: arccos(ρ)/π, with the correlations ρ of −6/7 and 15/28.
CHANGES = np.arccos([-6 / 7, 15 / 28]) / np.pi
RIPPLE = 1e-5  # error of the interpolation relative to the signal: a lower limit of the noise
COARSE = 2.0  # step over noise; at this ratio 0.7 % of the saw-tooth is left
VISIBLE = 1e-3  # of the signal; other errors hide the saw-tooth of a smaller step
CORNERS = np.geomspace(10.0, 1e6, 101)[:, None, None]  # [Hz]
# Mean of sample rate / f over the band of sixth differences: they see 1/f noise too.
BY_DIFFERENCES = 2.37


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
    resolution: Float[Array | np.ndarray, "*record"] | float = 0.0,
) -> Float[Array | np.ndarray, "*record"]:
    """Standard deviation of the white noise in `v`, in the unit of `v`.

    In records of more than 30 000 samples it comes from every second difference, in half of the
    time. Neighbouring differences share most of their samples, so the standard error grows from
    0.94 to 1.02 % only (33 330 samples). It is a weight, and enters standard errors and limits of
    tests in proportion.

    Args:
        v: Samples of the record, or of several records as an array of NumPy.
        resolution: Step of the converter, in the unit of `v`; 0 if it is not known.
    """
    floor = resolution / math.sqrt(12.0)
    if isinstance(v, np.ndarray):  # nothing is compiled
        middle = np.reshape(
            [_middle(record) for record in v.reshape(-1, v.shape[-1])], v.shape[:-1]
        )
        return np.asarray(np.maximum(PER_MEDIAN * middle, floor))
    size = jnp.abs(jnp.diff(v, ORDER)[:: _every(v.shape[0])])
    return jnp.maximum(PER_MEDIAN * _median(size), floor)


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


def quietest(v: Float[np.ndarray, " time"], sigma: float, spacing: float) -> float:
    """Standard deviation of the noise, where a stationary signal has enlarged `sigma`.

    Args:
        v: Samples of the record.
        sigma: Its `noise_std`.
        spacing: Length of a pulse period [samples].

    Returns:
        The noise in the spectrum if it is surely smaller, else `sigma`.
    """
    signs = np.signbit(np.convolve(v, DIFFERENCE)[ORDER : v.size])
    changes = [np.count_nonzero(signs[lag:] != signs[:-lag]) / v.size for lag in (1, 2)]
    if np.abs(np.subtract(changes, CHANGES)).max() < 2.5 / math.sqrt(v.size):
        return sigma
    found = [sigma]
    whole = np.arange(2, int((v.size + 0.5) / spacing) + 1)
    if whole.size:
        # The periods that end nearest to a sample: the rest would leak between the harmonics.
        rest = np.abs(whole * spacing - np.rint(whole * spacing))
        periods = int(whole[rest <= rest.min() + 1e-3][-1])
        squares = np.abs(np.fft.rfft(v[: round(periods * spacing)])) ** 2
        bins = np.arange(squares.size)
        quiet = squares[(bins > squares.size / 2) & (bins % periods != 0)]
        found.append(_surely(quiet / round(periods * spacing), sigma))
    window = np.hanning(v.size)
    squares = np.abs(np.fft.rfft(v * window)) ** 2 / np.sum(window**2)
    found.append(_surely(squares[round(0.38 * v.size) :], sigma))
    return min(found)


def _surely(squares: Float[np.ndarray, " bin"], sigma: float) -> float:
    """Noise of a sample from the powers of quiet bins, if it is surely below `sigma`, else that."""
    if squares.size == 0:
        return sigma
    found = math.sqrt(float(np.median(squares)) / math.log(2))
    # The median of n such powers has a relative error of 1.44/√n, its root of half of it.
    return found if found < (1 - 8 * 0.72 / math.sqrt(squares.size)) * sigma else sigma


def _every(samples: int) -> int:
    """Step from one difference to the next."""
    return 2 if samples > 30_000 else 1


class Measurement(Module):
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


def noise(
    v: Float[Array | np.ndarray, " time"], resolution: Float[Array | np.ndarray, ""]
) -> Float[Array | np.ndarray, ""]:
    """Noise of a record, in its unit and at least as large as the error of the interpolation."""
    xp = namespace(v)
    return xp.asarray(xp.maximum(noise_std(v, resolution), RIPPLE * xp.ptp(v)))


# --- Coarse converters ---------------------------------------------------------------------------


def shows_few(v: Float[np.ndarray, "*record time"]) -> Bool[np.ndarray, "*record"]:
    """Whether the first 256 samples have few values, as those of a converter without noise."""
    first = np.sort(v[..., :256], axis=-1)
    return np.asarray(np.count_nonzero(first[..., 1:] != first[..., :-1], axis=-1) < 128)


def step_of(v: Float[np.ndarray, " time"]) -> float:
    """Step of the converter; 0 if the values are not multiples of one step."""
    if not shows_few(v):
        return 0.0
    values, equal = np.unique(v), 1e-3
    steps = np.diff(values)
    steps = steps[steps > equal * equal * np.ptp(v)]
    if steps.size == 0 or values.size > v.size // 4:
        return 0.0
    step = float(steps.min())
    count = steps / step
    return step if np.abs(count - np.round(count)).max() < equal * count.max() else 0.0


def printed_step(v: npt.NDArray) -> float:
    """Rounding of the largest values of a record whose values all have at most three digits.

    0 if they have more digits, or if all of them are multiples of this step, as those of a
    converter and of a generator's levels are.
    """
    for value in v[:: max(1, v.size // 64)]:  # most records end at the first one
        if v.dtype.type(f"{value:.3g}") != value:
            return 0.0
    largest = float(np.max(np.abs(v)))
    if not 0 < largest < np.inf:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(largest)) - 2)
    count = v[:: max(1, v.size // 1024)] / step
    return 0.0 if np.abs(count - np.round(count)).max() < 1e-3 else step


def noise_before(v: Float[np.ndarray, " time"], step: float) -> float:
    """Noise before the rounding [V].

    Noise below half a step shows in how often the code goes back and forth. Larger noise jumps over
    codes, but makes the rounding error white, so that differences show both.
    """
    jumps = np.diff(v)
    jumps = jumps[np.abs(jumps) > step / 2]
    back = (jumps[1:] * jumps[:-1] < 0) & (np.abs(jumps[1:]) < 1.5 * step)
    # Noise of σ makes a fraction of 2 σ / (√π step) of all samples go back.
    of_codes = step / (2 / math.sqrt(math.pi)) * np.count_nonzero(back) / v.size
    of_differences = math.sqrt(max(float(noise_std(v)) ** 2 - step**2 / 12, 0.0))
    return max(float(of_codes), of_differences)


def is_coarse(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether the rounding error is large and not white: its size is `rounding_variance`."""
    return bool(step > VISIBLE * np.ptp(v) and step > COARSE * noise_before(v, step))


def rounding_variance(
    v: Float[np.ndarray, " time"], step: float, periods: int, samples: int
) -> Float[np.ndarray, " harmonic"]:
    """E|error|² of the harmonics of a record [V²], from rounding and noise together."""
    rng = np.random.default_rng(1948)
    noise, offsets = noise_before(v, step), 16
    errors = []
    for lift in (np.arange(offsets) + 0.5) / offsets * step:
        lifted = _before(v, step, rng.random()) + lift
        rounded = np.round((lifted + noise * rng.standard_normal(v.size)) / step) * step
        errors.append(np.asarray(harmonics(rounded - lifted, periods, samples)))
    transforms = np.asarray(errors)
    square = np.mean(np.abs(transforms) ** 2, axis=0)
    variance = square * _together(transforms, square, np.asarray(harmonics(v, periods, samples)))
    # The edges determine the elements, and there the rounding errors of samples are independent.
    # So the variance is at least that of white noise of this size, common to all periods.
    return np.maximum(variance, (periods * step**2 / 12 + noise**2) / samples)


def _together(
    errors: Complex[np.ndarray, "lift harmonic"],
    square: Float[np.ndarray, " harmonic"],
    signal: Complex[np.ndarray, " harmonic"],
) -> Float[np.ndarray, " harmonic"]:
    """How much more the errors of neighbouring harmonics do together than if independent.

    The error of slow parts of the signal has few independent values, and they move many harmonics
    alike. Elements change the gain smoothly, so what counts is the sum of relative errors.
    """
    along = errors * np.exp(-1j * np.angle(signal))
    together = [np.mean(_around(part) ** 2, axis=0) for part in (np.real(along), np.imag(along))]
    return np.maximum(2 * np.maximum(*together) / _around(square), 1.0)


def _around(values: Float[np.ndarray, "*lift harmonic"]) -> Float[np.ndarray, "*lift harmonic"]:
    """Sums over `WINDOW` neighbouring harmonics."""
    total = np.cumsum(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 0)]), axis=-1)
    number = np.arange(values.shape[-1])
    first = np.maximum(number - WINDOW // 2, 0)
    return total[..., np.minimum(number + WINDOW // 2 + 1, number.size)] - total[..., first]


def _before(v: Float[np.ndarray, " time"], step: float, place: float) -> Float[np.ndarray, " time"]:
    """The waveform before rounding: straight lines between the changes of the code.

    Args:
        v: The record.
        step: Converter step, in the unit of `v`.
        place: Place of the waveform within a code where the record does not show it, from 0 to 1:
            beside changes of more than one code, and at both ends. It is one number, because each
            period ends with the same rest of its pulse. This rest makes the error of the first
            harmonics.
    """
    jumps = np.diff(v)
    at = np.flatnonzero(np.abs(jumps) > step / 2)
    by_one = np.abs(jumps[at]) < 1.5 * step
    slow, fast = at[by_one], at[~by_one]
    hidden = np.concatenate([[0], fast, fast + 1, [v.size - 1]])
    places = np.concatenate([slow + 0.5, hidden])
    levels = np.concatenate([(v[slow] + v[slow + 1]) / 2, v[hidden] + step * (place - 0.5)])
    order = np.argsort(places, kind="stable")
    return np.interp(np.arange(v.size), places[order], levels[order])


# --- 1/f noise ----------------------------------------------------------------------------------


def coloured(
    v: Float[np.ndarray, " time"],
    sigma: float,
    frequency: Float[np.ndarray, " harmonic"],
    sample_rate: float,
    periods: int,
    samples: int,
) -> Float[np.ndarray, " harmonic"]:
    """Power of the noise at each harmonic, relative to white noise that has `sigma`."""
    f_c = corner(v, sigma, sample_rate, periods, samples)
    return (1 + f_c / frequency) / (1 + f_c * BY_DIFFERENCES / sample_rate)


def corner(
    v: Float[np.ndarray, " time"], sigma: float, sample_rate: float, periods: int, samples: int
) -> float:
    """f_c [Hz]; 0 if the noise may be white, or if the record is a single period.

    Arguments as in `coloured`.
    """
    if periods < 2 or not sigma > 0:
        return 0.0
    v = v[:samples]
    bins, white = _bins(periods, samples)
    late = int(np.argmax(np.abs(v[: samples // periods])))
    means = v[: samples // periods * periods].reshape(periods, -1).mean(1)
    transform = np.fft.rfft(v)[bins] - _drifts(periods, samples) @ means
    smooth = transform * (bins**2 * np.exp(2j * np.pi * bins * late / samples))
    bend = smooth[:-2] - 2 * smooth[1:-1] + smooth[2:]
    ratio = (np.square(np.real(bend)) + np.square(np.imag(bend))) / (white * samples * sigma**2)
    weight, log_mean = _means(periods, samples, sample_rate)
    gained = np.einsum("chb,hb->c", weight, ratio) - log_mean  # not `@`, which starts BLAS threads
    best = int(np.argmax(gained))
    # A logarithm of a ratio of likelihoods. Neighbouring differences have common bins, so that it
    # counts two thirds more than it proves.
    return float(CORNERS[best, 0, 0]) if gained[best] > 16 else 0.0


@functools.lru_cache(maxsize=8)
def _drifts(periods: int, samples: int) -> Complex[np.ndarray, "harmonic between period"]:
    """Transforms, at `_bins`, of the drift that follows from each mean of a period."""
    degrees = min(periods, DRIFT_DEGREE + 1)
    fit = np.linalg.pinv(np.vander((np.arange(periods) + 0.5) / periods, degrees))
    powers = np.fft.rfft(np.vander(np.arange(samples) / samples, degrees), axis=0)
    return powers[_bins(periods, samples)[0]] @ fit


@functools.lru_cache(maxsize=8)
def _bins(
    periods: int, samples: int
) -> tuple[Int[np.ndarray, "harmonic between"], Float[np.ndarray, "difference between"]]:
    """Bins k P + r of the 60 lowest harmonics, and the mean of |b|² for white noise."""
    count = min(60, samples // 2 // periods)
    bins = periods * np.arange(count)[:, None] + np.arange(1, periods)[None, :]
    return bins, _of_differences(bins**4.0)


def _of_differences(
    power: Float[np.ndarray, "harmonic between"],
) -> Float[np.ndarray, "difference between"]:
    """Mean of the squares of second differences of numbers with these mean squares."""
    return power[:-2] + 4 * power[1:-1] + power[2:]


@functools.lru_cache(maxsize=8)
def _means(
    periods: int, samples: int, sample_rate: float
) -> tuple[Float[np.ndarray, "corner difference between"], Float[np.ndarray, " corner"]]:
    """What 1/f noise of each of `CORNERS` makes of the means of |b|².

    Returns:
        1 − 1/m and Σ ln m, where m is the mean relative to that of white noise. A record with
        ratios r is exp(Σ (1 − 1/m) r − Σ ln m) times as likely with this noise.
    """
    bins, white = _bins(periods, samples)
    mean = 1 + CORNERS * (_of_differences(bins**3.0) / white * (samples / sample_rate))
    mean = mean / (1 + CORNERS * BY_DIFFERENCES / sample_rate)
    return 1 - 1 / mean, np.log(mean).sum((1, 2))
