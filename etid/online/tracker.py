"""On-line identification: the loads at all electrodes of a display, after every pulse.

    tracker = etid.Tracker.of(driver, unloaded, electrodes=98)
    state = tracker.start()
    for v_out in pulses:  # (electrode, sample), one period each
        state = tracker.update(state, v_out)
    print(tracker.read(state))

The method is an extended Kalman filter in information form, iterated at each pulse (Bell and Cathey
1993). For one electrode, ϑ are the logarithms of its elements, Λ is their information, and Ĝ are
the gains of `etid.online.gain_bands`:

    Λ⁻ = (Λ⁻¹ + q² 1)⁻¹                                              (a random walk of the skin)
    minimise  |ϑ − ϑ⁻|²_Λ⁻ + Σ w |Ĝ e^(jωτ) − G(ϑ)|² / σ²   over ϑ and τ
    Λ  = Λ⁻ + H_ϑϑ − H_ϑτ H_τϑ / H_ττ,                               H = JᵀJ

Aliases and the curvature of G over a band are computed with ϑ⁻ and subtracted from Ĝ.

**Each pulse has its own delay τ.** This is right if a trigger starts each window. It is also right
for a converter that runs freely, because its windows begin up to half a sample beside the pulse. A
model with one common delay would determine this delay better, but not ϑ: the information about ϑ
is the same sum.

**Every pulse takes the same time**: one Levenberg-Marquardt step from the best delay of a grid. An
electrode without a good pulse also tries generic start values. In a test with 96 kinds of skin,
each up to a factor of 3 from these values, two thirds were found after 5 pulses and all after 30.

**A pulse that does not fit** changes only the verdict. The electrode starts again after several
such pulses in a row, or if the pulses disagree with their standard errors for a long time.

Z_th comes from the calibrations only; the pulses do not change it. More pulses reduce neither its
error nor the error from the noise of the unloaded record: both are in `shared_cov`. Calibrate with
two resistors. One resistor leaves a delay open, which makes an error of one or two per cent in C_p.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.overview import Overview, Overviewed
from etid.estimators.estimator import Description, serving
from etid.estimators.judgement import (
    MAX_STEPS_REACHED,
    MISFIT_CHI2,
    MISFIT_RRSE,
    SUCCESSFUL,
    misses,
)
from etid.estimators.maximum_likelihood.given_driver import GivenDriver, combined
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, register_description
from etid.estimators.starts import circuit_starts
from etid.estimators.unknowns import LoadUnknowns
from etid.identify.arguments import circuit_of, require_float64
from etid.identify.compiled import stored_jit
from etid.identify.one import explained, known_at
from etid.online.gain_bands import cut, unloaded_bands
from etid.online.pulse_fit import (
    DAMPING,
    DELAYS,
    SETTLED,
    GainModel,
    Pulse,
    minimum,
    nearest,
)
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fits import Fit, Fits, IdentificationError, described
from etid.results.verdicts import (
    RESULTS,
    counted,
    first_verdict,
    message,
    verdict_names,
    verdicts_of,
)
from etid.signals.transfer import as_complex, power, reciprocal
from etid.solvers.matrices import inverse, inverse_of_few

METHOD = "online"
FLAT = 4.0  # power relative to that of noise alone; below this, the pulse is `flat`
PATIENCE = 5  # pulses in a row that do not fit, after which an electrode starts again
MEMORY = 30  # pulses over which `strain` is averaged
STRAINED = 2.0  # limit of `strain`; it is 1 on average, with a standard deviation of 0.15

register_description(
    METHOD,
    Description(
        words="on-line tracking",
        text="The loads were identified on-line, anew with each pulse, by an extended Kalman "
        "filter in information form, iterated at each pulse (Bell and Cathey, 1993). In bands of "
        "frequency of each pulse, the ratio of the loaded to the unloaded voltage was compared "
        "with Z_L / (Z_L + Z_th) exp(-jωτ), in continuous time and with what has aliased; the "
        "trigger delay τ of each pulse was one more unknown. The logarithms of the elements follow "
        "a random walk. Z_th is that of the calibrations.",
        conditions=(
            "the last pulse passed the checks for flat, clipped and missing samples",
            "its iteration settled",
            "its residual does not exceed the noise (χ² per degree of freedom of at most "
            f"{MISFIT_CHI2:g}, or an unexplained part of at most {100 * MISFIT_RRSE:g} % of the "
            "signal)",
            f"its trigger delay is at most {DELAYS[-1]:g} samples",
            "pulses do not disagree with their predictions by more than their errors",
            "every relative standard error is below 1",
        ),
        errors="accumulate the information of all pulses; to them the error of Z_th and of the "
        "unloaded voltage was added, which no number of pulses lessens",
        noise="The variance of the noise was estimated at each pulse from what a straight line "
        "through each band leaves.",
        cited=("bell1993",),
    ),
)


class TrackerState(Overviewed, eqx.Module):
    """Estimates for every electrode after a pulse.

    Attributes:
        own: Logarithms of the elements [SI], and the delay of the last pulse [samples].
        information: Inverse covariance of the elements' logarithms; 0 before the first good pulse.
        pulses: Number of pulses that contribute to `information`.
        missed: Number of pulses in a row that did not fit.
        damping: Damping of the next step.
        strain: Mean squared difference between pulses and their predictions, in units of its
            variance.
        variance: E|noise|² of a Fourier coefficient of the last pulse [V²].
        chi2: χ² of the last pulse.
        rrse: RRSE of the last pulse.
        result: Verdict on the last pulse.
    """

    own: Float[Array, "*lane own"]
    information: Float[Array, "*lane element element"]
    pulses: Int[Array, "*lane"]
    missed: Int[Array, "*lane"]
    damping: Float[Array, "*lane"]
    strain: Float[Array, "*lane"]
    variance: Float[Array, "*lane"]
    chi2: Float[Array, "*lane"]
    rrse: Float[Array, "*lane"]
    result: RESULTS

    def _overview(self) -> Overview:
        names = verdict_names(self.result)
        rows = [
            (str(number), str(name), str(pulses), str(missed), f"{chi2:.3g}")
            for number, (name, pulses, missed, chi2) in enumerate(
                zip(names, *map(np.asarray, (self.pulses, self.missed, self.chi2)), strict=True)
            )
        ]
        return Overview(
            f"State of {names.size} electrodes, last pulse: {counted(names)}",
            rows,
            ("electrode", "verdict", "pulses", "missed in a row", "chi2"),
            ("Tracker.read(state) gives the elements.",),
        )


class Tracker(Overviewed, eqx.Module):
    """Identifies the loads at all electrodes of a display with every pulse.

    Make a tracker with `Tracker.of`.

    Attributes:
        model: Model of the gain of a pulse.
        known: Z_th in the bands and its covariance, from the calibrations.
        change: Standard deviation of the random walk of the elements' logarithms [1/√pulse].
        adc_range: Voltages at which the converter saturates [V].
        driver_result: Verdict of the driver.
        electrodes: Number of electrodes.
        period: Length of a period [samples].
    """

    model: GainModel
    known: GivenDriver
    change: Float[Array, ""]
    adc_range: Float[Array, " 2"]
    driver_result: RESULTS
    electrodes: int = eqx.field(static=True)
    period: float = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        driver: Driver,
        unloaded: Recording,
        *,
        electrodes: int,
        circuit: AbstractCircuit | None = None,
        change: float = 0.0,
    ) -> "Tracker":
        """A tracker for one driver.

        Args:
            driver: Driver identified by maximum likelihood.
            unloaded: A recording whose `v_th` is the unloaded voltage, such as the calibration. Use
                several periods: they determine the aliases. The pulses must have its sample rate
                and pulse rate.
            electrodes: Number of electrodes.
            circuit: Structure of the load and its typical values; `SkinRC` if not given.
            change: Standard deviation of the change of the elements' logarithms from pulse to pulse
                (a random walk) [1/√pulse]; 0 for elements that do not change.

        Returns:
            The tracker. It does not change; its states hold the estimates.

        Raises:
            ValueError: The driver has no harmonics of its calibrations, or a number is too small.
            IdentificationError: The recording cannot be used; the message says why.
        """
        require_float64()
        driver = serving(driver, HarmonicDriver, str(MAXIMUM_LIKELIHOOD))
        if electrodes < 1:
            raise ValueError(f"electrodes is {electrodes}; a display has at least one electrode")
        if not (np.isfinite(change) and change >= 0):
            raise ValueError(f"change is {change}; it must be finite and not negative")
        seen = Inspected(unloaded)
        name = preflight(seen, periodic=True)
        if name is not None:
            text = f"unloaded recording {unloaded.path!r}: {name}. {explained(seen, name)}"
            raise IdentificationError(text, None)
        rate = unloaded.sample_rate
        period = rate / seen.train.counted
        bands = unloaded_bands(seen.v_th, float(seen.sigma_th), rate, period)
        known = known_at(bands.frequency, driver, False, MAXIMUM_LIKELIHOOD)
        low, high = unloaded.adc_range or (-np.inf, np.inf)
        half = seen.step_th / 2
        model = GainModel.of(
            circuit_of(circuit),
            bands,
            known.z_th(combined(known.mean, known.slope)),
            driver.source.response(rate - bands.frequency),
        )
        return cls(
            model=model,
            known=known,
            change=jnp.asarray(float(change)),
            adc_range=jnp.array([low + half, high - half]),
            driver_result=driver.result,
            electrodes=electrodes,
            period=period,
        )

    def _overview(self) -> Overview:
        kind, of_driver = type(self.model.circuit).__name__, verdict_names(self.driver_result)
        rows = [
            ("electrodes", str(self.electrodes), ""),
            ("period", f"{self.period:g}", "samples"),
            ("change", f"{float(self.change):g}", "1/√pulse"),
        ]
        return Overview(f"Tracker of {kind}, driver {of_driver}", rows)

    def start(self) -> TrackerState:
        """The state before the first pulse, without information."""
        lanes, elements = self.electrodes, len(self.model.circuit.names())
        typical = jnp.append(self.model.circuit.log_values(), 0.0)
        nan = jnp.full(lanes, jnp.nan)
        return TrackerState(
            own=jnp.broadcast_to(typical[None, :], (lanes, elements + 1)),
            information=jnp.zeros((lanes, elements, elements)),
            pulses=jnp.zeros(lanes, int),
            missed=jnp.zeros(lanes, int),
            damping=jnp.full(lanes, DAMPING),
            strain=jnp.zeros(lanes),
            variance=nan,
            chi2=nan,
            rrse=nan,
            result=jax.tree.map(jnp.asarray, verdicts_of(np.full(lanes, "too_short"))),
        )

    def pulses(
        self, v_out: Float[np.ndarray, "*lane time"]
    ) -> Float[np.ndarray, "pulse *lane sample"]:
        """Windows of one pulse each, cut from longer records.

        Args:
            v_out: Loaded voltages [V]. The records begin between two pulses.

        Returns:
            The windows [V]. Samples after the last whole window are left out.
        """
        return cut(v_out, self.period)

    def update(
        self, state: TrackerState, v_out: Float[Array | np.ndarray, "lane sample"]
    ) -> TrackerState:
        """The state after one more pulse.

        Args:
            state: State before this pulse; it does not change.
            v_out: Loaded voltage of one period at every electrode [V]. The windows begin between
                two pulses.

        Returns:
            State after this pulse.

        Raises:
            ValueError: `v_out` does not hold one window of one period for each electrode.
        """
        expected = (self.electrodes, self.model.bands.samples)
        if np.shape(v_out) != expected:
            raise ValueError(
                f"v_out has shape {np.shape(v_out)}; one period at each electrode has the shape "
                f"(electrode, sample) = {expected} (Tracker.pulses cuts longer records)"
            )
        return _updated(self, state, jnp.asarray(v_out, dtype=float))

    def read(self, state: TrackerState) -> Fits:
        """Elements, standard errors, χ² of the last pulse and verdict of every electrode.

        `steps` is the number of pulses that contribute to the elements. `shared_cov` is the part of
        the covariance that more pulses do not reduce. If the last pulse did not fit, the elements
        are those before it.

        Args:
            state: State of the tracker.

        Returns:
            One fit per electrode, in the order of the electrodes, with the label `electrode`.
        """
        fit = jax.tree.map(np.asarray, _judged(self, state))
        electrodes = [
            {"path": f"electrode/{number}", "electrode": str(number)}
            for number in range(self.electrodes)
        ]
        notes = np.array([message(name) for name in fit.verdict])
        return Fits(fit, described(electrodes), notes)


def _electrode(
    tracker: Tracker,
    state: TrackerState,
    gain: Complex[Array, " band"],
    variance: Float[Array, ""],
    bad: RESULTS,
    elsewhere: LoadUnknowns,
    distance: Float[Array, ""],
) -> TrackerState:
    """State of one electrode after one pulse.

    Args:
        tracker: The tracker.
        state: State of this electrode before the pulse.
        gain: Measured gain of the pulse.
        variance: E|noise|² of a Fourier coefficient of V_out [V²].
        bad: Verdict on the samples of the pulse.
        elsewhere: Nearest generic start: logarithms of the elements [SI] and delay [samples].
        distance: Distance of its gain from the measured gain.
    """
    before = LoadUnknowns.of(state.own)
    logs, elements = before.log_elements, before.log_elements.size
    running = state.pulses > 0
    lost = inverse_of_few(jnp.eye(elements) + tracker.change**2 * state.information)
    lost = state.information @ lost @ state.information
    information = state.information - tracker.change**2 * lost

    start, own_distance = nearest(tracker.model, gain, logs[None, :])
    away = ~running & ~(own_distance <= distance)
    start = jax.tree.map(lambda new, old: jnp.where(away, new, old), elsewhere, start)
    damping = jnp.where(away, DAMPING, state.damping)
    gain = gain - tracker.model.departure(start)
    pulse = Pulse(tracker.model, gain, variance, logs, information)
    own, at, decrement, damping = minimum(pulse.equations, start.vector(), damping)
    bands = tracker.model.bands
    selected = bands.weight > 0
    chi2 = at.squares / (2 * jnp.sum(selected, dtype=at.squares.dtype) - own.size)
    signal = jnp.sum(bands.weight * power(gain)) / variance
    rrse = jnp.sqrt(at.squares / signal)
    by_delay = at.curvature[:-1, -1]
    told = at.curvature[:-1, :-1] - jnp.outer(by_delay, by_delay) / at.curvature[-1, -1]
    spread = inverse_of_few(told)

    # χ² per element of the difference between the elements of this pulse alone and the prediction.
    found = LoadUnknowns.of(own)
    off = found.log_elements - logs
    pull = information @ off
    surprise = (jnp.dot(off, pull) + jnp.dot(pull, spread @ pull)) / elements
    share = 1 / jnp.clip(state.pulses, 1, MEMORY).astype(surprise.dtype)
    strain = state.strain + (surprise - state.strain) * share
    strained = running & (state.pulses >= MEMORY) & (strain > STRAINED)

    settled, late = decrement < SETTLED**2, jnp.abs(found.delay_samples) > DELAYS[-1]
    determined = running | jnp.all(jnp.diagonal(spread) < 1)
    result = first_verdict(
        (bad != SUCCESSFUL, bad),
        (~jnp.isfinite(own).all(), RESULTS.nonphysical),
        (~settled, MAX_STEPS_REACHED),
        (misses(chi2, rrse) | late | strained, RESULTS.misfit),
        (~determined, RESULTS.insensitive),
    )
    good = result == SUCCESSFUL
    missed = jnp.where(good, 0, state.missed + 1)
    again = running & ((missed >= PATIENCE) | strained)
    kept = good | ~running & jnp.isfinite(own).all() & (bad == SUCCESSFUL)
    return TrackerState(
        own=jnp.where(kept, own, state.own),
        information=jnp.where(again, 0.0, jnp.where(good, information + told, information)),
        pulses=jnp.where(again, 0, state.pulses + jnp.where(good, 1, 0)),
        missed=missed,
        damping=jnp.where(again, DAMPING, jnp.where(good, 0.0, damping)).astype(own.dtype),
        strain=jnp.where(again, 0.0, jnp.where(good & running, strain, state.strain)),
        variance=variance,
        chi2=chi2,
        rrse=rrse,
        result=result,
    )


@jax.jit  # `stored_jit` and `equinox.filter_jit` would cost a tenth of a tick at every call
def _updated(
    tracker: Tracker, state: TrackerState, v_out: Float[Array, "lane sample"]
) -> TrackerState:
    lowest, highest = v_out.min(axis=1), v_out.max(axis=1)  # NaN if a sample is NaN
    finite = jnp.isfinite(lowest) & jnp.isfinite(highest)
    clipped = (lowest <= tracker.adc_range[0]) | (highest >= tracker.adc_range[1])
    bands = tracker.model.bands
    gains = bands.measure(jnp.where(finite[:, None], v_out, 0.0))
    signal = power(gains.gain) @ bands.weight / gains.variance
    flat = signal < FLAT * 2 * jnp.sum(bands.weight > 0, dtype=float)
    bad = jax.vmap(
        lambda finite, clipped, flat: first_verdict(
            (~finite, RESULTS.nonfinite_samples), (clipped, RESULTS.saturated), (flat, RESULTS.flat)
        )
    )(finite, clipped, flat)
    starts = circuit_starts(tracker.model.circuit, None)
    lanes, elements = state.information.shape[:2]
    elsewhere = jax.lax.cond(
        (state.pulses == 0).any(),
        jax.vmap(lambda gain: nearest(tracker.model, gain, starts)),
        lambda _: (
            LoadUnknowns(jnp.zeros((lanes, elements)), jnp.zeros(lanes)),
            jnp.full(lanes, jnp.inf),
        ),
        gains.gain,
    )
    return jax.vmap(lambda *of: _electrode(tracker, *of))(state, *gains, bad, *elsewhere)


@stored_jit
def _judged(tracker: Tracker, state: TrackerState) -> Fit:
    return jax.vmap(lambda of: _fit(tracker, of))(state)


def _fit(tracker: Tracker, state: TrackerState) -> Fit:
    """The fit of one electrode."""
    known, bands = tracker.known, tracker.model.bands
    logs = LoadUnknowns.of(state.own).log_elements
    elements = logs.size
    model = tracker.model.undelayed(logs)
    pulse = Pulse(
        tracker.model, jnp.zeros_like(model), state.variance, logs, jnp.zeros((elements, elements))
    )
    jacobian = pulse.terms(state.own)[:-1]
    by_term = inverse(jacobian @ jacobian.T)[:elements] @ jacobian
    # Z_th + R = e^W, so that ∂G/∂W = −Z_L (Z_th + R) / (Z_L + Z_th)².
    z = tracker.model.circuit.with_log_values(logs).response(bands.frequency)
    admittance = reciprocal(z + tracker.model.source)
    weight = jnp.sqrt(bands.weight / state.variance)
    loaded = tracker.model.source + as_complex(known.resistance)
    by_w = as_complex(weight) * z * loaded * admittance * admittance
    by_z = by_w[None, :] * known.slope
    of_z = by_term @ jnp.concatenate([by_z.real, by_z.imag], axis=1).T
    # The noise of X is the same in every pulse. It enters Ĝ multiplied by G.
    of_x = jnp.tile(power(model) * bands.variance_x / state.variance, 2)
    shared = of_z @ known.cov @ of_z.T + (by_term * of_x[None, :]) @ by_term.T
    cov = inverse(state.information) + shared
    relative = jnp.sqrt(jnp.diagonal(cov))
    fitted = tracker.model.circuit.with_log_values(logs)
    scale = jnp.outer(fitted.values(), fitted.values())
    known_at_all = state.pulses > 0
    return Fit(
        circuit=fitted,
        cov=jnp.where(known_at_all, cov * scale, jnp.nan),
        shared_cov=jnp.where(known_at_all, shared * scale, jnp.nan),
        rrse=state.rrse,
        chi2=state.chi2,
        result=first_verdict(
            (state.result != SUCCESSFUL, state.result),
            (~jnp.all(relative < 1), RESULTS.insensitive),
            (tracker.driver_result != SUCCESSFUL, RESULTS.driver_failed),
        ),
        steps=state.pulses,
        method=METHOD,
    )
