"""The rounding error of a converter that is coarser than the noise.

Without noise, the rounding error of a converter is not white. Where the signal is slow, it is a
saw-tooth that is the same in each period, so averaging over periods does not reduce it. Its size at
each harmonic is found by rounding the waveform again. The waveform v is known to a fraction of a
step: where it is slow, it crosses half a step between two codes when the code changes. It is
rounded with noise n and with several offsets o of a fraction of a step,

    E|e_k|² = mean over o of |DFT_k(Q(v + o + n) − v − o)|².
"""

import math

import numpy as np
import numpy.typing as npt
from jaxtyping import Complex, Float

from etid.signals.harmonics import WINDOW, harmonics
from etid.signals.quick_looks import shows_few
from etid.signals.white_noise import noise_std

COARSE = 2.0  # step over noise; at this ratio 0.7 % of the saw-tooth is left
VISIBLE = 1e-3  # of the signal; other errors hide the saw-tooth of a smaller step


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


def white_variance(v: Float[np.ndarray, " time"], step: float, periods: int) -> float:
    """Variance of a sample [V²] if rounding and the noise below it were white.

    Quiet parts do not show them: there the noise moves no code, or always one. Of the saw-tooth,
    noise of σ leaves the power exp(−(2π σ / step)²), which is the same in each period.
    """
    noise = noise_before(v, step)
    # A signal that rests at the middle of a code shows half of its noise.
    left = math.exp(-((2 * math.pi * 2 * noise / step) ** 2))
    return step**2 / 12 * (1 + (periods - 1) * left) + noise**2


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
