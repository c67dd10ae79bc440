"""Predictions of recordings that were not fitted, and a fit under the names of other toolboxes."""

import math
from typing import Any

import numpy as np
import pytest

import etid
from etid.selection import evidence

PATHS = [f"typical/dry/{number:02}" for number in (2, 3)]


@pytest.fixture(scope="module")
def study():
    return etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)


@pytest.fixture(scope="module")
def fits(study):
    driver = etid.identify_driver(study["calibration/98k8"], order=5)
    recording, simple = study["typical/dry/04"], etid.ParallelRC()
    other = etid.identify_skin(recording, driver, circuit=simple, throw=False)
    return {"skin": etid.identify_skin(recording, driver), "parallel": other}


@pytest.fixture(scope="module")
def found(study, fits):
    return etid.compare(fits, [study[path] for path in PATHS])


def test_the_fit_is_that_of_matlab(study, fits, found):
    recording, fit = study[PATHS[1]], fits["parallel"]
    predicted = etid.predict(recording, fit.driver, fit.circuit)
    known = np.isfinite(predicted)
    v, w = recording.v_out[known], predicted[known]
    expected = 100 * (1 - np.linalg.norm(v - w) / np.linalg.norm(v - v.mean()))
    assert found.percent[1, 1] == pytest.approx(expected, rel=1e-12)  # the same sums


def test_the_right_circuit_predicts_down_to_the_noise(found):
    assert (found.percent[:, 0] > found.percent[:, 1]).all()
    # Of 1666 harmonics, χ² has the standard error 1/41; four of them, and the noise of the fit.
    np.testing.assert_allclose(found.chi2[:, 0], 1, atol=0.12)
    assert (found.chi2[:, 1] > 10).all()
    assert found.recordings == tuple(PATHS)
    assert "typical/dry/03  parallel" in str(found)


def test_circuits_need_a_driver_and_get_names(study, fits):
    recording, driver = study[PATHS[0]], fits["skin"].driver
    several = [fits["skin"].circuit, fits["skin"], "R0-p(R1,C1)"]
    found = etid.compare(several, study.where(trial="02"), driver)
    assert found.names == ("SkinRC", "SkinRC 2", "R0-p(R1,C1)")
    assert found.rrse[0, 0] == found.rrse[0, 1] < found.rrse[0, 2]
    with pytest.raises(ValueError, match="current"):
        etid.compare(fits["skin"].circuit, recording)


def test_nothing_to_compare_and_a_failed_fit(study, fits):
    no_circuit: Any = [3.0]
    with pytest.raises(ValueError, match="nothing to compare"):
        etid.compare([], study[PATHS[0]])
    with pytest.raises(etid.RecordingError, match="fits"):
        etid.compare(no_circuit, study[PATHS[0]])
    failed = etid.SkinRC.of_fit([np.nan, 1.0, 1.0])
    assert np.isnan(etid.compare(failed, study[PATHS[0]], fits["skin"].driver).chi2).all()


def test_a_report_says_what_the_fit_is(fits):
    text = fits["parallel"].report()
    assert text.startswith("Model: ParallelRC, Z = R_p / (1 + s R_p C_p)\nParallelRC: misfit")
    r = fits["parallel"].correlation[0, 1]
    low, high = fits["parallel"].intervals()["r_p"]
    for part in (f"{r:+.2f}", f"{low / 1e3:.2f} … {high / 1e3:.2f} kΩ", "The model misses"):
        assert part in text
    assert text.endswith("Recording: 'typical/dry/04', subject typical, condition dry, trial 04")


def test_criteria_are_those_of_the_selection(study, fits):
    fit = fits["skin"]
    deviance, terms = float(fit.support.deviance), float(fit.support.terms)
    assert deviance < terms  # else the selection divides by the noise
    assert fit.bic == evidence.bic({0: fit})[0]
    assert fit.aic == deviance + 6
    batch = etid.identify_skins([study[path] for path in PATHS], fit.driver)
    assert batch.fit.aic.shape == batch.fit.success.shape == (2,)
    assert batch.fit.bic[1] == batch[1].bic


def test_without_a_likelihood_there_are_no_criteria(study):
    method = "steiglitz_mcbride"
    driver = etid.identify_driver(study["calibration/98k8"], method=method, throw=False)
    fit = etid.identify_skin(study[PATHS[0]], driver, method=method, throw=False)
    assert math.isnan(fit.aic)
    assert math.isnan(fit.bic)
    assert "no likelihood" in fit.report()


def test_the_names_of_lmfit(fits):
    fit = fits["skin"]
    assert fit.success is True
    assert fits["parallel"].success is False
    value, stderr, unit = fit.params["c_p"]
    assert (value, stderr, unit) == (fit.circuit.c_p, fit.stderr.c_p, "farad")
    assert list(fit.params) == ["r_s", "r_p", "c_p"]
