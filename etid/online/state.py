"""The state of a tracker: what it knows about every electrode after a pulse."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from etid.circuits.overview import Overview, Overviewed
from etid.results.verdicts import RESULTS, counted, verdict_names


class ElectrodeState(eqx.Module):
    """Estimates for one electrode, or for all electrodes along a leading axis.

    Attributes:
        own: Logarithms of the elements [SI], and the delay of the last pulse [samples].
        information: Inverse covariance of the elements' logarithms; 0 before the first good pulse.
        pulses: Number of pulses that contribute to `information`.
        missed: Number of pulses in a row that did not fit.
        amplitude: Amplitude of the last pulse, relative to that of the unloaded record;
            NaN before the first pulse.
        offset: Offset of the converter [V].
        shown: A number that two different windows never share, of the last two windows.
        confirmed: Largest amplitude of a pulse that fitted its prediction, since the last pulse
            that did not; 0 if there was none.
        gain: Sums of the test of the gain since the electrode began anew, `GainScore.sums`.
        level: Effective value of the gain of the last pulse; 1 if the electrode is open.
        variance: E|noise|² of a Fourier coefficient of the last pulse [V²].
        chi2: χ² of the last pulse.
        rrse: RRSE of the last pulse.
        result: Verdict on the last pulse.
        mean: Moving mean of the innovations, d in `etid.online.changes`.
        mean_cov: Covariance of `mean`.
        event: Change found by the last pulse: 0 for none, 1 for a jump, 2 for a drift.
        factor: Logarithms of new over old elements at the last change.
        element: Number of the element that explains the last change best.
        drifted: Number of the pulse at which the last drift was found; −1 for none.
    """

    own: Float[Array, "*lane own"]
    information: Float[Array, "*lane element element"]
    pulses: Int[Array, "*lane"]
    missed: Int[Array, "*lane"]
    amplitude: Float[Array, "*lane"]
    offset: Float[Array, "*lane"]
    shown: Float[Array, "*lane 2"]
    confirmed: Float[Array, "*lane"]
    gain: Float[Array, "*lane 3"]
    level: Float[Array, "*lane"]
    variance: Float[Array, "*lane"]
    chi2: Float[Array, "*lane"]
    rrse: Float[Array, "*lane"]
    result: RESULTS
    mean: Float[Array, "*lane element"]
    mean_cov: Float[Array, "*lane element element"]
    event: Int[Array, "*lane"]
    factor: Float[Array, "*lane element"]
    element: Int[Array, "*lane"]
    drifted: Int[Array, "*lane"]


class TrackerState(Overviewed, eqx.Module):
    """Estimates for every electrode after a pulse.

    Attributes:
        electrodes: Estimates of all electrodes.
        number: Number of pulses since the start.
        driver_event: Whether the last pulse showed a change of the driver.
        driver_changed: Whether any pulse since the start did.
    """

    electrodes: ElectrodeState
    number: Int[Array, ""]
    driver_event: Bool[Array, ""]
    driver_changed: Bool[Array, ""]

    def _overview(self) -> Overview:
        lanes = self.electrodes
        names = verdict_names(lanes.result)
        columns = map(np.asarray, (lanes.pulses, lanes.missed, lanes.chi2))
        rows = [
            (str(number), str(name), str(pulses), str(missed), f"{chi2:.3g}")
            for number, (name, pulses, missed, chi2) in enumerate(zip(names, *columns, strict=True))
        ]
        notes = ["Tracker.read(state) gives the elements, Tracker.changes(state) the changes."]
        if bool(self.driver_changed):
            notes.insert(0, "The driver has changed: calibrate again.")
        return Overview(
            f"State of {names.size} electrodes after {int(self.number)} pulses, "
            f"last pulse: {counted(names)}",
            rows,
            ("electrode", "verdict", "pulses", "missed in a row", "chi2"),
            notes,
        )
