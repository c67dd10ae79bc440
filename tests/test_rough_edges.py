"""A current that was commanded, whose edges are not where its samples say: no smooth error."""

import numpy as np
import pytest

import etid
from benchmarks.real import tissue_recordings

RATE, SAMPLES = 24_414.0, 400
EDGES, STEPS = np.array([65.0, 94.0, 123.0]), np.array([1.0, -2.0, 1.0])
COLE = etid.SkinCole(r_s=1.2e3, r_p=15e3, tau=12e-3, alpha=0.88)
RC = etid.SkinRC(r_s=1.2e3, r_p=9e3, c_p=0.6e-6)


def staircase(edges):
    """Its Fourier coefficients behind a filter, of 1 mA."""
    f = np.fft.rfftfreq(SAMPLES)[1:-1]
    lines = 1e-3 * STEPS @ np.exp(-2j * np.pi * np.outer(edges, f)) / (2j * np.pi * f)
    return np.fft.rfftfreq(SAMPLES, 1 / RATE)[1:-1], lines / (1 + (f / 0.3) ** 12)


def commanded(skin, number, late):
    """One pulse at 60 dB; its edges are up to `late` samples beside those of the command."""
    rng = np.random.default_rng([number, *b"edges"])
    f, lines = staircase(EDGES + rng.uniform(-late, late, EDGES.size))
    v_out = np.fft.irfft(np.pad(lines * np.asarray(skin.response(f)), 1), SAMPLES)
    v_out = v_out + 1e-3 * v_out.std() * rng.standard_normal(SAMPLES)
    current = np.fft.irfft(np.pad(staircase(EDGES)[1], 1), SAMPLES)
    return etid.Recording(v_out=v_out, current=current, sample_rate=RATE, pulse_rate=RATE / SAMPLES)


@pytest.mark.parametrize("late", [0.1, 0.2])
@pytest.mark.parametrize(("skin", "bounded"), [(COLE, COLE.names()), (RC, ("r_s", "c_p"))])
def test_the_circuit_is_good_to_the_rest_and_errors_contain_it(skin, bounded, late):
    """The edges of such a pulse say how much charge it leaves, on which R_p behind one C_p rests.

    Its errors are up to five of its ±, as `docs/inexact.md` says; all others are within 3.3, which
    a normal number exceeds in one of a thousand.
    """
    fits = [
        etid.identify_skin(commanded(skin, number, late), circuit=type(skin)(), throw=False)
        for number in range(8)
    ]
    assert sum(fit.usable for fit in fits) >= 6
    for fit in fits:
        # A circuit that leaves more than 2 % of the signal is not accepted.
        assert fit.verdict == ("approximate" if fit.rrse < 0.02 else "misfit")
        for name in skin.names():
            off = float(getattr(fit.circuit, name)) - getattr(skin, name)
            most = 3.3 if name in bounded else 5.0
            assert abs(off) < most * float(getattr(fit.stderr, name)), name


def test_without_noise_that_is_so_much_louder_the_errors_would_be_too_small():
    """What the samples say of the noise is a tenth of what the circuit leaves."""
    fit = etid.identify_skin(commanded(COLE, 0, 0.3), circuit=etid.SkinCole(), throw=False)
    exact = etid.identify_skin(
        commanded(COLE, 0, 0.3), circuit=etid.SkinCole(), accept=0.0, throw=False
    )
    assert exact.verdict == "misfit"
    assert float(fit.chi2) > 10
    assert float(fit.stderr.r_s) > 2 * float(exact.stderr.r_s)


def test_electrodes_on_tissue_are_nearly_a_cole_circuit(reference_data):
    """The edges of the current are guessed from V_out; R_s + R_p ‖ C_p is another circuit."""
    for path, recording in tissue_recordings(reference_data("ecog_stim").parent).items():
        fit = etid.identify_skin(recording, circuit=etid.SkinCole(), throw=False)
        assert fit.verdict == "approximate", path
        assert etid.identify_skin(recording, throw=False).verdict == "misfit"


def test_the_budget_of_a_measured_current_has_noise_and_what_the_circuit_leaves():
    """No driver, and no instrument that compares two voltages, adds anything."""
    recording = commanded(COLE, 0, 0.2)
    fit = etid.identify_skin(recording, circuit=etid.SkinCole())
    budget = fit.budget()
    assert set(budget.parts) == {"recording", "circuit"}
    assert not budget.unstated
    relative = np.array(fit.stderr.values()) / np.array(fit.circuit.values())
    np.testing.assert_allclose(budget.together, relative, rtol=1e-9)
    one = etid.identify_skins([recording], circuit=etid.SkinCole())[0]
    # The same numbers, but for the rounding of a fit from the recording.
    np.testing.assert_allclose(one.budget(recording).together, budget.together, rtol=1e-6)
