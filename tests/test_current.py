"""Loads identified from a measured current: accuracy, delays, batches, and wrong input."""

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.results.feed import MEASURED_CURRENT

RATE, PULSES = 200e3, 60.0
SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)
COLE = etid.SkinCole(2e3, 27e3, 1e-3, 0.85)
WIDTH, STRENGTH = 200e-6, 1e-3  # [s], [A] of each phase of a biphasic pulse
# Estimates are within this many standard errors of the truth; by chance one of 3000 is not.
WITHIN = 4.0


def recorded(circuit, *, periods=3.0, snr_db=60.0, seed=0, delay=0.0, **fields):
    """Biphasic current pulses and their voltage at a circuit, exact between the samples."""
    n = round(periods * RATE / PULSES)
    f = np.arange(1, int(0.499 * RATE / PULSES)) * PULSES
    first, second, end = (np.exp(-2j * np.pi * f * (1e-3 + k * WIDTH)) for k in range(3))
    x = STRENGTH * PULSES * (first - 2 * second + end) / (2j * np.pi * f)
    x = x / (1 + (f / (0.3 * RATE)) ** 8)  # anti-alias filter of both channels
    y = x * np.asarray(circuit.response(jnp.asarray(f))) * np.exp(-2j * np.pi * f * delay)
    parts = np.array_split(np.arange(n) / RATE, 10)
    both = [2 * (np.exp(2j * np.pi * np.outer(t, f)) @ np.stack([x, y], 1)).real for t in parts]
    rng = np.random.default_rng(seed)
    current, v_out = (
        v + np.std(v) * 10 ** (-snr_db / 20) * rng.standard_normal(n)
        for v in np.concatenate(both).T
    )
    records = {"current": current, "v_out": v_out, "sample_rate": RATE, "pulse_rate": PULSES}
    return etid.Recording(**records | fields)


@pytest.fixture(scope="module")
def skin():
    return recorded(SKIN, delay=1e-6)


def off(fit, truth):
    """Differences from the truth [standard errors]."""
    return (fit.circuit.values() - truth.values()) / np.sqrt(np.diagonal(fit.cov))


def test_a_load_is_identified_from_whole_periods_of_current_and_voltage(skin):
    fit = etid.identify_skin(skin)
    assert fit.method == "maximum_likelihood"
    assert np.abs(off(fit, SKIN)).max() < WITHIN
    assert fit.stderr.r_p < 1e-3 * fit.circuit.r_p


def test_a_constant_phase_is_identified_and_chosen():
    selection = etid.select_circuit(recorded(COLE))
    assert type(selection.fit.circuit) is etid.SkinCole
    assert np.abs(off(selection.fit, COLE)).max() < WITHIN


def test_a_single_pulse_is_identified_in_time():
    fit = etid.identify_skin(recorded(SKIN, periods=1.1, delay=5e-7))
    assert fit.method == "output_error"
    assert np.abs(off(fit, SKIN)).max() < WITHIN


def test_a_batch_gives_the_fits_of_single_recordings(skin):
    fits = etid.identify_skins([skin, recorded(SKIN, seed=1)])
    np.testing.assert_allclose(
        np.asarray(fits.circuit.r_p)[0], etid.identify_skin(skin).circuit.r_p, rtol=1e-9
    )
    assert (fits.verdicts == "successful").all()


def test_a_study_of_currents_needs_no_calibration(skin, tmp_path):
    study = etid.Study.from_recordings([skin.replace(path="s01/0"), skin.replace(path="s01/1")])
    study.write(tmp_path / "study.h5")
    with etid.read(tmp_path / "study.h5") as again:
        np.testing.assert_array_equal(again["s01/1"].current, skin.current)
        found = etid.identify_study(again)
    assert found.drivers == {}
    assert (found.fits.verdicts == "successful").all()


def test_without_a_driver_the_unloaded_voltage_is_not_used(skin):
    both = skin.replace(v_th=np.zeros_like(skin.v_out))
    np.testing.assert_array_equal(
        etid.identify_skin(both).circuit.values(), etid.identify_skin(skin).circuit.values()
    )


@pytest.mark.parametrize(
    ("change", "verdict", "words"),
    [
        (lambda one: {"current": 1e3 * one.current}, "wrong_unit", "in ampere and not in mA"),
        (lambda one: {"current": one.v_out, "v_out": one.current}, "wrong_unit", "exchanged"),
        (lambda one: {"current": 0 * one.current}, "flat", "no signal"),
        (lambda one: {"current": 0 * one.current + 1e-3}, "flat", "no signal"),
        (lambda one: {"current": -one.current}, "misaligned", "change the sign"),
        (
            lambda one: {"current": np.where(np.arange(one.v_out.size) == 5, np.nan, one.current)},
            "nonfinite_samples",
            "NaN",
        ),
    ],
)
def test_a_wrong_current_gets_one_clear_verdict(skin, change, verdict, words):
    with pytest.raises(etid.IdentificationError, match=words) as error:
        etid.identify_skin(skin.replace(**change(skin)))
    assert str(error.value).startswith(f"recording '': {verdict}.")


def test_a_recording_needs_what_it_is_identified_from(skin):
    with pytest.raises(etid.RecordingError, match="current: was not recorded"):
        etid.identify_skin(skin.replace(v_th=skin.v_out, current=None))
    with pytest.raises(etid.RecordingError, match="v_th: was not recorded"):
        _ = skin.v_th
    with pytest.raises(etid.RecordingError, match=r"v_th: is not given.*or current"):
        skin.replace(current=None)
    with pytest.raises(etid.RecordingError, match="v_th: is not given"):
        skin.replace(r_load=1e5)
    with pytest.raises(etid.RecordingError, match="v_out: is not given"):
        skin.replace(v_out=None)


@pytest.mark.parametrize(
    "method", ["steiglitz_mcbride", "non_parametric", "harmonic_steiglitz_mcbride"]
)
def test_an_estimator_that_needs_a_driver_says_so(skin, method):
    with pytest.raises(ValueError, match=f"{method}.*from a measured current"):
        etid.identify_skin(skin, method=method)


def test_a_measured_current_prints_itself():
    assert repr(MEASURED_CURRENT) == "Measured current"
