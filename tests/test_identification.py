"""Driver, skin and study, on simulated recordings of one length."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from tests import kept_numbers

pytestmark = pytest.mark.usefixtures("run_as_for_users")

LENGTH = 3334
LOADS = {
    "dry": SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9),
    "damp": SkinLoad(r_s=6.1e3, r_p=17.4e3, c_p=0.66e-9),
}
# 5 standard errors: one in 2 million for a normal error, which the coverage test measures.
SIGMAS = 5.0


def scene(**options):
    trials = tuple(
        Trial(f"s01/{name}/{i}", load, subject="s01", condition=name, trial=str(i))
        for name, load in LOADS.items()
        for i in range(3)
    )
    calibration = (Trial("calibration/98k8", ResistorLoad(98.8e3)),)
    return Scene(**({"trials": trials, "calibration": calibration, "samples": LENGTH} | options))


def truth(path):
    return np.array(dataclasses.astuple(LOADS[path.split("/")[1]]))


@pytest.fixture(scope="module")
def study():
    return scene().simulate(seed=11)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"], order=5)


@pytest.fixture(scope="module")
def fits(study, driver):
    return etid.identify_skins(study.loaded, driver)


def elements(fits):
    return np.stack([np.asarray(v) for v in np.asarray(fits.circuit.values())])


def test_driver_is_the_transformers_impedance_within_its_error(driver):
    assert driver.verdict == "successful"
    assert driver.order == 5
    kept_numbers.check("driver_of_one_resistor", kept_numbers.of_driver(driver))
    frequency = jnp.array([600.0, 5e3, 2e4, 4e4])
    true = np.abs(scene().driver.z_th(np.asarray(frequency)))
    error = np.abs(np.asarray(driver.response(frequency))) - true
    stderr = np.asarray(driver.response_stderr(frequency))
    assert (np.abs(error) < SIGMAS * stderr).all()
    assert (stderr < 0.02 * true).all()


def test_skins_are_right_within_their_errors(fits):
    assert fits.counts() == {"successful": 6}
    for i, path in enumerate(fits.labels["path"]):
        error = elements(fits)[i] - truth(path)
        stderr = np.asarray(fits.stderr.values())[i]
        assert (np.abs(error) < SIGMAS * stderr).all()
        assert (stderr < 0.02 * truth(path)).all()
    assert (np.abs(np.asarray(fits.chi2) - 1) < 0.25).all()


def test_one_recording_equals_its_lane_of_a_batch(study, driver, fits):
    fit = etid.identify_skin(study["s01/damp/1"], driver)
    row = fits.labels["path"].tolist().index("s01/damp/1")
    # The lanes run the same steps; only the order of sums differs.
    np.testing.assert_allclose(fit.circuit.values(), elements(fits)[row], rtol=1e-6)
    np.testing.assert_allclose(fit.chi2, fits.chi2[row], rtol=1e-6)


def test_scaling_all_voltages_changes_nothing(study, driver):
    recording = study["s01/dry/0"]
    fit = etid.identify_skin(recording, driver)
    smaller = {
        name: etid.Samples(samples.stored, samples.conversion / 7)
        for name, samples in recording.samples.items()
    }
    scaled = recording.replace(**smaller, adc_range=None)
    again = etid.identify_skin(scaled, driver)
    np.testing.assert_allclose(again.circuit.values(), fit.circuit.values(), rtol=1e-6)


@pytest.mark.slow
def test_a_driver_serves_another_sample_rate(study):
    fast = scene(sample_rate=500e3, samples=8334).simulate(seed=2)
    driver = etid.identify_driver(fast["calibration/98k8"])
    fit = etid.identify_skin(study["s01/dry/0"], driver)
    error = np.asarray(fit.circuit.values()) - truth("s01/dry/0")
    assert (np.abs(error) < SIGMAS * np.asarray(fit.stderr.values())).all()


TWO = tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate((21.62e3, 98.8e3)))


@pytest.mark.slow
def test_several_calibrations_leave_every_element_within_its_error():
    study = etid.identify_study(scene(calibration=TWO).simulate(seed=4))
    assert list(study.drivers) == [("calibration/0", "calibration/1")]
    fits = study.fits
    for i, path in enumerate(fits.labels["path"]):
        error = elements(fits)[i] - truth(path)
        assert (np.abs(error) < SIGMAS * np.asarray(fits.stderr.values())[i]).all()


def test_prediction_equals_the_record_within_noise(study, driver):
    recording = study["s01/dry/0"]
    fit = etid.identify_skin(recording, driver)
    predicted = etid.predict(recording, driver, fit.circuit)
    known = np.isfinite(predicted)
    assert not known[0]
    assert known.sum() > 0.98 * LENGTH
    residual = predicted[known] - recording.v_out[known]
    assert np.sqrt(np.mean(residual**2)) / np.std(recording.v_out) < 3e-3  # 60 dB, two records


def test_prediction_holds_from_the_first_sample_behind_a_late_calibration():
    """Its delay times a state that decays within a sample once left that sample at 300 V."""
    late = scene(snr_db=40.0, trigger_jitter_rms=200e-9).simulate(seed=1)
    driver = etid.identify_driver(late["calibration/98k8"])
    for path in ("s01/damp/0", "s01/damp/1", "s01/damp/2"):
        recording = late[path]
        fit = etid.identify_skin(recording, driver, throw=False)
        residual = etid.predict(recording, driver, fit.circuit) - recording.v_out
        # 1 % of V_th in each of two records, of which damp skin leaves two thirds
        assert np.nanstd(residual) < 0.03 * np.std(recording.v_out)
        assert np.nanmax(np.abs(residual)) < 0.1 * np.ptp(recording.v_out)


@pytest.mark.slow
def test_a_circuit_of_ones_own_is_identified(driver):
    resistors = scene(trials=(Trial("r/21k62", ResistorLoad(21.62e3)),)).simulate(seed=9)
    recording = next(iter(resistors.loaded.recordings()))
    fit = etid.identify_skin(recording, driver, circuit=etid.Resistor())
    assert abs(float(fit.circuit.values()[0]) - 21.62e3) < SIGMAS * float(fit.stderr.values()[0])
