"""Prediction of the terminal voltage of a recording from a driver and a circuit.

The Fourier coefficients describe a record of whole periods completely. The load acts on each
coefficient separately: Y = G X, G = Z_L / (Z_L + Z_th). This suffices for a constant phase, which
has no finite filter.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.estimators.estimator import serving
from etid.estimators.lanes import AlignedSamples
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.registry import OUTPUT_ERROR
from etid.identify.arguments import fed, given_circuit
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.inspection import Inspection
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
    # Disturbed periods are predicted too.
    seen, simulated = Inspected(Inspection([recording])), load.impedance().has_response
    if not load.is_rational and (seen.whole_periods[0] > 0 or not simulated):
        if isinstance(feed, ContinuousDriver):
            return _predict_periods(Inspected.of(recording), feed, load)
        OUTPUT_ERROR.check_circuit(load)
    inner = np.asarray(_fitted(jax.device_put(AlignedSamples.of(seen)), feed, load))
    predicted = np.full(recording.v_out.size, np.nan)
    first = TAPS - 1 + max(seen.lag, 0)
    predicted[first : first + inner.size] = inner
    return predicted


def _predict_periods(
    seen: Inspected, driver: ContinuousDriver, circuit: AbstractCircuit
) -> Float[np.ndarray, " time"]:
    recording, rate = seen.recording, seen.recording.sample_rate
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


def periodic_voltage(
    v_th: Float[np.ndarray, " time"],
    v_out: Float[np.ndarray, " time"],
    sample_rate: float,
    z_th: Complex[np.ndarray, " frequency"],
    z_load: Complex[np.ndarray, " frequency"],
    r_load: float,
) -> Float[np.ndarray, " time"]:
    """Terminal voltage [V] with a load, aligned with a record.

    The function fits the offset, the delay and the delay of the calibration. The delay of the
    calibration enters as an excess impedance (`prediction.late_calibration`).

    Args:
        v_th: Unloaded voltage [V], a whole number of periods.
        v_out: Loaded voltage [V].
        sample_rate: Samples per second [Hz].
        z_th: Source impedance [Ω] at `np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]`.
        z_load: Impedance of the load [Ω] at the same frequencies.
        r_load: Resistor of the calibration [Ω].
    """
    f = np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]
    samples = 2j * np.pi * f / sample_rate  # s times the sample interval
    x, y = np.fft.rfft(v_th)[1:], np.fft.rfft(v_out)[1:]
    excess = samples * (r_load - z_load)
    used = f < 0.4 * sample_rate  # above, anti-alias filters leave noise and aliases
    own = late = 0.0
    for _ in range(3):  # the first one leaves 1e-4 of two delays of 0.01 samples
        total = z_load + z_th + late * excess
        predicted = x * z_load / total * np.exp(-samples * own)
        slopes = np.stack([-samples * predicted, -excess / total * predicted], axis=1)[used]
        rest = (y - predicted)[used]
        matrix = np.concatenate([slopes.real, slopes.imag])
        step = np.linalg.lstsq(matrix, np.concatenate([rest.real, rest.imag]))[0]
        own, late = own + step[0], late + step[1]
    predicted = x * z_load / (z_load + z_th + late * excess) * np.exp(-samples * own)
    mean = v_out.sum()  # the coefficient of frequency 0: the offset is fitted
    return np.fft.irfft(np.append(mean, predicted), v_th.size)
