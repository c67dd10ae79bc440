"""Parts of one long record: by pauses between its pulses, or by a trigger channel."""

import numpy as np
from jaxtyping import Float, Int

from etid.recordings.errors import RecordingError
from etid.signals.pulse_train import find_pulses


def split(
    cause: Float[np.ndarray, " time"],
    sample_rate: float,
    pulse_rate: float,
    trigger: Float[np.ndarray, " _"] | None = None,
) -> list[slice]:
    """The parts of a record, each with whole pulse periods.

    Without a trigger, a part is a train of pulses between pauses. With one, a part has the pulses
    from one rising edge, where the trigger rises through the middle of its range, to the next, up
    to the first pause. A pulse may precede its trigger by a tenth of a period.
    """
    period = sample_rate / pulse_rate
    edges = find_pulses(cause, sample_rate, pulse_rate).edges
    if trigger is not None:
        trains = _after_edges(trigger, cause, edges, period)
    else:
        trains = _trains(edges, period)
        if len(trains) < 2:
            raise RecordingError(
                f"has {edges.size} pulses without a pause between them",
                field="v_th",
                remedy="Name a trigger channel, or do not split the record",
            )
    # A fifth of the first period lies before its pulse.
    starts = [int(train[0] - round(0.2 * period)) for train in trains]
    stops = [at + round(len(train) * period) for at, train in zip(starts, trains, strict=True)]
    both = zip(starts, stops, strict=True)  # an end of the record may cut a train
    return [slice(start, stop) for start, stop in both if start >= 0 and stop <= cause.size]


def _trains(edges: Int[np.ndarray, " edge"], period: float) -> list[Int[np.ndarray, " _"]]:
    """Pulses without a pause of one and a half periods."""
    return np.split(edges, np.flatnonzero(np.diff(edges) > 1.5 * period) + 1)


def _after_edges(
    trigger: Float[np.ndarray, " _"],
    cause: Float[np.ndarray, " time"],
    edges: Int[np.ndarray, " edge"],
    period: float,
) -> list[Int[np.ndarray, " _"]]:
    """The first train of pulses after each rising edge of a trigger."""
    if trigger.shape != cause.shape:
        raise RecordingError(f"has shape {trigger.shape}, must be {cause.shape}", field="trigger")
    low, high = float(np.min(trigger)), float(np.max(trigger))
    above = trigger > (low + high) / 2
    starts = np.flatnonzero(above[1:] & ~above[:-1]) + 1
    if not np.isfinite(high - low) or starts.size == 0:
        raise RecordingError("has no rising edge", field="trigger", remedy="Name another channel")
    _, *between = np.split(edges, np.searchsorted(edges, starts - period / 10))
    trains = [_trains(some, period)[0] for some in between if some.size]
    if not trains:
        raise RecordingError(
            "no pulse follows a rising edge", field="trigger", remedy="Name another channel"
        )
    return trains
