"""Identify a driver and a skin: pre-flight, baseline, refinement, verdict."""

import dataclasses
import zlib
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid import baseline, estimation, output_error, prediction, steiglitz_mcbride
from etid.circuits import AbstractCircuit, Resistor, SkinRC
from etid.driver import Driver
from etid.filtering import TAPS
from etid.given_driver import GivenDriver
from etid.measurement import measure, noise
from etid.precision import require_float64
from etid.preflight import is_periodic, preflight, recorded_periods, resolution
from etid.recording import Recording
from etid.results import Fit, IdentificationError
from etid.spectra import Spectrum, separates_aliases, spectrum, whole_periods
from etid.traces import stored_jit
from etid.verdicts import message, verdict

Method = Literal[
    "maximum_likelihood",
    "non_parametric",
    "output_error",
    "harmonic_steiglitz_mcbride",
    "steiglitz_mcbride",
    "equation_error",
]
METHODS: tuple[Method, ...] = (
    "maximum_likelihood",
    "non_parametric",
    "output_error",
    "harmonic_steiglitz_mcbride",
    "steiglitz_mcbride",
    "equation_error",
)
CALIBRATED = METHODS[:2]  # those that use the harmonics of the calibrations
REFINED = METHODS[:3]  # those for any circuit
CONTINUOUS = METHODS[:4]  # those that use a continuous source impedance
HARMONIC = (*CALIBRATED, METHODS[3])  # those on the harmonics of whole pulse periods
SAME_PULSE_RATE = 1e-3  # part by which rates may differ: Z_th is smooth


def _iterations(method: Method) -> int:
    return 1 if method == "equation_error" else steiglitz_mcbride.ITERATIONS


def check_method(method: str | None, circuit: AbstractCircuit | None = None) -> None:
    """Raise ValueError unless the method exists and can identify this circuit."""
    require_float64()
    if method is None:
        return
    if method not in METHODS:
        raise ValueError(f"method {method!r} is not known; use one of {', '.join(METHODS)}")
    if method not in REFINED and circuit is not None and not isinstance(circuit, SkinRC):
        raise ValueError(
            f"method {method!r} identifies SkinRC only, not {type(circuit).__name__}; "
            "use method='maximum_likelihood'"
        )


def has_harmonics(driver: Driver) -> bool:
    """Whether maximum likelihood can use this driver."""
    return driver.calibration is not None and driver.calibration.spectra is not None


def choose(method: Method | None, recordings: Sequence[Recording]) -> Method:
    """The method given, or else maximum likelihood if all records hold several whole periods.

    Where aliases cannot be told from harmonics, as in a single period, it would be biased by more
    than its errors say.
    """
    if method is not None:
        return method
    for recording in recordings:
        if not separates_aliases(*recorded_periods(recording)) or not is_periodic(recording):
            return "output_error"
    return "maximum_likelihood"


def _choose_for(method: Method | None, recording: Recording, driver: Driver) -> Method:
    """As `choose`, for a load that is identified with `driver`."""
    if method is None and not has_harmonics(driver):
        return "output_error"
    return choose(method, [recording])


def plan(given: Method | None, recording: Recording, driver: Driver) -> tuple[Method, str | None]:
    """The method for a load, and the verdict that forbids to fit it, if there is one.

    Raises:
        ValueError: The driver cannot serve the method.
    """
    name = preflight(recording, periodic=given in HARMONIC)
    if name is None:
        method = _choose_for(given, recording, driver)
    else:
        method = given or "output_error"
    check_driver(driver, method, recording.sample_rate)
    if method == "non_parametric":
        _check_pulse_rate(driver, recording)
    return method, name


def _check_pulse_rate(driver: Driver, recording: Recording) -> None:
    assert driver.calibration is not None  # check_driver
    assert driver.calibration.spectra is not None
    known = float(driver.calibration.spectra.frequency[0, 0])
    if not np.isclose(recording.pulse_rate, known, rtol=SAME_PULSE_RATE):
        raise ValueError(
            f"non_parametric knows Z_th at harmonics of {known:.6g} Hz only, but the recording has "
            f"{recording.pulse_rate:.6g} Hz; use method='maximum_likelihood'"
        )


def check_driver(driver: Driver, method: Method, sample_rate: float) -> None:
    """Raise ValueError if `driver` cannot serve `method` at `sample_rate` [Hz]."""
    if method in CONTINUOUS and driver.source is None:
        raise ValueError(
            f"this driver was identified by {driver.method}, which gives no continuous source "
            f"impedance; identify it with method={method!r}"
        )
    if method in CALIBRATED and not has_harmonics(driver):
        raise ValueError(
            f"this driver was identified by {driver.method}, which keeps no harmonics of its "
            "calibrations; identify it with method='maximum_likelihood'"
        )
    if method not in CONTINUOUS and not np.isclose(float(driver.sample_rate), sample_rate):
        raise ValueError(
            f"{method} needs recording and calibration at one sample rate, but the recording has "
            f"{sample_rate:g} Hz and the driver {float(driver.sample_rate):g} Hz; "
            "use method='output_error'"
        )


