"""Whether a converter of unknown range clipped a record.

A clipped signal arrives at the rail at full slope and stays there, so one extreme value has many
samples in a row, and the values just inside the rail have few. A smooth signal that turns at its
peak has at most 2.4 times as many samples at its extreme value, because it is a parabola there. One
that droops has no more of them than at the next value. A signal that settles at a level approaches
it in small steps.

A generator's command rests at exact levels too, its baseline included. It has no noise.
"""

import numpy as np
from jaxtyping import Bool, Float

from etid.signals.noise import noise_std

RAIL = 3  # equal extreme samples in a row
NEAR = 8  # values beside the extreme one
MORE = 4.0  # times the samples of each of these values; a peak of fourth order has 5 at most
JUMP = 8.0  # [converter steps] a clipped signal reaches its rail in a larger jump
FINEST = 2.0**-16  # of the span: step of a converter that is not known
HELD = 1e-5  # noise over the span of a record, below which it may be a command


def is_clipped(v: Float[np.ndarray, " time"], step: float) -> bool:
    """Whether many samples in a row are at a rail.

    Args:
        v: The record, in any unit.
        step: Step of the converter in this unit; 0 if it is unknown.
    """
    rails = [extreme for extreme in (v.min(), v.max()) if _stays(v == extreme)]
    if not rails:  # nearly all records
        return False
    values, counts = np.unique(v, return_counts=True)
    # A record of rounded volts shows its step.
    floor = max(step, np.diff(values).min(), FINEST * (values[-1] - values[0]))
    jumps = JUMP * floor
    rest = values[np.argmax(counts)]
    if 2 * counts.max() >= v.size and _arrivals(v, rest).min(initial=np.inf) > jumps:
        # Noise in the pulses is that of a record whose baseline is at the rail.
        others = v[v != rest]
        if noise_std(others) <= max(floor, HELD * (values[-1] - values[0])):
            return False
    for rail in rails:
        total, *beside = (counts if rail == values[0] else counts[::-1])[: NEAR + 1]
        if total > MORE * max(beside) and _arrivals(v, rail).max(initial=0.0) > jumps:
            return True
    return False


def _stays(at: Bool[np.ndarray, " time"]) -> bool:
    """Whether `RAIL` samples in a row are true."""
    return bool(np.count_nonzero(at) >= RAIL and (at[:-2] & at[1:-1] & at[2:]).any())


def _arrivals(v: Float[np.ndarray, " time"], level: float) -> Float[np.ndarray, " arrival"]:
    """Size of each step by which the record arrives at a level."""
    at = v == level
    return np.abs(v[:-1] - level)[at[1:] & ~at[:-1]]
