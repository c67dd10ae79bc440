"""Prediction of the terminal voltage of a recording from a driver and a circuit.

The Fourier coefficients describe a record of whole periods completely. The load acts on each
coefficient separately: Y = G X, G = Z_L / (Z_L + Z_th). This suffices for a constant phase, which
has no finite filter.

Other records are simulated in time (`etid.signals.filtering`), with a state at their start that is
fitted. Both ways fit the trigger delay of V_out and that of the calibration. A calibration with R_L
that is late by τ yields Z_th + sτ (R_L + Z_th) in place of Z_th. A load Z_L then has the total

    Z_L + Z_th + sτ (R_L + Z_th) = (1 + sτ) (Z_L + Z_th) + sτ (R_L − Z_L).

The first part is a delay, which that of V_out absorbs. The second is an excess impedance.
"""

import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.circuits.impedance import realise
from etid.estimators.estimator import serving
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import check_no_filters, fed, given_circuit
from etid.precision import array_function, held, in_float64, namespace, one_thread, untraced
from etid.recordings.inspection import Inspection
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import MeasuredCurrent, SourceImpedance
from etid.signals.filtering import TAPS, StateSpace, band_limited, hold, shiftable, simulate
from etid.signals.transfer import AnyArray

PASSES = 3  # the first one leaves 1e-4 of two delays of 0.01 samples
EPS = float(np.finfo(float).eps)
WHOLE = 0.5  # cutoff of the interpolation: the whole band of the record


