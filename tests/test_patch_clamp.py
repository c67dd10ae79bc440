"""A recorded model cell: a voltage step into R_s + R_p‖C_p, the current through a Bessel filter.

The circuit is that of the skin, measured the other way round and by somebody else's instrument. The
maker states R_p = 500 MΩ within 1 % and C_p = 33 pF within 10 %.
"""

from typing import Any

import h5py
import numpy as np
import pytest
import scipy.signal

import etid

SAMPLE_RATE = 20e3  # [Hz]
PICO = 1e-12  # of an ampere
STEP = 10e-3  # [V]

# Four poles of Bessel's filter, −3 dB at 1 rad/s, in descending powers of s.
BESSEL: Any = scipy.signal.bessel(4, 1.0, analog=True, norm="mag")
DEN = BESSEL[1]


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
    fit = etid.identify_skin(recording, throw=False)
    assert abs(float(fit.circuit.r_p) / 500e6 - 1) < 0.01  # the maker's tolerances
    assert abs(float(fit.circuit.c_p) / 33e-12 - 1) < 0.10
    assert fit.verdict == "misfit"
    assert fit.rrse < 0.002  # the corner is 5 % off its nominal value
