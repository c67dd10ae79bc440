"""The state of a tracker after a pulse, and what it says: fits, changes, electrodes to repair."""

import dataclasses
import math

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from etid.display.alarms import score_of
from etid.display.noise import Noise, directions
from etid.display.pulse_fit import GainModel, Pulse
from etid.display.repeats import Windows
from etid.estimators.online import METHOD
from etid.likelihood.linear import diagonal, inverse
from etid.likelihood.scores import doubt
from etid.precision import Module, array_function
from etid.printing import Overview, Overviewed, rounded, several
from etid.recordings.remarks import Remark
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS, counted, usable, verdict_names, verdicts_of

OPEN = 0.99  # effective gain above which an electrode touches nothing
SHORTED = 0.02  # effective gain below which an electrode is shorted
DRY = 700e3  # [Ω] at the lowest frequency; the driest fingertip of the paper's Table II has 686 kΩ
RECENT = 60  # pulses for which an electrode that has drifted is called drifting
NONE, JUMP, DRIFT, REPEATED = range(4)
KINDS = ("none", "jump", "drift", "repeated")


class ElectrodeState(Module):
    """Estimates for one electrode, or for all electrodes along a leading axis.

    Attributes:
        own: Logarithms of the elements [SI], and the delay of the last pulse [samples].
        information: Inverse covariance of the elements' logarithms; 0 before the first good pulse.
        pulses: Number of pulses that contribute to `information`.
        missed: Number of pulses in a row that did not fit.
        amplitude: Amplitude of the last pulse, relative to that of the unloaded record;
            NaN before the first pulse.
        offset: Offset of the converter [V].
        repeated: Whether the last window was an old one (`etid.display.repeats`).
        confirmed: Largest amplitude of a pulse that fitted its prediction, since the last pulse
            that did not; 0 if there was none.
        scores: Sums of the tests of a gain and of a spread since the electrode began anew,
            `etid.display.alarms.PulseScores.sums`.
        shape: Information of the last good pulse about the elements, for each unit of its weight.
        level: Effective value of the gain of the last pulse; 1 if the electrode is open.
        variance: E|noise|² of a Fourier coefficient of the last pulse [V²].
        chi2: χ² of the last pulse.
        rrse: RRSE of the last pulse.
        result: Verdict on the last pulse.
        mean: Moving mean of the innovations, m in `etid.display.alarms`.
        mean_cov: Covariance of `mean`.
        event: What the last pulse has shown: 0 for nothing, 1 for a jump, 2 for a drift, 3 for old
            windows that begin.
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
    repeated: Bool[Array, "*lane"]
    confirmed: Float[Array, "*lane"]
    scores: Float[Array, "*lane change 3"]
    shape: Float[Array, "*lane element element"]
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


class TrackerState(Overviewed, Module):
    """Estimates for every electrode after a pulse.

    Attributes:
        electrodes: Estimates of all electrodes.
        noise: What their pulses have shown of the noise.
        number: Number of pulses since the start of the stream.
        driver_event: Whether the last pulse showed a change of the driver.
        driver_changed: Whether any pulse since the start did.
        windows: The windows since the start; states of one stream share them.
    """

    electrodes: ElectrodeState
    noise: Noise
    number: Int[Array, ""]
    driver_event: Bool[Array, ""]
    driver_changed: Bool[Array, ""]
    windows: Windows = eqx.field(static=True)

    def _overview(self) -> Overview:
        lanes = self.electrodes
        names = verdict_names(lanes.result)
        columns = map(np.asarray, (lanes.pulses, lanes.missed, lanes.chi2))
        rows = [
            (str(at), str(name), str(pulses), str(missed), rounded(chi2, 3))
            for at, (name, pulses, missed, chi2) in enumerate(zip(names, *columns, strict=True))
        ]
        notes = ["Tracker.read(state) gives the elements, Tracker.changes(state) the changes."]
        if bool(self.driver_changed):
            notes.insert(0, "The driver has changed: calibrate again.")
        if not int(self.number):
            return Overview(f"State of {several(names.size, 'electrode')} before the first pulse")
        return Overview(
            f"State of {several(names.size, 'electrode')} after "
            f"{several(int(self.number), 'pulse')}, the last one: {counted(names)}",
            rows,
            ("electrode", "verdict", "pulses", "missed in a row", "chi2"),
            notes,
        )


@array_function
def fits_of(
    model: GainModel,
    driver_result: RESULTS,
    driver_changed: bool,
    state: ElectrodeState,
    noise: Noise,
) -> Fit:
    """The fits of all electrodes, in NumPy."""
    bands, logs = model.bands, state.own[:, :-1]
    lanes, elements = logs.shape
    expected = model.expected(logs)
    nothing = np.zeros((lanes, elements, elements))
    weight = bands.weight / state.variance[:, None] / noise.bands
    smooth = model.smooth(expected.gain, np.zeros(lanes), weight)
    lines = directions(model.patterns(np.zeros(lanes), weight, noise.line, smooth))
    pulse = Pulse(model, np.zeros_like(expected.gain), weight, logs, nothing, lines, smooth)
    jacobian = pulse.jacobian(expected)
    by_term = inverse(jacobian @ jacobian.swapaxes(-1, -2))[:, :elements] @ jacobian
    of_source = by_term @ pulse.whitened(model.by_error(expected.gain)).swapaxes(-1, -2)
    # The noise of X is the same in every pulse. It enters Ĝ multiplied by G.
    of_x = by_term * np.sqrt(pulse.by_x(expected.gain))[:, None]
    by_gain = pulse.whitened(expected.gain[:, None])
    slope = -(by_term @ by_gain.swapaxes(-1, -2))[..., 0]
    likely, of_doubt = doubt(score_of(state.scores[:, 0], slope), np.zeros(lanes, bool))
    shared = sum((of @ of.swapaxes(-1, -2) for of in (of_source, of_x)), of_doubt)
    cov = inverse(state.information) + shared
    values, known = np.exp(logs), (state.pulses > 0)[:, None, None]
    scale = np.where(known, values[:, :, None] * values[:, None, :], np.nan)
    later = np.select(
        [
            ~(diagonal(cov) < 1).all(-1),
            np.full(lanes, ~usable(driver_result)),
            np.full(lanes, driver_changed),
        ],
        ["insensitive", "driver_failed", "inconsistent"],
        "successful" if model.discrepancy is None else "approximate",
    )
    names = verdict_names(state.result)
    return Fit(
        circuit=model.circuit.of_fit(values.T),
        cov=cov * scale,
        shared_cov=shared * scale,
        rrse=state.rrse,
        chi2=state.chi2,
        result=verdicts_of(np.where(names == "successful", later, names)),
        steps=state.pulses,
        method=METHOD,
        remarks=np.where(likely, int(Remark.gain_doubtful), 0),
    )


@dataclasses.dataclass(frozen=True)
class Change:
    """A change that a pulse has shown.

    Attributes:
        pulse: Number of the pulse since the start, from 1 on.
        electrode: Number of the electrode; None for the driver, and for more than half of the
            electrodes whose windows begin to repeat together.
        kind: `jump`, `drift`, `driver`, or `repeated`.
        element: Name of the element that explains a jump or a drift best; otherwise empty.
        factor: New value of this element divided by the old one; otherwise NaN.
    """

    pulse: int
    electrode: int | None
    kind: str
    element: str
    factor: float

    def __str__(self) -> str:
        return f"pulse {self.pulse}: {self.words(f'electrode {self.electrode}')}"

    def words(self, name: str) -> str:
        """What has happened, with cause and remedy.

        Args:
            name: Name of the electrode.
        """
        if self.kind == "driver":
            return "the driver has changed; calibrate again"
        if self.kind == "repeated":
            where = f"at {name}" if self.electrode is not None else "at most electrodes"
            return (
                f"old windows return {where}: the converter's buffer is not filled anew. Amplitude "
                "0 until the noise is new. Check the acquisition"
            )
        return f"{self.kind} of {self.element}, to {self.factor:.2g} times its value, at {name}"


def changes(state: TrackerState, names: tuple[str, ...]) -> list[Change]:
    """The changes that the last pulse has shown; see `Tracker.changes`."""
    number, lanes = int(state.number), state.electrodes
    if state.driver_event:
        return [Change(number, None, "driver", "", math.nan)]
    event, element, factor = map(np.asarray, (lanes.event, lanes.element, lanes.factor))
    found = [
        Change(
            number,
            int(at),
            KINDS[event[at]],
            names[element[at]],
            float(np.exp(factor[at, element[at]])),
        )
        for at in np.flatnonzero((event == JUMP) | (event == DRIFT))
    ]
    old: list[int | None] = [*np.flatnonzero(event == REPEATED).tolist()]
    if len(old) > max(event.size / 2, 1):
        old = [None]
    return found + [Change(number, at, KINDS[REPEATED], "", math.nan) for at in old]


def bad_electrodes(state: TrackerState, impedance: Float[np.ndarray, " lane"]) -> dict[int, str]:
    """Electrodes that cannot be used, with the reason; see `Tracker.bad_electrodes`."""
    lanes = state.electrodes
    known = np.asarray(lanes.pulses) > 0
    since = int(state.number) - np.asarray(lanes.drifted)
    reasons = {
        "open": verdict_names(lanes.result) == "unconnected",
        "shorted": np.asarray(lanes.level) < SHORTED,
        "dry": known & (impedance > DRY),
        "drifting": (np.asarray(lanes.drifted) >= 0) & (since < RECENT),
    }
    found: dict[int, str] = {}
    for reason, applies in reasons.items():
        for electrode in np.flatnonzero(applies):
            found.setdefault(int(electrode), reason)
    return dict(sorted(found.items()))
