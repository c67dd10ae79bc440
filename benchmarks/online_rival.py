"""The time of filterpy's extended Kalman filter, with the model and the pulses of the tracker."""

import os
import pathlib
import subprocess
import tempfile

import numpy as np
from jaxtyping import Float

import etid
from benchmarks.rivals import ONE_THREAD, ROOT, make, python_of

ENVIRONMENT = "filterpy"
WORKER = "benchmarks.rivals.kalman_by_filterpy"
OFF = 0.05  # of the elements, by which its start differs from what the tracker has found


def seconds(
    tracker: etid.Tracker,
    pulses: Float[np.ndarray, "pulse lane sample"],
    logs: Float[np.ndarray, "lane element"],
) -> float | str:
    """Median processor time of filterpy for one pulse at all electrodes, the bands apart [s].

    Args:
        tracker: Tracker of `SkinRC` whose model is used.
        pulses: Windows of the first pulses after a start [V].
        logs: Logarithms of the elements that the tracker has found.

    Returns:
        The time; why there is none, if filterpy cannot be installed.
    """
    missing = make(ENVIRONMENT)
    if missing:
        return missing
    seen = [tracker.projection.seen(v_out, tracker.adc_range) for v_out in pulses]
    variance = np.stack([np.asarray(one.variance) for one in seen])
    begins = np.arange(len(pulses)) % 3 * tracker.period
    with tempfile.TemporaryDirectory() as folder:
        given, found = pathlib.Path(folder, "problem.npz"), pathlib.Path(folder, "result.npz")
        np.savez(
            given,
            gains=np.stack([np.asarray(one.gain()) for one in seen]),
            variances=variance[:, :, None] / np.asarray(tracker.model.bands.weight),
            delays=begins - np.round(begins),
            frequency=np.asarray(tracker.model.bands.frequency),
            turn=np.asarray(tracker.model.turn),
            source=np.asarray(tracker.model.source),
            change=np.asarray(tracker.change),
            start=logs + OFF,
        )
        subprocess.run(
            [python_of(ENVIRONMENT), "-m", WORKER, given, found],
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            check=True,
        )
        with np.load(found) as file:
            apart = np.abs(file["logs"] - logs).max()
            print(f"filterpy    differs by at most {apart:.1%} in an element")
            return float(np.median(file["seconds"]))
