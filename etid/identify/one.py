"""Identify a driver and a skin: pre-flight, baseline, refinement, verdict."""

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.estimators.maximum_likelihood import given_driver
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.registry import (
    HARMONIC,
    Method,
    check_default,
    check_driver,
    check_method,
    choose,
    plan,
    serving,
)
from etid.estimators.score_tests import resistors
from etid.estimators.score_tests.unloaded import shape_of
from etid.identify import changes
from etid.identify.arguments import circuit_of, order_of, recordings, require
from etid.identify.compiled import stored_jit
from etid.identify.lanes import (
    arrays,
    checksum,
    driver_of,
    explained,
    is_shared,
    known_driver,
    lane,
    late_by,
    needs_another,
    of_both,
    realigned,
    remarked,
    skin,
    skin_lane,
    stacked,
    without_mains,
)
from etid.identify.steady_state import periodic_voltage
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.recordings.repeats import repeats
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.results.fits import Fit, IdentificationError
from etid.results.verdicts import message, verdict
from etid.signals import mains
from etid.signals.filtering import TAPS
from etid.signals.harmonics import Spectrum, separates_aliases, spectrum, whole_periods
from etid.signals.measurement import measure, noise
from etid.signals.precision import require_float64

# |Z_th| [Ω] at 1 kHz: from a microphone's transformer to a tube's.
PLAUSIBLE = (300.0, 300e3)


