"""Parts of one long record: by pauses between its pulses, or by a trigger channel."""

import numpy as np
from jaxtyping import Float, Int

from etid.recordings.errors import RecordingError
from etid.signals.pulse_train import find_pulses


def by_pauses(
    v_th: Float[np.ndarray, " time"], sample_rate: float, pulse_rate: float
) -> list[slice]:
    """The parts of a record between pauses, each with whole pulse periods."""
    period = sample_rate / pulse_rate
    edges = find_pulses(v_th, sample_rate, pulse_rate).edges
    trains = _trains(edges, period)
    if len(trains) < 2:
        raise RecordingError(
            f"has {edges.size} pulses without a pause between them",
            field="v_th",
            remedy="Name a trigger channel, or do not split the record",
        )
    return _parts(trains, period, v_th.size)


def by_trigger(
    trigger: Float[np.ndarray, " time"],
    cause: Float[np.ndarray, " sample"],
    sample_rate: float,
    pulse_rate: float,
) -> list[slice]:
    """The parts of a record that begin at the rising edges of a trigger, each with whole periods.

    An edge is where the trigger rises through the middle of its range. A part has the pulses from
    one edge to the next, up to the first pause. A pulse may precede its trigger by a tenth of a
    period.
    """
    if trigger.shape != cause.shape:
        raise RecordingError(f"has shape {trigger.shape}, must be {cause.shape}", field="trigger")
    low, high = float(np.min(trigger)), float(np.max(trigger))
    above = trigger > (low + high) / 2
    starts = np.flatnonzero(above[1:] & ~above[:-1]) + 1
    if not np.isfinite(high - low) or starts.size == 0:
        raise RecordingError("has no rising edge", field="trigger", remedy="Name another channel")
    period = sample_rate / pulse_rate
    edges = find_pulses(cause, sample_rate, pulse_rate).edges
    _, *between = np.split(edges, np.searchsorted(edges, starts - period / 10))
    trains = [_trains(some, period)[0] for some in between if some.size]
    if not trains:
        raise RecordingError(
            "no pulse follows a rising edge", field="trigger", remedy="Name another channel"
        )
    return _parts(trains, period, cause.size)


def _trains(edges: Int[np.ndarray, " edge"], period: float) -> list[Int[np.ndarray, " _"]]:
    """Pulses without a pause of one and a half periods, from the places where pulses begin."""
    return np.split(edges, np.flatnonzero(np.diff(edges) > 1.5 * period) + 1)


def _parts(trains: list[Int[np.ndarray, " _"]], period: float, samples: int) -> list[slice]:
    """Whole periods around trains of pulses; without those that an end of the record cuts.

    A fifth of the first period lies before its pulse.
    """
    starts = [int(train[0] - round(0.2 * period)) for train in trains]
    stops = [at + round(len(train) * period) for at, train in zip(starts, trains, strict=True)]
    both = zip(starts, stops, strict=True)
    return [slice(start, stop) for start, stop in both if start >= 0 and stop <= samples]