@in_float64
@one_thread()
def predict(
    recording: Recording, driver: Driver | None = None, circuit: AbstractCircuit | str | None = None
) -> Float[AnyArray, " time"]:
    """Predict the terminal voltage [V] of a recording, for plots and residuals.

    The function fits the state at the start of the record and an offset to `recording.v_out`. JAX
    can differentiate it by the elements of the circuit, and by the numbers of `driver.source`;
    `driver.b` and `driver.a` describe the same Z_th and are not used.

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
    check_no_filters(recording, "a prediction in time")
    if circuit is not None:
        load = given_circuit("circuit", circuit)
    elif recording.r_load is not None:
        load = Resistor(recording.r_load)
    else:
        raise ValueError("give the circuit: this recording has no known resistor")
    if not isinstance(feed, MeasuredCurrent):
        feed = untraced(serving(feed, ContinuousDriver, MAXIMUM_LIKELIHOOD.name))
    # Disturbed periods are predicted too.
    seen, simulated = Inspected(Inspection([recording])), load.impedance().has_response
    simple = load.is_rational and not (isinstance(feed, Driver) and feed.inexact)
    periodic = seen.whole_periods[0] > 0 and not seen.is_held
    if not simple and (periodic or not simulated):
        if not seen.is_held and isinstance(feed, ContinuousDriver):
            return _predict_periods(Inspected.of(recording), feed, load)
        if not simulated:
            raise ValueError(
                f"the response in time of {type(load).__name__} is not known, so no voltage is "
                "predicted from a measured current; use a ratio of polynomials in s or constant "
                "phases"
            )
    of = *seen.aligned, recording.sample_rate, feed, untraced(load), seen.is_held
    inner = fitted_voltage(*of)
    first = TAPS - 1 + max(seen.lag, 0)
    edges = first, recording.v_out.size - first - inner.size
    return namespace(inner).pad(inner, edges, constant_values=np.nan)


def _predict_periods(
    seen: Inspected, driver: ContinuousDriver, circuit: AbstractCircuit
) -> Float[AnyArray, " time"]:
    recording, rate = seen.recording, seen.recording.sample_rate
    periods, samples = seen.whole_periods
    if periods == 0:
        raise ValueError(
            f"recording {recording.path!r} holds no whole pulse period; the voltage at "
            f"{type(circuit).__name__}, whose response in time is not known, is predicted for "
            "whole periods"
        )
    frequency = np.fft.rfftfreq(samples, 1 / rate)[1:]
    aligned = periodic_voltage(
        recording.v_th[:samples],
        np.roll(recording.v_out[:samples], -seen.lag),
        rate,
        driver.source.response(frequency),
        circuit.response(frequency),
        untraced(driver.calibration.r_load[0]),
    )
    xp, after = namespace(aligned), recording.v_out.size - samples
    return xp.pad(xp.roll(aligned, seen.lag), (0, after), constant_values=np.nan)


@array_function
def fitted_voltage(
    v_th: Float[np.ndarray, " time"],
    v_out: Float[np.ndarray, " time"],
    sample_rate: float,
    feed: ContinuousDriver | MeasuredCurrent,
    circuit: AbstractCircuit,
    held: bool = False,
) -> Float[AnyArray, " interval"]:
    """Terminal voltage [V] with a load, fitted to an aligned record, without its edges.

    The unknowns are the state at the start, the offset, the delay, and that of the calibration.

    Args:
        v_th: Unloaded voltage [V], or the measured current [A].
        v_out: Loaded voltage [V].
        sample_rate: Samples per second [Hz].
        feed: The driver, or the measured current.
        circuit: The load.
        held: Whether a converter holds the input between its samples. There is no delay then.
    """
    inputs, delayed = band_limited(v_th, WHOLE), shiftable(v_out, WHOLE)
    if held:
        inner = slice(TAPS - 1, TAPS - 1 + inputs.shape[0])
        inputs = np.pad(v_th[inner, None], ((0, 0), (0, inputs.shape[1] - 1)))
        delayed = v_out[inner, None]
    load = circuit.impedance()
    load = load.in_time(sample_rate, inputs.shape[0])
    load = load if isinstance(load, StateSpace) else realise(load, sample_rate)
    loop = feed.source.connected(load)
    xp, states, system = namespace(loop.A, loop.C), loop.C.size, hold(loop, sample_rate)
    forced = simulate(system, inputs, np.zeros(states))[0]
    alone = StateSpace(system.A, np.zeros((states, 0)), system.C, np.zeros(0))
    free = simulate(alone, np.zeros((forced.size, 0)), np.eye(states))[0]
    known, late = [*free, xp.ones_like(forced)], None  # a measured current has no calibration
    if isinstance(feed.source, SourceImpedance):
        late = hold(
            _delayed_calibration(feed.source, load, loop, untraced(feed.r_known)), sample_rate
        )
    degrees, powers = np.arange(1.0, inputs.shape[1]), np.arange(1.0, delayed.shape[1])
    rates = np.pad(inputs[:, 1:] * degrees, ((0, 0), (0, 1)))  # per sample

    def residual(q: Float[AnyArray, " q"]) -> Float[AnyArray, " interval"]:
        linear = sum(of * by for of, by in zip(q[1:], columns, strict=True))
        return forced + linear - xp.polyval(delayed[:, ::-1].T, -q[0])

    # The residual is linear except in the delay, which is a small fraction of a sample, and in the
    # state in the effect of a late calibration. This is that of the pass before: with a free state
    # that decays within a sample, times this delay, the first sample could be any voltage.
    q, columns = xp.zeros(1 + len(known) + (late is not None)), known
    for _ in range(PASSES):
        if late is not None:
            flow = (loop.A @ q[1 : states + 1] + loop.B[:, 0] * inputs[0, 0]) / sample_rate
            columns = [*known, simulate(late, rates, xp.pad(flow, (0, states)))[0]]
        by_delay = 0.0 * forced
        if not held:
            by_delay = xp.polyval((delayed[:, 1:] * powers)[:, ::-1].T, -q[0])
        q = q - _solved(xp.stack([by_delay, *columns], axis=1), residual(q))
    return residual(q) + delayed[:, 0]


def _solved(
    basis: Float[AnyArray, "row q"], rest: Float[AnyArray, " row"]
) -> Float[AnyArray, " q"]:
    """Least squares. A record may not determine all states of a ladder.

    With B⁺ and what is left held, this has the derivative of B⁺ r (Golub and Pereyra 1973), also
    where singular values are equal or 0.
    """
    inverse, q, left = _least_squares(basis, rest)
    return q + inverse @ (rest - basis @ q) + inverse @ (inverse.T @ (basis.T @ left))


@held
def _least_squares(
    basis: Float[AnyArray, "row q"], rest: Float[AnyArray, " row"]
) -> tuple[Float[AnyArray, "q row"], Float[AnyArray, " q"], Float[AnyArray, " row"]]:
    """B⁺, the solution, and what it leaves; NaN if a number is not finite."""
    xp = namespace(basis)
    finite = xp.isfinite(basis).all() & xp.isfinite(rest).all()
    inverse = xp.linalg.pinv(xp.where(finite, basis, 0.0), rtol=EPS * rest.size)
    q = xp.where(finite, inverse @ rest, np.nan)
    return inverse, q, rest - basis @ q


def _delayed_calibration(
    source: SourceImpedance, load: StateSpace, loop: StateSpace, r_load: Float[AnyArray, ""]
) -> StateSpace:
    """From the rate of V_th to V_out by a late calibration; the delays of V_out belong to it too.

    The voltage R_L I − V_out at the excess impedance acts as one more V_th.

    Args:
        source: The driver.
        load: The load.
        loop: Both, from V_th to V_out.
        r_load: R_L, the resistor of the calibration [Ω].
    """
    xp, states, of_source = namespace(loop.A, loop.C), loop.C.size, source.state_space()
    flow = r_load / (of_source.D + load.D)
    C = -flow * xp.concatenate([of_source.C, load.C]) - loop.C
    D = flow - loop.D
    first, second = xp.pad(loop.A, ((0, 0), (0, states))), [loop.B * C, loop.A]
    return StateSpace(
        xp.concatenate([first, xp.concatenate(second, axis=1)]),
        xp.concatenate([loop.B, loop.B * D]),
        xp.concatenate([loop.C + loop.D * C, loop.C]),
        loop.D + loop.D * D,
    )


@array_function
def periodic_voltage(
    v_th: Float[np.ndarray, " time"],
    v_out: Float[np.ndarray, " time"],
    sample_rate: float,
    z_th: Complex[AnyArray, " frequency"],
    z_load: Complex[AnyArray, " frequency"],
    r_load: float | Float[AnyArray, ""],
) -> Float[AnyArray, " time"]:
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
    xp, f = namespace(z_th, z_load), np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]
    samples = 2j * np.pi * f / sample_rate  # s times the sample interval
    x, y = np.fft.rfft(v_th)[1:], np.fft.rfft(v_out)[1:]
    excess = samples * (r_load - z_load)
    used = f < 0.4 * sample_rate  # above, anti-alias filters leave noise and aliases
    delays = xp.zeros(2)

    def predicted() -> Complex[AnyArray, " frequency"]:
        own, late = delays
        return x * z_load / (z_load + z_th + late * excess) * xp.exp(-samples * own)

    for _ in range(PASSES):
        reached = predicted()
        by_late = -excess / (z_load + z_th + delays[1] * excess) * reached
        slopes = xp.stack([-samples * reached, by_late], axis=1)[used]
        matrix, rest = xp.concatenate([slopes.real, slopes.imag]), (y - reached)[used]
        delays = delays + _solved(matrix, xp.concatenate([rest.real, rest.imag]))
    mean = v_out.sum()  # the coefficient of frequency 0: the offset is fitted
    return xp.fft.irfft(xp.append(mean, predicted()), v_th.size)
