"""Parts of one long record: by pauses between its pulses, or by a trigger channel."""

import numpy as np
from jaxtyping import Float

from etid.recordings.errors import RecordingError
from etid.signals.pulse_train import find_pulses

PAUSE = 1.5  # [pulse periods] from one pulse to the next; a longer distance is a pause
BEFORE = 0.2  # [pulse periods] rest that a part has before its first pulse


def by_pauses(
    v_th: Float[np.ndarray, " time"], sample_rate: float, pulse_rate: float
) -> list[slice]:
    """The parts of a record between pauses, each with whole pulse periods.

    Args:
        v_th: Unloaded voltage, in any unit.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].

    Raises:
        RecordingError: The record has no pulses, or no pause.
    """
    period = sample_rate / pulse_rate
    edges = find_pulses(v_th, sample_rate, pulse_rate).edges
    parts = np.split(edges, np.flatnonzero(np.diff(edges) > PAUSE * period) + 1)
    if len(parts) < 2:
        raise RecordingError(
            f"has {edges.size} pulses without a pause between them",
            field="v_th",
            remedy="Name a trigger channel, or do not split the record",
        )
    found = []
    for part in parts:
        start = int(part[0] - round(BEFORE * period))
        stop = start + round(part.size * period)
        if start >= 0 and stop <= v_th.size:  # parts that an end of the record cuts are left out
            found.append(slice(start, stop))
    return found


def by_trigger(trigger: Float[np.ndarray, " time"], samples: int) -> list[slice]:
    """The parts of a record from each rising edge of a trigger to the next; all are equally long.

    An edge is where the trigger rises through the middle of its range. The last part is left out if
    it is shorter than the others.

    Args:
        trigger: Voltage of the trigger, in any unit.
        samples: Number of samples of the record.

    Raises:
        RecordingError: The trigger has no edge, or another length.
    """
    if trigger.shape != (samples,):
        raise RecordingError(f"has shape {trigger.shape}, must be ({samples},)", field="trigger")
    low, high = float(np.min(trigger)), float(np.max(trigger))
    above = trigger > (low + high) / 2
    starts = np.flatnonzero(above[1:] & ~above[:-1]) + 1
    if not np.isfinite(high - low) or starts.size == 0:
        raise RecordingError("has no rising edge", field="trigger", remedy="Name another channel")
    length = int(np.diff(starts).min()) if starts.size > 1 else trigger.size - int(starts[0])
    return [slice(int(at), int(at) + length) for at in starts if at + length <= trigger.size]