def arrays(recording: Recording) -> tuple[np.ndarray, ...]:
    """Both voltages, both resolutions, and the sample rate."""
    return (
        recording.v_th,
        recording.v_out,
        np.asarray(resolution(recording, "v_th")),
        np.asarray(resolution(recording, "v_out")),
        np.asarray(recording.sample_rate),
    )


def lane(recording: Recording, method: Method) -> tuple[np.ndarray, ...]:
    """What is fitted of a recording: its harmonics and their noise, or its samples.

    The harmonics are evaluated without JAX, which would compile for every length of a record.
    """
    if method not in HARMONIC:
        return arrays(recording)
    v_th, v_out, step_th, step_out, rate = arrays(recording)
    sigma_th, sigma_out = noise(v_th, step_th), noise(v_out, step_out)
    periods = recorded_periods(recording)
    fields = spectrum(v_th, v_out, sigma_th, sigma_out, rate, *periods)
    return *map(np.asarray, fields), rate


def stacked(lanes: Sequence[tuple[np.ndarray, ...]]) -> tuple[Array, ...]:
    """Lanes of equal shapes along a leading axis."""
    return tuple(jnp.asarray(np.stack(column)) for column in zip(*lanes, strict=True))


def checksum(recording: Recording) -> int:
    """What tells an unloaded record from others."""
    return zlib.crc32(recording.v_th.tobytes())


def is_shared(recording: Recording, driver: Driver) -> bool:
    """Whether the unloaded record of a recording may be that of a calibration."""
    known = None if driver.calibration is None else driver.calibration.unloaded
    return known is None or checksum(recording) in known


@stored_jit
def _driver(
    samples: Any,
    r_load: Float[Array, " record"],
    order: int,
    method: Method,
    spectra: Spectrum | None,
) -> Driver:
    m = jax.vmap(measure)(*samples)
    if method in CONTINUOUS:
        return estimation.driver_by_refinement(m, r_load, order, spectra)
    return baseline.driver_by_steiglitz_mcbride(m, r_load, order, _iterations(method))


@stored_jit
def given(driver: Driver, frequency: Float[Array, " harmonic"], shared: bool) -> GivenDriver:
    """What all loads of a driver need to know of it for maximum likelihood."""
    return estimation.given(driver, frequency, shared)


def known_driver(
    lane: tuple[np.ndarray, ...], driver: Driver, method: Method, shared: bool
) -> GivenDriver | None:
    """`given`, if the method needs it, for this lane and all with harmonics like it."""
    if method != "maximum_likelihood":
        return None
    return given(driver, jnp.asarray(lane[0]), shared)


def skin_lane(
    lane: Any,
    driver: Driver,
    known: GivenDriver | None,
    circuit: AbstractCircuit,
    method: Method,
) -> Fit:
    """Identify one lane; differentiable code, to be jitted and batched by the caller."""
    if method not in HARMONIC:
        m = measure(*lane)
        if method == "output_error":
            return estimation.skin_by_output_error(m, driver, circuit)
        return baseline.skin_by_steiglitz_mcbride(m, driver, _iterations(method))
    *fields, rate = lane
    spectrum = Spectrum(*fields)
    if method == "harmonic_steiglitz_mcbride":
        return baseline.skin_by_harmonic_steiglitz_mcbride(spectrum, rate, driver)
    if known is None:
        return estimation.skin_by_non_parametric(spectrum, rate, driver, circuit)
    return estimation.skin_by_maximum_likelihood(spectrum, rate, driver, known, circuit)


_skin = stored_jit(skin_lane)


