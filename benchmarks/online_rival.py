"""The time of filterpy's extended Kalman filter, with the model and the pulses of the tracker."""

import numpy as np
from jaxtyping import Float

import etid
from benchmarks.rivals import RivalError, exchange, make

ENVIRONMENT = "filterpy"
WORKER = "benchmarks.rivals.kalman_by_filterpy"
OFF = 0.05  # of the elements, by which its start differs from what the tracker has found


def seconds(
    tracker: etid.Tracker,
    pulses: Float[np.ndarray, "pulse lane sample"],
    logs: Float[np.ndarray, "lane element"],
) -> float:
    """Median processor time of filterpy for one pulse at all electrodes, the bands apart [s].

    Args:
        tracker: Tracker of `SkinRC` whose model is used.
        pulses: Windows of the first pulses after a start [V].
        logs: Logarithms of the elements that the tracker has found.

    Raises:
        RivalError: filterpy cannot be installed or run.
    """
    missing = make(ENVIRONMENT)
    if missing:
        raise RivalError(missing)
    seen = [tracker.projection.seen(v_out, tracker.adc_range) for v_out in pulses]
    variance, begins = np.stack([of.variance for of in seen]), np.arange(len(pulses)) % 3
    found = exchange(
        ENVIRONMENT,
        WORKER,
        gains=np.stack([np.asarray(one.gain()) for one in seen]),
        variances=variance[:, :, None] / np.asarray(tracker.model.bands.weight),
        delays=begins * tracker.period - np.round(begins * tracker.period),
        frequency=np.asarray(tracker.model.bands.frequency),
        turn=np.asarray(tracker.model.turn),
        source=np.asarray(tracker.model.source),
        change=np.asarray(tracker.change),
        start=logs + OFF,
    )
    print(f"filterpy    differs by at most {np.abs(found['logs'] - logs).max():.1%} in an element")
    return float(np.median(found["seconds"]))
