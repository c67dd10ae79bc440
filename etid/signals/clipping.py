"""Whether a converter of unknown range clipped a record.

A clipped signal arrives at the rail at full slope and stays there, so one extreme value has many
samples in a row, and the values just inside the rail have few. A smooth signal that turns at its
peak has at most 2.4 times as many samples at its extreme value, because it is a parabola there. One
that droops has no more of them than at the next value. A signal that settles at a level approaches
it in small steps.

A generator's command rests at exact levels too, its baseline included. It has no noise
(`is_command`).
"""

import numpy as np
from jaxtyping import Bool, Float

from etid.signals.noise import noise_std


def is_clipped(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether many samples in a row are at a rail."""
    rails = [extreme for extreme in (v.min(), v.max()) if _has_run(v == extreme)]
    if not rails:  # nearly all records
        return False
    values, counts = np.unique(v, return_counts=True)
    # A record of rounded volts shows its step; an unknown converter has at most 16 bits.
    span = values[-1] - values[0]
    step = max(step, np.diff(values).min(), span * 2.0**-16)
    jump = 8 * step  # a clipped signal reaches its rail in a larger jump
    rest = values[np.argmax(counts)]
    if 2 * counts.max() >= v.size and _arrivals(v, rest).min(initial=np.inf) > jump:
        # Noise in the pulses is that of a record whose baseline is at the rail.
        others = v[v != rest]
        if is_command(float(noise_std(others)), step, span):
            return False
    for rail in rails:
        # A peak of fourth order has at most 5 times the samples of the next of these values.
        total, *beside = (counts if rail == values[0] else counts[::-1])[:9]
        if total > 4 * max(beside) and _arrivals(v, rail).max(initial=0.0) > jump:
            return True
    return False


def is_command(noise: float, step: float, span: float) -> bool:
    """Whether a record may be a generator's command: it has almost no noise.

    Args:
        noise: Standard deviation of its noise, in its unit.
        step: Step of its converter; 0 if it is unknown.
        span: Its peak-to-peak value.
    """
    return bool(noise <= max(step, 1e-5 * span))


def _has_run(at: Bool[np.ndarray, " time"]) -> bool:
    """Whether three samples in a row are true."""
    return bool(np.count_nonzero(at) >= 3 and (at[:-2] & at[1:-1] & at[2:]).any())


def _arrivals(v: Float[np.ndarray, " time"], level: float) -> Float[np.ndarray, " arrival"]:
    """Size of each step by which the record arrives at a level."""
    at = v == level
    return np.abs(v[:-1] - level)[at[1:] & ~at[:-1]]
