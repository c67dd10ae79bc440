"""On-line identification: the loads at all electrodes of a display, after every pulse.

    tracker = etid.display.Tracker.of(driver, unloaded, electrodes=98)
    state = tracker.start()
    for v_out in pulses:  # (electrode, sample), one period each
        state = tracker.update(state, v_out)
    print(tracker.read(state))

The method is an extended Kalman filter in information form, iterated at each pulse (Bell and Cathey
1993). For one electrode, ϑ are the logarithms of its elements, Λ is their information, and Ĝ are
the gains of `etid.display.gain_bands`:

    Λ⁻ = (Λ⁻¹ + q² 1)⁻¹                                              (a random walk of the skin)
    minimise  |ϑ − ϑ⁻|²_Λ⁻ + Σ w |Ĝ e^(jωτ) − G(ϑ)|² / σ²   over ϑ and τ
    Λ  = T Λ⁻ Tᵀ + H_ϑϑ − H_ϑτ H_τϑ / H_ττ,                          H = JᵀJ

T turns what the pulses before tell to where this one is linearised (`etid.display.tick.turned`).
Aliases and the curvature of G over a band are computed with ϑ⁻ and subtracted from Ĝ.

**Each pulse has its own delay τ.** This is right if a trigger starts each window. It is also right
for a converter that runs freely, because its windows begin up to half a sample beside the pulse. A
model with one common delay would determine this delay better, but not ϑ: the information about ϑ
is the same sum.

**A pulse takes two evaluations of the model**, the first with derivatives, from the best delay of
a grid. An electrode that is
new, or that does not fit its prediction, is fitted anew from generic start values, by up to 40
more. `etid.display.alarms` says when this is a change of the skin or of the driver.

**A pulse that does not fit** even then changes only the verdict. The electrode starts again after
several such pulses in a row, and at once if it touches nothing.

**Amplitude.** V_out is divided by the amplitude of its pulse, relative to that of the unloaded
record. The driver is linear. `etid.display.alarms` says when the gain or the amplitude is wrong.

**A circuit that is not exact** is a misfit at every pulse, unless the tracker is told what the
circuit leaves (`etid.display.discrepancy`).

Z_th comes from the calibrations only; the pulses change neither it nor errors of the instrument.
More pulses reduce none of these errors, nor that from the noise of the unloaded record: all are in
`shared_cov`. Calibrate with two resistors. One resistor leaves a delay open, which makes an error
of one or two per cent in C_p.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, impedance_at
from etid.display.alarms import limit
from etid.display.clock import Clock
from etid.display.gain_bands import unloaded_bands
from etid.display.noise import Noise
from etid.display.projection import Projection
from etid.display.pulse_fit import GainModel
from etid.display.repeats import Windows
from etid.display.state import (
    Change,
    ElectrodeState,
    TrackerState,
    bad_electrodes,
    changes,
    fits_of,
)
from etid.display.tick import updated
from etid.estimators.estimator import serving
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import circuit_of, number_of, require
from etid.identify.fitting import known_at
from etid.identify.planning import explained
from etid.precision import Kept, in_float64, unmasked, untraced
from etid.printing import Overview, Overviewed, per_cent, several
from etid.recordings.errors import not_recorded
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording, RecordingError
from etid.results.columns import described
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fit import IdentificationError
from etid.results.fits import Fits
from etid.results.verdicts import RESULTS, message, verdict_names, verdicts_of

# A window has faults that a record of several periods has not, and others have other remedies.
NOTES = {
    "too_short": "No pulse was identified yet; the elements are typical values, not estimates.",
    "max_steps_reached": "No load of this circuit gives this pulse. Does the window begin between "
    "two pulses, is `amplitude` that of the pulse, and is v_out in volt at the terminal?",
    "misfit": f"{message('misfit')} Is `amplitude` that of the pulse, and the gain of v_out right? "
    "If a fit of a record of this skin is `approximate`, give the tracker its `discrepancy`.",
}


# No `equinox.Module`: its methods would cost a twentieth of a tick at every call.
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Tracker(Overviewed, Kept):
    """Identifies the loads at all electrodes of a display with every pulse.

    Make a tracker with `Tracker.of`.

    Attributes:
        model: Model of the gain of a pulse.
        projection: What makes bands of the samples of a pulse.
        change: Standard deviation of the random walk of the elements' logarithms [1/√pulse].
        limit: Limit of the tests for a change [χ²].
        adc_range: Voltages at which the converter saturates [V].
        driver_result: Verdict of the driver.
        electrodes: Number of electrodes.
        period: Length of a period [samples].
        line: Standard error of the amplitude of a line of the mains in one pulse [V].
        discrepancy: What the circuit leaves of the signal, as it was given.
    """

    model: GainModel
    projection: Projection
    change: Float[Array, ""]
    limit: Float[Array, ""]
    adc_range: Float[np.ndarray, " 2"]
    driver_result: RESULTS
    electrodes: int
    period: float
    line: float
    discrepancy: float

    @classmethod
    @in_float64
    def of(
        cls,
        driver: Driver,
        unloaded: Recording,
        *,
        electrodes: int,
        circuit: AbstractCircuit | str | None = None,
        change: float = 0.0,
        discrepancy: float = 0.0,
    ) -> "Tracker":
        """A tracker for one driver.

        Args:
            driver: Driver identified by maximum likelihood.
            unloaded: A recording whose `v_th` is the unloaded voltage, such as the calibration. Use
                several periods: they determine the aliases. The pulses must have its sample rate
                and pulse rate.
            electrodes: Number of electrodes.
            circuit: As in `identify_skin`, without `"auto"`.
            change: Standard deviation of the change of the elements' logarithms from pulse to pulse
                (a random walk) [1/√pulse]; 0 for elements that do not change.
            discrepancy: What the circuit leaves of the signal, as an `approximate` fit of such a
                load says (`Fit.leaves`), such as 0.005; 0 for a circuit that is exact. It is the
                standard deviation of the real and of the imaginary part of a smooth relative error
                of the gain. Verdicts are then `approximate`, and ± contain it.

        Returns:
            The tracker. It does not change; its states hold the estimates.

        Raises:
            RecordingError: An argument has another type, or the recording has no `v_th`.
            ValueError: The driver has no harmonics of its calibrations, or a number is too small.
            IdentificationError: The recording cannot be used; the message says why.
        """
        require("driver", driver, Driver)
        require("unloaded", unloaded, Recording)
        if unloaded.cause != driver.recorded:
            remedy = "Take a calibration, or record the unloaded voltage"
            raise not_recorded(unloaded.path, driver.recorded, remedy)
        electrodes, given = int(number_of("electrodes", electrodes)), electrodes
        if electrodes < 1 or electrodes != given:
            raise ValueError(f"electrodes is {given}; a display has one electrode or more")
        change = number_of("change", change)
        if not (np.isfinite(change) and change >= 0):
            raise ValueError(f"change is {change}; it must be finite and not negative")
        discrepancy = number_of("discrepancy", discrepancy)
        if not 0 <= discrepancy < 1:
            raise ValueError(
                f"discrepancy is {discrepancy}; give the part of the signal that the circuit "
                "leaves, such as 0.005"
            )
        driver = serving(driver, HarmonicDriver, str(MAXIMUM_LIKELIHOOD))
        seen = Inspected.of(unloaded)
        name = preflight(seen, periodic=True) or ("biased" if seen.is_aliased else None)
        if name is not None:
            text = f"unloaded recording {unloaded.path!r}: {name}. {explained(seen, name)}"
            raise IdentificationError(text, None)
        rate = unloaded.sample_rate
        sigma = float(seen.sigma[0])
        period = seen.exact_spacing
        try:
            bands, projection = unloaded_bands(seen.v_th, sigma, rate, period)
        except ValueError as error:
            raise IdentificationError(
                f"unloaded recording {unloaded.path!r}: {error}", None
            ) from None
        known = jax.device_put(known_at(bands.frequency, driver, False, MAXIMUM_LIKELIHOOD))
        low, high = unloaded.adc_range or (-np.inf, np.inf)
        half = seen.step[0] / 2
        model = GainModel.of(
            circuit_of(circuit),
            bands,
            known,
            jnp.asarray(driver.source.response(rate - bands.frequency)),
            projection.freedom(),
            discrepancy,
        )
        return cls(
            model=model,
            projection=projection,
            change=jnp.asarray(float(change)),
            limit=jnp.asarray(limit(len(model.circuit.names()), rate / period)),
            adc_range=np.array([low + half, high - half]),
            driver_result=driver.result,
            electrodes=electrodes,
            period=period,
            line=sigma * float(np.sqrt(2 / period)),
            discrepancy=discrepancy,
        )

    def _overview(self) -> Overview:
        kind, of_driver = type(self.model.circuit).__name__, verdict_names(self.driver_result)
        rows = [
            ("electrodes", str(self.electrodes), ""),
            ("period", f"{self.period:g}", "samples"),
            ("change", f"{float(self.change):g}", "1/√pulse"),
        ]
        if self.discrepancy:
            rows.append(("discrepancy", per_cent(self.discrepancy), "of the signal"))
        return Overview(f"Tracker of {kind}, driver {of_driver}", rows)

    @in_float64
    def start(self, *, at_rest: bool = False, after: TrackerState | None = None) -> TrackerState:
        """The state before the first pulse, without information.

        Args:
            at_rest: Whether there was no pulse before the first one. Otherwise that pulse had the
                amplitude of the first one. A display at rest is identified from the second pulse
                on, whose amplitude should be that of the first one.
            after: The last state, if the stream goes on and only the estimates begin anew. Its
                windows remain known, so that a converter that returns them is noticed.

        Raises:
            RecordingError: `after` is no state of a tracker.
            ValueError: `after` is the state of another tracker.
        """
        lanes, elements = self.electrodes, len(self.model.circuit.names())
        typical = jnp.append(self.model.circuit.log_values(), 0.0)
        nan, none = jnp.full(lanes, jnp.nan), jnp.zeros(lanes, int)
        electrodes = ElectrodeState(
            own=jnp.broadcast_to(typical[None, :], (lanes, elements + 1)),
            information=jnp.zeros((lanes, elements, elements)),
            pulses=none,
            missed=none,
            amplitude=jnp.zeros(lanes) if at_rest else nan,
            offset=nan,
            repeated=jnp.zeros(lanes, bool),
            scores=jnp.zeros((lanes, 2, 3)),
            shape=jnp.zeros((lanes, elements, elements)),
            confirmed=jnp.zeros(lanes),
            level=nan,
            variance=nan,
            chi2=nan,
            rrse=nan,
            result=jax.tree.map(jnp.asarray, verdicts_of(np.full(lanes, "too_short"))),
            mean=jnp.zeros((lanes, elements)),
            mean_cov=jnp.zeros((lanes, elements, elements)),
            event=none,
            factor=jnp.zeros((lanes, elements)),
            element=none,
            drifted=none - 1,
        )
        no = jnp.asarray(False)
        if after is None:
            windows = Windows.of(self.projection.runs, self.projection.block, lanes)
            number = jnp.zeros((), int)
        else:
            self.check(after)
            windows, number = after.windows, after.number
        bands = self.model.bands
        noise = Noise.of(bands.noise, len(bands.lines) // 2, self.line, lanes)
        state = TrackerState(electrodes, noise, number, no, no, windows)
        # Types and device of a state that `update` returns: with others, it would compile twice.
        state = jax.tree.map(lambda leaf: leaf.astype(leaf.dtype), state)
        return jax.device_put(state, self.model.source.sharding)

    def check(self, state: TrackerState) -> None:
        """Refuse what is no state of this tracker.

        Raises:
            RecordingError: `state` has another type.
            ValueError: `state` has another number of electrodes or elements.
        """
        require("state", state, TrackerState, "Take that of Tracker.start or Tracker.update")
        found, own = state.electrodes.own.shape, len(self.model.circuit.names()) + 1
        if found != (self.electrodes, own):
            raise ValueError(
                f"state has {several(found[0], 'electrode')} of {found[1] - 1} elements, the "
                f"tracker {self.electrodes} of {own - 1}; it is the state of another tracker"
            )

    def pulses(
        self, v_out: Float[np.ndarray, "*lane time"]
    ) -> Float[np.ndarray, "pulse *lane sample"]:
        """Windows of one pulse each, cut from longer records.

        Args:
            v_out: Loaded voltages of one display [V]. The records begin between two pulses.

        Returns:
            The windows [V]. Samples after the last whole window are left out. Each begins where the
            pulses are, by the clock of the converter.
        """
        v_out = np.asarray(unmasked(v_out))
        clock, found = self.clock(), []
        while (end := clock.begin + clock.samples) <= v_out.shape[-1]:
            found.append(v_out[..., clock.begin : end])
            clock.follow(found[-1].reshape(-1, clock.samples))
        return np.stack(found) if found else np.zeros((0, *v_out.shape[:-1], clock.samples))

    @in_float64
    def clock(self) -> Clock:
        """A clock for the pulses of one stream."""
        model = untraced(self.model)
        return Clock(self.period, model.bands.waveform(model.undelayed(model.circuit.log_values())))

    @in_float64
    def update(
        self,
        state: TrackerState,
        v_out: Float[Array | np.ndarray, "lane sample"],
        amplitude: float | Float[Array | np.ndarray, " pulse"] = 1.0,
    ) -> TrackerState:
        """The state after one more pulse.

        Args:
            state: State before this pulse; it does not change.
            v_out: Loaded voltage of one period at every electrode [V]. The windows begin between
                two pulses.
            amplitude: Primary amplitude of this pulse, at all electrodes or at each, relative to
                that of the unloaded record. An electrode without a pulse has 0; its state remains.

        Returns:
            State after this pulse. Its windows are those of `state` and this one.

        Raises:
            RecordingError: `state` is no state of a tracker, or `v_out` holds no real numbers, or
                integers without a scale.
            ValueError: `v_out` does not hold one window of one period for each electrode, or an
                amplitude is negative, or there is not one for each electrode, or the state is that
                of another tracker.
        """
        self.check(state)
        expected = (self.electrodes, self.model.bands.samples)
        if np.shape(v_out) != expected:
            raise ValueError(
                f"v_out has shape {np.shape(v_out)}; one period at each electrode has the shape "
                f"(electrode, sample) = {expected} (Tracker.pulses cuts longer records)"
            )
        v_out = np.asarray(unmasked(v_out))
        if v_out.dtype.kind != "f":
            raise RecordingError(
                f"has dtype {v_out.dtype}, must be voltages as real numbers",
                field="v_out",
                remedy="Multiply converter codes by volts per code; convert voltages to floats",
            )
        relative = for_each("amplitude", amplitude, self.electrodes)
        old = state.windows.repeated(v_out, int(state.number) + 1)
        sums = self.projection.band_sums(v_out.astype(float, copy=False), self.adc_range)
        sums = sums._replace(repeated=old)
        before, number, changed = state.electrodes, state.number, state.driver_changed
        electrodes, noise, number, event, changed = updated(
            self.model,
            self.change,
            self.limit,
            before,
            state.noise,
            number,
            changed,
            sums,
            relative,
        )
        return TrackerState(electrodes, noise, number, event, changed, state.windows)

    @in_float64
    def read(self, state: TrackerState) -> Fits:
        """Elements, standard errors, χ² of the last pulse and verdict of every electrode.

        `steps` is the number of pulses that contribute to the elements. `shared_cov` is the part of
        the covariance that more pulses do not reduce. If the last pulse did not fit, the elements
        are those before it.

        Args:
            state: State of the tracker.

        Returns:
            One fit per electrode, in the order of the electrodes, with the label `electrode`.

        Raises:
            RecordingError: `state` is no state of a tracker.
        """
        self.check(state)
        model, electrodes, noise = untraced((self.model, state.electrodes, state.noise))
        changed = bool(state.driver_changed)
        fit = fits_of(model, self.driver_result, changed, electrodes, noise)
        electrodes = [
            {"path": f"electrode/{number}", "electrode": str(number)}
            for number in range(self.electrodes)
        ]
        notes = np.array([NOTES.get(name) or message(name) for name in fit.verdict])
        return Fits(fit, described(electrodes), notes)

    @in_float64
    def changes(self, state: TrackerState) -> list[Change]:
        """The changes that the last pulse has shown; see `etid.display.alarms`.

        Expect one false alarm per electrode in 20 hours, and none of the driver. If the driver has
        changed, the changes of the electrodes are not listed, and all verdicts remain
        `inconsistent` until a new tracker starts after a new calibration.

        Args:
            state: State of the tracker.
        """
        return changes(state, self.model.circuit.names())

    @in_float64
    def bad_electrodes(self, state: TrackerState) -> dict[int, str]:
        """Electrodes that cannot be used, by number, and why.

        `open` takes no current, `shorted` less than 2 % of the voltage, `dry` has more than 700 kΩ
        at the lowest frequency, `drifting` drifted in the last 60 pulses more than `change` says.

        Args:
            state: State of the tracker.
        """
        logs, model = np.asarray(state.electrodes.own)[:, :-1], self.model
        lowest = impedance_at(model.circuit, logs, np.asarray(model.bands.frequency)[:1])
        return bad_electrodes(state, np.abs(lowest[:, 0]))


def for_each(name: str, given: Any, electrodes: int) -> Float[np.ndarray, " lane"]:
    """A number for each electrode, from one for all or one for each.

    Raises:
        ValueError: A number is negative or not finite, or there is not one for each electrode.
    """
    found = np.asarray(unmasked(given), float)
    if found.shape not in ((), (electrodes,)):
        raise ValueError(
            f"{name} has shape {found.shape}; give one number, or one for each of "
            f"{several(electrodes, 'electrode')}"
        )
    if not (np.isfinite(found) & (found >= 0)).all():
        raise ValueError(f"{name} is {found}; it must be finite and not negative")
    return np.full(electrodes, found)
