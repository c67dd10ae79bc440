"""The rounding error of a converter whose steps exceed the noise.

Without noise, the rounding error is not white. Where the signal is slow, it is a saw-tooth that is
the same in each period, so averaging over periods does not reduce it. Its size at each harmonic is
found by rounding the waveform again. The waveform v is known to a fraction of a step: where it is
slow, it crosses half a step between two codes when the code changes. It is rounded with noise n and
with several offsets o of a fraction of a step,

    E|e_k|² = mean over o of |DFT_k(Q(v + o + n) − v − o)|².
"""

import math

import numpy as np
from jaxtyping import Float

from etid.signals.harmonics import harmonics

COARSE = 2.0  # step over noise; at this ratio 0.7 % of the saw-tooth is left
VISIBLE = 1e-3  # of the signal; other errors hide the saw-tooth of a smaller step
FLICKER = 2 / math.sqrt(math.pi)  # fraction of samples that change the code, times step over noise
FEW = 256  # a converter without noise shows few values in so many samples
EQUAL = 1e-3  # tolerance for equal steps, relative to a step
LIFTS = 16  # number of offsets within a step
SEED = 1948


def step_of(v: Float[np.ndarray, " time"]) -> float:
    """Step of the converter; 0 if the values are not multiples of one step."""
    if np.unique(v[:FEW]).size > FEW // 2:
        return 0.0
    values = np.unique(v)
    steps = np.diff(values)
    steps = steps[steps > EQUAL * EQUAL * np.ptp(v)]
    if steps.size == 0 or values.size > v.size // 4:
        return 0.0
    step = float(steps.min())
    count = steps / step
    return step if np.abs(count - np.round(count)).max() < EQUAL * count.max() else 0.0


def noise_of(v: Float[np.ndarray, " time"], step: float) -> float:
    """Noise from how often the code goes back and forth; valid for noise below half a step."""
    jumps = np.diff(v)
    jumps = jumps[np.abs(jumps) > step / 2]
    back = (jumps[1:] * jumps[:-1] < 0) & (np.abs(jumps[1:]) < 1.5 * step)
    return float(step / FLICKER * np.count_nonzero(back) / v.size)


def is_coarse(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether the rounding error is large and is not white, so that `variance` is needed."""
    return bool(step > VISIBLE * np.ptp(v) and step > COARSE * noise_of(v, step))


def variance(
    v: Float[np.ndarray, " time"], step: float, periods: int, samples: int
) -> Float[np.ndarray, " harmonic"]:
    """E|error|² of the harmonics of a record [V²], from rounding and noise together."""
    rng = np.random.default_rng(SEED)
    smooth, noise = _before(v, step, rng), noise_of(v, step)
    total = 0.0
    for lift in (np.arange(LIFTS) + 0.5) / LIFTS * step:
        lifted = smooth + lift
        rounded = np.round((lifted + noise * rng.standard_normal(v.size)) / step) * step
        total = total + np.abs(harmonics(rounded - lifted, periods, samples)) ** 2
    # The edges determine the elements, and there the rounding errors of samples are independent.
    # So the variance is at least that of white noise of this size, common to all periods.
    return np.maximum(np.asarray(total) / LIFTS, (periods * step**2 / 12 + noise**2) / samples)


def _before(
    v: Float[np.ndarray, " time"], step: float, rng: np.random.Generator
) -> Float[np.ndarray, " time"]:
    """The waveform before rounding: straight lines between the changes of the code.

    Where the code changes by more than one, a random value that rounds to the code is used.
    """
    jumps = np.diff(v)
    at = np.flatnonzero(np.abs(jumps) > step / 2)
    places = np.concatenate([[0.0], at + 0.5, [v.size - 1.0]])
    levels = np.concatenate([v[:1], (v[at] + v[at + 1]) / 2, v[-1:]])
    line = np.interp(np.arange(v.size), places, levels)
    fast = np.abs(line - v) > step
    return np.where(fast, v + step * (rng.random(v.size) - 0.5), line)