def identify_driver(
    calibrations: Recording | Sequence[Recording],
    *,
    order: int = 5,
    method: Method | None = None,
    plausible: tuple[float, float] = PLAUSIBLE,
    driver_drift: float = 0.0,
    throw: bool = True,
) -> Driver:
    """Identify the source impedance Z_th from one or several records with known resistors.

    Args:
        calibrations: Recordings with `r_load`, of one length and sample rate.
        order: Number of poles of Z_th (the paper uses 5).
        method: `"maximum_likelihood"`, for records of several whole pulse periods, or
            `"output_error"`, or the paper's `"steiglitz_mcbride"`, or its first iteration
            `"equation_error"`. If not given, the first where the record allows it, else the second.
        plausible: Least and largest |Z_th| [Ω] at 1 kHz that is believed. The range spans a factor
            of 1000: no driver in it stays in it if `r_load` is given in kΩ.
        driver_drift: Relative standard deviation by which each parameter of Z_th may have changed
            until a skin is recorded. It enters the standard errors of the skins, as `shared_cov`.
        throw: Raise if the verdict is not successful.

    Returns:
        The driver, with its verdict.

    Raises:
        ValueError: No calibration, one without `r_load`, different lengths, or order below 2.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    check_method(method)
    order = order_of(order)
    single = isinstance(calibrations, Recording)
    records = recordings("calibrations", [calibrations] if single else calibrations)
    if not records:
        raise ValueError(
            "no calibration given; a driver needs at least one record with a known r_load"
        )
    resistances: list[float] = []
    for record in records:
        if record.r_load is None:
            raise ValueError(
                f"recording {record.path!r} has no r_load; a calibration needs its resistor [ohm]"
            )
        resistances.append(record.r_load)
    if not 0 <= driver_drift < 1:
        raise ValueError(f"driver_drift is {driver_drift}; it is a part, such as 0.01")
    if order < 2:
        raise ValueError(f"order is {order}; a source impedance needs at least order 2")
    sizes = {(record.v_th.size, record.sample_rate, record.pulse_rate) for record in records}
    if len(sizes) > 1:
        raise ValueError(
            f"calibrations differ in (samples, sample rate, pulse rate): {sorted(sizes)}; "
            "cut them to one length"
        )
    seen = [Inspected(record) for record in records]
    for one in seen:
        name = preflight(one, periodic=method in HARMONIC)
        if name is not None:
            text = f"calibration {one.recording.path!r}: {name}. {explained(one, name)}"
            raise IdentificationError(text, None)
    rough = [resistors.rough_impedance(*one) for one in zip(seen, resistances, strict=True)]
    if max(rough) > resistors.ROUGHLY * min(rough):
        shown = ", ".join(
            f"{one.recording.path!r} {z / 1e3:.3g} kohm" for one, z in zip(seen, rough, strict=True)
        )
        text = f"calibrations show impedances of about {shown}: resistors_disagree. "
        raise IdentificationError(text + message("resistors_disagree"), None)
    method = choose(method, seen)
    driver = _driver(seen, order, method)
    late = np.zeros(len(seen))
    if isinstance(driver, ContinuousDriver):
        late = np.asarray(driver.calibration.delay_samples)
    if driver.verdict != "successful" and 1 < np.max(np.abs(late)) < np.inf:
        for one, delay in zip(seen, late, strict=True):
            one.lag += round(delay)
        driver = _driver(seen, order, method)
    remarks = functools.reduce(operator.or_, (one.remarks for one in seen))
    driver = dataclasses.replace(driver, remarks=np.asarray(int(remarks) | int(driver.remarks)))
    if isinstance(driver, HarmonicDriver):
        unloaded = np.array([checksum(one) for one in seen])
        driver = dataclasses.replace(driver, unloaded=unloaded)
    if driver_drift and isinstance(driver, ContinuousDriver):
        driver = dataclasses.replace(driver, drift=np.asarray(driver_drift, float))
    driver = changes.driver_judged(driver, jnp.asarray(resistances), repeats(seen))
    size = float(jnp.abs(driver.response(jnp.asarray(1e3))))
    if np.isfinite(size) and not plausible[0] <= size <= plausible[1]:
        driver = dataclasses.replace(driver, result=verdict("implausible"))
    if throw and driver.verdict != "successful":
        raise IdentificationError(f"driver: {driver.verdict}. {message(driver.verdict)}", driver)
    return driver


def _driver(seen: Sequence[Inspected], order: int, method: Method) -> Driver:
    """The driver of calibrations that passed the pre-flight, aligned by their lags."""
    r_load = jnp.asarray([one.recording.r_load for one in seen])
    if method not in HARMONIC:
        samples = [arrays(one) for one in seen]
        size = min(v_th.size for v_th, *_ in samples)
        cut = [(v_th[:size], v_out[:size], *rest) for v_th, v_out, *rest in samples]
        return driver_of(stacked(cut), r_load, order, method, None)
    # Only starts are made from samples: of one length, so that the compiled function serves all.
    shortest = min(one.v_th.size for one in seen)  # periods of the others may be left out
    samples = [
        (one.v_th[:shortest], np.roll(one.v_out, -one.lag)[:shortest], *arrays(one)[2:])
        for one in seen
    ]
    lanes = [lane(one, method)[:-1] for one in seen]
    size = min(fields[0].size for fields in lanes)  # a pulse rate that is counted may cost one
    spectra = Spectrum(*stacked([tuple(field[:size] for field in fields) for fields in lanes]))
    records = stacked(samples)
    driver = driver_of(records, r_load, order, method, spectra)
    # A driver bends to hum on one harmonic, by a pole there, and then lacks another.
    if needs_another(driver) or driver.verdict != "successful":
        few = spectra.selected & ~mains.lines(spectra.frequency)
        spectra = dataclasses.replace(spectra, selected=few)
        driver = of_both(driver, driver_of(records, r_load, order, method, spectra))
    return driver


def failed_fit(name: str, circuit: AbstractCircuit, method: str) -> Fit:
    """A fit without numbers, for a recording that was stopped before it."""
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    none = changes.unknown(size)
    return Fit(
        *(empty, nan, nan, scalar, scalar, verdict(name), np.asarray(0), method),
        *(np.zeros((), int), none.size, none.stderr),
    )


def identify_skin(
    recording: Recording,
    driver: Driver,
    *,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
    throw: bool = True,
) -> Fit:
    """Identify what is connected to the driver in one recording.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Identified driver.
        circuit: Structure of the load and its typical values; `SkinRC` if not given.
        method: As in `identify_driver`, or `"non_parametric"` or `"harmonic_steiglitz_mcbride"`,
            whose drivers are those of maximum likelihood.
        throw: Raise if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict.

    Raises:
        ValueError: The driver cannot serve this method, or the method this circuit.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    require("recording", recording, Recording)
    require("driver", driver, Driver)
    circuit = circuit_of(circuit)
    check_method(method, circuit)
    seen = Inspected(recording)
    chosen, name = plan(method, seen, driver)
    if name is not None:
        fit = failed_fit(name, circuit, chosen)
    else:
        check_default(chosen, circuit)
        one = lane(seen, chosen)
        known = known_driver(one, driver, chosen, is_shared(seen, driver))
        fit = skin(tuple(map(jnp.asarray, one)), driver, known, circuit, chosen)
        late = late_by(one, chosen, fit, driver)
        if late:
            seen.lag += late
            one = realigned(one, chosen, late)
            fit = skin(tuple(map(jnp.asarray, one)), driver, known, circuit, chosen)
        few = without_mains(one, chosen)
        if needs_another(fit) and few is not None:
            fit = of_both(fit, skin(tuple(map(jnp.asarray, few)), driver, known, circuit, chosen))
        fit = remarked(fit, int(seen.remarks) | int(fit.remarks))
        [fit] = changes.judged([fit], driver, repeats([seen]))
    if throw and fit.verdict != "successful":
        why = explained(seen, "rate_mismatch") if fit.verdict == "rate_mismatch" else note(fit)
        text = f"recording {recording.path!r}: {fit.verdict}. {why}"
        raise IdentificationError(text, fit)
    return fit


def note(fit: Fit) -> str:
    """What the verdict of a fit means, and what changed if that is what it says."""
    text = message(fit.verdict)
    return f"{text} {fit.changes}" if fit.verdict == "changed" else text


