"""A recorded model cell: a voltage step into R_s + R_p‖C_p, the current through a Bessel filter.

The circuit is that of the skin, measured the other way round and by somebody else's instrument. The
maker states R_p = 500 MΩ within 1 % and C_p = 33 pF within 10 %.
"""

from typing import Any

import equinox as eqx
import h5py
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.signal

import etid
from etid.circuits.circuit import SkinRC
from etid.circuits.impedance import realise
from etid.signals.filtering import StateSpace, hold, simulate
from etid.signals.transfer import Rational, multiply_polynomials
from etid.solvers.levenberg_marquardt import LevenbergMarquardt

SAMPLE_RATE = 20e3  # [Hz]
RATE = 1e4  # [1/s], typical of the filter
PICO = 1e-12  # of an ampere
STEP = 10e-3  # [V]

# Four poles of Bessel's filter, −3 dB at 1 rad/s, in descending powers of s.
BESSEL: Any = scipy.signal.bessel(4, 1.0, analog=True, norm="mag")
NUM, DEN = BESSEL

# What a manual would suggest for a patched cell and its amplifier; each is wrong by 1.5 to 5 times.
# Series, membrane, capacitance, corner of the recorder [Hz], delay [samples], holding current [pA].
START = (SkinRC(30e6, 150e6, 100e-12), 3000.0, 0.5, 0.0)


@pytest.fixture(scope="module")
def recorded(reference_data):
    with h5py.File(reference_data("patch_clamp_model_cell") / "model_vc_step.h5") as file:
        assert file.attrs["sampling_rate_hz"] == SAMPLE_RATE
        current = np.asarray(file["current_pA"], dtype=float)
        command = np.asarray(file["command_mV"], dtype=float)[0]
    steps = np.flatnonzero(np.diff(command)) + 1
    assert list(np.diff(command)[steps - 1]) == [-1e3 * STEP, 1e3 * STEP]
    # The floor comes from the scatter between sweeps, which knows no model.
    floor = float(np.sqrt(current.var(axis=0, ddof=1).mean() / current.shape[0]))
    return current.mean(axis=0), steps, floor


def predicted_current(kind, parameters, steps, time):
    """Current [pA]; the command is constant between its steps, so a hold of order zero is exact."""
    *elements, log_corner, delay, holding = parameters
    circuit = kind.with_log_values(jnp.stack(elements))
    omega = 2 * jnp.pi * jnp.exp(log_corner)
    scale = omega ** -jnp.arange(5.0)
    den = jnp.asarray(DEN[::-1].copy()) * scale
    z = circuit.impedance().rational()
    admittance = Rational(z.den * NUM[0], multiply_polynomials(z.num, den))
    system = realise(admittance, RATE)
    # The first column of `hold` is the response to a constant. A step that comes `delay` after a
    # sample acts for the rest of that interval, then for whole ones.
    whole = hold(system, SAMPLE_RATE)
    first = hold(system, SAMPLE_RATE / (1 - delay))
    columns = jnp.stack([whole.B[:, 0], first.B[:, 0]], axis=-1)
    discrete = StateSpace(whole.A, columns, system.C, jnp.zeros(2))
    n = np.arange(time)
    held = STEP * ((n > steps[1]).astype(float) - (n > steps[0]))
    kick = STEP * ((n == steps[1]).astype(float) - (n == steps[0]))
    current, _ = simulate(discrete, jnp.stack([held, kick], axis=-1), jnp.zeros_like(system.C))
    return current / PICO + holding


@eqx.filter_jit
def fit(kind, measured, steps, start):
    solver = LevenbergMarquardt(rtol=1e-6, ftol=0.0)

    def residual(parameters, _):
        return predicted_current(kind, parameters, steps, measured.size) - measured

    return optx.least_squares(residual, solver, start, max_steps=200, throw=False)


def test_the_model_cell_is_what_its_maker_says(recorded):
    measured, steps, floor = recorded
    circuit, corner, delay, holding = START
    start = jnp.array([*circuit.log_values(), jnp.log(corner), delay, holding])
    solution = fit(circuit, jnp.asarray(measured), tuple(int(k) for k in steps), start)
    assert solution.result == optx.RESULTS.successful
    found = circuit.with_log_values(solution.value[:3])
    assert abs(float(found.r_p) / 500e6 - 1) < 0.01  # the maker's tolerance
    assert abs(float(found.c_p) / 33e-12 - 1) < 0.10  # likewise
    # The telegraphed corner is nominal; a 10 % resistor or capacitor sets the real one.
    assert abs(float(jnp.exp(solution.value[3])) / 2000 - 1) < 0.10
    # The two steps change by 5 % the scatter of 10 000 samples at most: nothing is left to explain.
    rms = np.sqrt(2 * float(solution.stats["normal_equations"].objective) / measured.size)
    assert rms < 1.05 * floor


def test_a_recording_of_its_current_is_identified(recorded):
    """The command passes the same filter as the current, so that it cancels out."""
    measured, steps, _ = recorded
    poles = 2 * np.pi * 2e3 * np.roots(DEN)
    t = np.arange(measured.size) / SAMPLE_RATE
    shares = [
        1 / np.prod([1 - p / other for other in poles if other != p], dtype=complex) for p in poles
    ]

    def response(since):  # to a unit step
        late = np.maximum(since, 0.0)
        return 1 - sum(c * np.exp(p * late) for c, p in zip(shares, poles, strict=True)).real

    first, second = steps / SAMPLE_RATE
    voltage = STEP * (response(t - second) - response(t - first))
    recording = etid.Recording(
        v_out=voltage,
        current=PICO * measured,
        sample_rate=SAMPLE_RATE,
        pulse_rate=SAMPLE_RATE / t.size,
    )
    fit = etid.identify_skin(recording, method="output_error", throw=False)
    assert abs(float(fit.circuit.r_p) / 500e6 - 1) < 0.01  # the maker's tolerances
    assert abs(float(fit.circuit.c_p) / 33e-12 - 1) < 0.10
    assert fit.verdict == "misfit"
    assert fit.rrse < 0.002  # the corner is 5 % off its nominal value