def identify_driver(
    calibrations: Recording | Sequence[Recording],
    *,
    order: int = 5,
    method: Method | None = None,
    throw: bool = True,
) -> Driver:
    """Identify the source impedance Z_th from one or several records with known resistors.

    Args:
        calibrations: Recordings with `r_load`, of one length and sample rate.
        order: Number of poles of Z_th (the paper uses 5).
        method: `"maximum_likelihood"`, for records of several whole pulse periods, or
            `"output_error"`, or the paper's `"steiglitz_mcbride"`, or its first iteration
            `"equation_error"`. If not given, the first where the record allows it, else the second.
        throw: Raise if the verdict is not successful.

    Returns:
        The driver, with its verdict.

    Raises:
        ValueError: No calibration, one without `r_load`, different lengths, or order below 2.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    check_method(method)
    records = [calibrations] if isinstance(calibrations, Recording) else list(calibrations)
    if not records:
        raise ValueError(
            "no calibration given; a driver needs at least one record with a known r_load"
        )
    for record in records:
        if record.r_load is None:
            raise ValueError(
                f"recording {record.path!r} has no r_load; a calibration needs its resistor [ohm]"
            )
    if order < 2:
        raise ValueError(f"order is {order}; a source impedance needs at least order 2")
    sizes = {(record.v_th.size, record.sample_rate, record.pulse_rate) for record in records}
    if len(sizes) > 1:
        raise ValueError(
            f"calibrations differ in (samples, sample rate, pulse rate): {sorted(sizes)}; "
            "cut them to one length"
        )
    for record in records:
        name = preflight(record, periodic=method in HARMONIC)
        if name is not None:
            text = f"calibration {record.path!r}: {name}. {message(name)}"
            raise IdentificationError(text, None)
    method = choose(method, records)
    r_load = jnp.asarray([record.r_load for record in records])
    spectra = None
    if method in HARMONIC:
        *fields, _ = stacked([lane(record, method) for record in records])
        spectra = Spectrum(*fields)
    driver = _driver(stacked(list(map(arrays, records))), r_load, order, method, spectra)
    if driver.calibration is not None:
        unloaded = np.array([checksum(record) for record in records])
        calibration = dataclasses.replace(driver.calibration, unloaded=unloaded)
        driver = dataclasses.replace(driver, calibration=calibration)
    if throw and driver.verdict != "successful":
        raise IdentificationError(f"driver: {driver.verdict}. {message(driver.verdict)}", driver)
    return driver


def failed_fit(name: str, circuit: AbstractCircuit, method: str) -> Fit:
    """A fit without numbers, for a recording that was stopped before it."""
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    return Fit(empty, nan, nan, scalar, scalar, verdict(name), np.asarray(0), method)


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
    circuit = SkinRC() if circuit is None else circuit
    check_method(method, circuit)
    chosen, name = plan(method, recording, driver)
    if name is not None:
        fit = failed_fit(name, circuit, chosen)
    else:
        one = lane(recording, chosen)
        known = known_driver(one, driver, chosen, is_shared(recording, driver))
        fit = _skin(tuple(map(jnp.asarray, one)), driver, known, circuit, chosen)
    if throw and fit.verdict != "successful":
        text = f"recording {recording.path!r}: {fit.verdict}. {message(fit.verdict)}"
        raise IdentificationError(text, fit)
    return fit


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

    Raises:
        ValueError: The driver cannot serve this method, or the method this circuit.
    """
    circuit = SkinRC() if circuit is None else circuit
    check_method(method, circuit)
    periods = whole_periods(v_out.shape[0], sample_rate, pulse_rate)
    if method is None:
        fit_for = has_harmonics(driver) and separates_aliases(*periods)
        method = "maximum_likelihood" if fit_for else "output_error"
    check_driver(driver, method, sample_rate)
    if method in HARMONIC and periods[0] == 0:
        raise ValueError(f"{v_out.shape[0]} samples hold no whole pulse period")
    step = jnp.asarray(resolution, dtype=v_out.dtype)
    rate = jnp.asarray(sample_rate, dtype=v_out.dtype)
    samples, known = (v_th, v_out, step, step, rate), None
    if method in HARMONIC:
        sigma_th, sigma_out = noise(v_th, step), noise(v_out, step)
        fields = spectrum(v_th, v_out, sigma_th, sigma_out, rate, *periods)
        samples = (*map(jnp.asarray, fields), rate)
        if method == "maximum_likelihood":
            known = estimation.given(driver, samples[0], True)
    return skin_lane(samples, driver, known, circuit, method)


@stored_jit
def _fitted(samples: Any, driver: Driver, circuit: AbstractCircuit) -> Float[Array, " interval"]:
    records = prediction.prepare(measure(*samples), cutoff=0.5)  # the band as it was recorded
    assert driver.source is not None
    assert driver.calibration is not None
    r_load = driver.calibration.r_load[0]
    return output_error.fitted_voltage(records, driver.source, r_load, circuit.impedance())


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
        Predicted voltage; NaN at both edges, where the interpolation lacks neighbours.
    """
    require_float64()
    if circuit is None:
        if recording.r_load is None:
            raise ValueError("give the circuit: this recording has no known resistor")
        circuit = Resistor(recording.r_load)
    check_driver(driver, "output_error", recording.sample_rate)
    inner = np.asarray(_fitted(tuple(map(jnp.asarray, arrays(recording))), driver, circuit))
    predicted = np.full(recording.v_out.size, np.nan)
    predicted[TAPS - 1 : TAPS - 1 + inner.size] = inner
    return predicted
