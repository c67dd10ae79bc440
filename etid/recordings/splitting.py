"""Parts of one long record: by pauses between its pulses, or by a trigger."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.signals.pulse_train import find_pulses


class Parts(NamedTuple):
    """The parts of a record.

    Attributes:
        whole: Those with all their samples.
        cut: How many were left out, because the end of the record cuts them.
    """

    whole: list[slice]
    cut: int


def split(
    cause: Float[np.ndarray, " time"],
    sample_rate: float,
    pulse_rate: float,
    trigger: Float[np.ndarray, " _"] | None = None,
    *,
    cut: bool = True,
) -> Parts:
    """The parts of a record, each with whole pulse periods.

    Without a trigger, a part is a train of pulses between pauses. With one, a part has the pulses
    from one rising edge, where the trigger rises through the middle of its range, to the next, up
    to the first pause. A pulse may precede its trigger by a tenth of a period.

    Args:
        cause: Unloaded voltage or current.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        trigger: Trigger.
        cut: Whether a train that the end of the record cuts may be left out.

    Raises:
        RecordingError: There are no pauses, no pulses behind an edge of the trigger, or the end of
            the record cuts a train that may not be left out, or the only one.
    """
    period = sample_rate / pulse_rate
    edges = find_pulses(cause, sample_rate, pulse_rate).edges
    if trigger is not None:
        trains = _after_edges(trigger, cause, edges, period)
    else:
        trains = _trains(edges, period)
        if len(trains) < 2:
            raise RecordingError(
                f"has {several(edges.size, 'pulse')} without a pause between trains",
                field="v_th",
                remedy="Name a trigger channel, or do not split the record",
            )
    # A fifth of the first period lies before its pulse, or less where the record begins with it.
    starts = [max(0, int(train[0] - round(0.2 * period))) for train in trains]
    stops = [at + round(len(train) * period) for at, train in zip(starts, trains, strict=True)]
    both = zip(starts, stops, strict=True)
    whole = [slice(start, stop) for start, stop in both if stop <= cause.size]
    if not whole or (not cut and len(whole) < len(trains)):
        raise RecordingError(
            "the end of the record cuts the last train of pulses",
            remedy="Record a period without pulses behind it",
        )
    return Parts(whole, len(trains) - len(whole))


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