def identify_samples(
    v_th: Float[Array, " time"],
    v_out: Float[Array, " time"],
    driver: Driver,
    *,
    sample_rate: float,
    pulse_rate: float,
    resolution: float = 0.0,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
) -> Fit:
    """`identify_skin` for bare arrays, to be transformed by `jax.grad`, `jax.jit` and `jax.vmap`.

    The elements are differentiable with respect to both records and to every number in `driver`,
    its resistors `driver.calibration.r_load` for instance, by implicit differentiation of the
    minimum: as accurate as the minimum itself, a thousandth of a standard error. There is no
    pre-flight, but there is a verdict.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        driver: Identified driver.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        resolution: Step of the converter [V] at the terminal, 0 if not known.
        circuit: As in `identify_skin`.
        method: As in `identify_driver`; if not given, maximum likelihood for several whole
            periods, else output error. Whether they begin between pulses is not looked at.

    Returns:
        Elements, standard errors and verdict, as arrays that JAX can trace.

    Raises:
        ValueError: The driver cannot serve this method, or the method this circuit.
    """
    require("driver", driver, Driver)
    circuit = circuit_of(circuit)
    check_method(method, circuit)
    periods = whole_periods(v_out.shape[0], sample_rate, pulse_rate)
    if method is None:
        fit_for = isinstance(driver, HarmonicDriver) and separates_aliases(*periods)
        method = "maximum_likelihood" if fit_for else "output_error"
        check_default(method, circuit)
    check_driver(driver, method, sample_rate)
    if method in HARMONIC and periods[0] == 0:
        raise ValueError(f"{v_out.shape[0]} samples hold no whole pulse period")
    step = jnp.asarray(resolution, dtype=v_out.dtype)
    rate = jnp.asarray(sample_rate, dtype=v_out.dtype)
    samples, known = (v_th, v_out, step, step, rate), None
    sigma_th, sigma_out = noise(v_th, step), noise(v_out, step)
    if method == "output_error":
        samples = (v_th, v_out, sigma_th, sigma_out, rate, jnp.asarray(v_out.shape[0]))
    if method in HARMONIC:
        fields = spectrum(v_th, v_out, sigma_th, sigma_out, rate, *periods)
        samples = (*map(jnp.asarray, fields), rate)
        if method == "maximum_likelihood":
            known = given_driver.given(serving(driver, HarmonicDriver, method), samples[0], True)
        else:
            known = shape_of(driver, samples[0])
    fit = skin_lane(samples, driver, known, circuit, method)
    return dataclasses.replace(fit, remarks=jnp.zeros_like(fit.remarks))  # nothing is left out


@stored_jit
def _fitted(
    samples: Any, driver: ContinuousDriver, circuit: AbstractCircuit
) -> Float[Array, " interval"]:
    records = prediction.prepare(measure(*samples), cutoff=0.5)  # the band as it was recorded
    r_load = driver.calibration.r_load[0]
    return output_error.fitted_voltage(
        records, driver.source, r_load, circuit.impedance().rational()
    )


def predict(
    recording: Recording, driver: Driver, circuit: AbstractCircuit | None = None
) -> Float[np.ndarray, " time"]:
    """Predict the terminal voltage [V] of a recording, for plots and residuals.

    The state at the start of the record and an offset are fitted to `recording.v_out`.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Driver with a continuous source impedance.
        circuit: The load; the known resistor of a calibration if not given.

    Returns:
        Predicted voltage [V]; NaN at both edges, where the interpolation lacks neighbours. With a
        constant-phase element, NaN after the last whole period.

    Raises:
        ValueError: There is no circuit, the driver cannot serve, or a circuit with a constant-phase
            element meets a record without a whole period.
    """
    require_float64()
    require("recording", recording, Recording)
    require("driver", driver, Driver)
    if circuit is not None:
        circuit = circuit_of(circuit)
    else:
        if recording.r_load is None:
            raise ValueError("give the circuit: this recording has no known resistor")
        circuit = Resistor(recording.r_load)
    driver = serving(driver, ContinuousDriver, "output_error")
    if not circuit.is_rational:
        return _predict_periods(recording, driver, circuit)
    seen = Inspected(recording)
    seen.kept = None  # disturbed periods are predicted too
    inner = np.asarray(_fitted(tuple(map(jnp.asarray, arrays(seen))), driver, circuit))
    predicted = np.full(recording.v_out.size, np.nan)
    first = TAPS - 1 + max(seen.lag, 0)
    predicted[first : first + inner.size] = inner
    return predicted


def _predict_periods(
    recording: Recording, driver: ContinuousDriver, circuit: AbstractCircuit
) -> Float[np.ndarray, " time"]:
    rate = recording.sample_rate
    seen = Inspected(recording)
    periods, samples = seen.whole_periods
    if periods == 0:
        raise ValueError(
            f"recording {recording.path!r} holds no whole pulse period; the voltage at a "
            f"constant-phase element, as in {type(circuit).__name__}, is predicted for whole ones"
        )
    frequency = jnp.asarray(np.fft.rfftfreq(samples, 1 / rate)[1:])
    predicted = np.full(recording.v_out.size, np.nan)
    aligned = periodic_voltage(
        recording.v_th[:samples],
        np.roll(recording.v_out[:samples], -seen.lag),
        rate,
        np.asarray(driver.source.response(frequency)),
        np.asarray(circuit.response(frequency)),
        float(driver.calibration.r_load[0]),
    )
    predicted[:samples] = np.roll(aligned, seen.lag)
    return predicted
