"""Prediction of the terminal voltage of a recording from a driver and a circuit."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.estimators.estimator import serving
from etid.estimators.lanes import AlignedSamples
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.registry import OUTPUT_ERROR
from etid.identify.arguments import fed, given_circuit
from etid.identify.steady_state import periodic_voltage
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import MeasuredCurrent
from etid.signals.filtering import TAPS


@program
def _fitted(
    samples: AlignedSamples, driver: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
) -> Float[Array, " interval"]:
    records = prediction.prepare(samples.measure(), cutoff=0.5)  # the whole band of the record
    load = circuit.impedance().in_time(records.sample_rate, records.hold.shape[0])
    return output_error.fitted_voltage(records, driver.source, driver.r_known, load)


@in_float64
def predict(
    recording: Recording, driver: Driver | None = None, circuit: AbstractCircuit | str | None = None
) -> Float[np.ndarray, " time"]:
    """Predict the terminal voltage [V] of a recording, for plots and residuals.

    The function fits the state at the start of the record and an offset to `recording.v_out`.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Driver with a continuous source impedance. Without a driver the voltage is predicted
            from the measured current.
        circuit: The load, or a circuit string. If not given, it is the known resistor of the
            calibration.

    Returns:
        Predicted voltage [V]. It is NaN at both edges, where the interpolation lacks neighbours.
        With a driver, a circuit that is not a ratio of polynomials in s, and whole periods, it is
        NaN only after the last whole period.

    Raises:
        ValueError: There is no circuit, or the driver has no continuous source impedance, or the
            response of the circuit in time is not known and the record holds no whole period.
    """
    recording, feed = fed(recording, driver)
    if circuit is not None:
        load = given_circuit("circuit", circuit)
    elif recording.r_load is not None:
        load = Resistor(recording.r_load)
    else:
        raise ValueError("give the circuit: this recording has no known resistor")
    if not isinstance(feed, MeasuredCurrent):
        feed = serving(feed, ContinuousDriver, str(OUTPUT_ERROR))
    seen, simulated = Inspected(recording), load.impedance().has_response
    if not load.is_rational and (seen.whole_periods[0] > 0 or not simulated):
        if isinstance(feed, ContinuousDriver):
            return _predict_periods(recording, feed, load)
        OUTPUT_ERROR.check_circuit(load)
    seen.kept = None  # disturbed periods are predicted too
    inner = np.asarray(_fitted(jax.device_put(AlignedSamples.of(seen)), feed, load))
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
            f"recording {recording.path!r} holds no whole pulse period; the voltage at "
            f"{type(circuit).__name__}, whose response in time is not known, is predicted for "
            "whole periods"
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
