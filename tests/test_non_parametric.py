"""Z_th as one number for each harmonic: no order, no bias that is not told."""

import numpy as np
import pytest

import etid
from benchmarks.coverage import scene
from benchmarks.ladder import LOADS

RESISTORS = (98.8e3, 21.62e3)
SIGMAS = 5.0  # one in 2 million for a normal error


def z(fit, name):
    truth = np.array([getattr(LOADS[name], e) for e in ("r_s", "r_p", "c_p")])
    return (np.asarray(fit.circuit.values()) - truth) / np.asarray(fit.stderr.values())


def coarse_driver(study):
    return etid.identify_driver(list(study.calibrations.recordings()), order=2, throw=False)


@pytest.fixture(scope="module")
def study():
    return scene(60.0, 10_000, resistors=RESISTORS).simulate(seed=8)


@pytest.fixture(scope="module")
def coarse(study):
    """A driver whose order is too low for its transformer."""
    return coarse_driver(study)


def test_a_load_is_right_whatever_the_order_of_its_driver(study, coarse):
    assert coarse.verdict == "misfit"
    for name in LOADS:
        fit = etid.identify_skin(study[name], coarse, method="non_parametric")
        assert fit.method == "non_parametric"
        assert (np.abs(z(fit, name)) < SIGMAS).all()


def test_its_errors_are_the_bound(study, coarse):
    """Nothing is assumed of Z_th on either side; what is left is the choice of harmonics."""
    bounds = etid.bound(scene(60.0, 10_000, resistors=RESISTORS))
    for name in LOADS:
        fit = etid.identify_skin(study[name], coarse, method="non_parametric")
        relative = np.asarray(fit.stderr.values()) / np.asarray(fit.circuit.values())
        np.testing.assert_allclose(relative, list(bounds[name].relative.values()), rtol=0.1)
        assert (np.diagonal(fit.shared_cov) < np.diagonal(fit.cov)).all()


def test_noise_that_shifts_it_too_far_is_told():
    noisy = scene(40.0, 10_000, resistors=RESISTORS).simulate(seed=2)
    driver = coarse_driver(noisy)
    for name in LOADS:
        fit = etid.identify_skin(noisy[name], driver, method="non_parametric", throw=False)
        assert fit.verdict == "biased"


def test_other_pulse_rates_than_the_calibration_s_have_no_z_th(study, coarse):
    record = study["dry"]
    faster = record.replace(pulse_rate=2 * record.pulse_rate)
    with pytest.raises(ValueError, match="harmonics of 60"):
        etid.identify_skin(faster, coarse, method="non_parametric")
