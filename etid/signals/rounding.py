"""The rounding error of a converter whose steps exceed the noise.

Without noise it is no white noise: where a signal is slow it is a saw-tooth, the same in each
period, and no average over periods makes it smaller. How large it is at each harmonic is what
rounding does to the waveform, which is known to a fraction of a step: where it is slow, it passes
from code to code half a step between them. So it is rounded again, with the noise, lifted by
several parts of a step,

    E|e_k|² = mean over o of |DFT_k(Q(v + o + n) − v − o)|².
"""

import math

import numpy as np
from jaxtyping import Float

from etid.signals.harmonics import harmonics

COARSE = 2.0  # steps over noise at which 0.7 % of the saw-tooth of rounding is left
VISIBLE = 1e-3  # of the signal, below which even a saw-tooth is hidden by what else is unknown
FLICKER = 2 / math.sqrt(math.pi)  # share of samples that change the code, times step over noise
FEW = 256  # samples in which a converter without noise shows few values
EQUAL = 1e-3  # of a step, by which steps may differ
LIFTS = 16  # parts of a step
SEED = 1948


def step_of(v: Float[np.ndarray, " time"]) -> float:
    """Step of the converter, by the values that a record has; 0 if they are no multiples of one."""
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
    """Noise of a record by how often its code goes back and forth, if it is below half a step."""
    jumps = np.diff(v)
    jumps = jumps[np.abs(jumps) > step / 2]
    back = (jumps[1:] * jumps[:-1] < 0) & (np.abs(jumps[1:]) < 1.5 * step)
    return float(step / FLICKER * np.count_nonzero(back) / v.size)


def is_coarse(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether the rounding error must be weighed as such."""
    return bool(step > VISIBLE * np.ptp(v) and step > COARSE * noise_of(v, step))


def variance(
    v: Float[np.ndarray, " time"], step: float, periods: int, samples: int
) -> Float[np.ndarray, " harmonic"]:
    """E|error|² of the harmonics of a record [V²], of rounding and noise together."""
    rng = np.random.default_rng(SEED)
    smooth, noise = _before(v, step, rng), noise_of(v, step)
    total = 0.0
    for lift in (np.arange(LIFTS) + 0.5) / LIFTS * step:
        lifted = smooth + lift
        rounded = np.round((lifted + noise * rng.standard_normal(v.size)) / step) * step
        total = total + np.abs(harmonics(rounded - lifted, periods, samples)) ** 2
    # Elements are read off the edges, where each sample has an error of its own: no less than white
    # noise of that size, which the periods have in common.
    return np.maximum(np.asarray(total) / LIFTS, (periods * step**2 / 12 + noise**2) / samples)


def _before(
    v: Float[np.ndarray, " time"], step: float, rng: np.random.Generator
) -> Float[np.ndarray, " time"]:
    """The waveform before it was rounded: between the changes of the code a line.

    Where the code changes by more than one, any value that rounds to the code is as good.
    """
    jumps = np.diff(v)
    at = np.flatnonzero(np.abs(jumps) > step / 2)
    places = np.concatenate([[0.0], at + 0.5, [v.size - 1.0]])
    levels = np.concatenate([v[:1], (v[at] + v[at + 1]) / 2, v[-1:]])
    line = np.interp(np.arange(v.size), places, levels)
    fast = np.abs(line - v) > step
    return np.where(fast, v + step * (rng.random(v.size) - 0.5), line)
