"""Coarse converters: their rounding error is weighed as what it is, and the fit says so."""

import numpy as np
import pytest

import etid
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark
from etid.signals import rounding as noise
from etid.signals.harmonics import harmonics
from etid.simulation import scenes
from etid.simulation.scenes import Scene

DRY = scenes.paper_dry()


def study_of(**settings):
    return Scene(DRY.trials[:1], DRY.calibration, **settings).simulate(seed=3)


def as_float(recording):
    return etid.Recording(
        recording.v_th,
        recording.v_out,
        sample_rate=recording.sample_rate,
        pulse_rate=recording.pulse_rate,
        r_load=recording.r_load,
        path=recording.path,
    )


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("snr_db", [None, 60.0, 80.0])
def test_the_step_is_seen_in_the_values(bits, snr_db):
    recording = study_of(bits=bits, snr_db=snr_db)["calibration/98k8"]
    step = Inspected.of(recording).step[1]
    np.testing.assert_allclose(noise.step_of(recording.v_out), step, rtol=1e-6)


@pytest.mark.parametrize("snr_db", [20.0, 60.0, 80.0])
@pytest.mark.parametrize("bits", [16, None])
def test_a_fine_converter_is_not_coarse(snr_db, bits):
    for recording in study_of(bits=bits, snr_db=snr_db).values():
        assert Inspected.of(recording).remarks == Remark(0)
        assert Inspected.of(as_float(recording)).remarks == Remark(0)


@pytest.mark.parametrize("snr_db", [60.0, None])  # steps of 3 standard deviations, or no noise
def test_volts_on_a_grid_are_fitted_like_codes(snr_db):
    """Steps of 0.05 % of the signal; they were not seen, and χ² was 2.2 and 125."""
    fits = []
    for kind in (as_float, lambda codes: codes):
        calibration, skin = map(kind, study_of(bits=14, snr_db=snr_db).values())
        fits.append(etid.identify_skin(skin, etid.identify_driver(calibration)))
    assert not any(int(fit.remarks) for fit in fits)
    np.testing.assert_allclose(fits[0].chi2, fits[1].chi2, rtol=1e-6)
    # Without noise the rounding error is the same in each period, more or less.
    assert 0.5 < fits[0].chi2 < 1.2


def test_noise_of_any_size_is_seen_through_the_steps():
    rng = np.random.default_rng(1)
    ramp, step = np.linspace(0.0, 7.0, 20_000), 1.0
    for sigma in (0.0, 0.1, 0.3):
        v = np.round(ramp + sigma * rng.standard_normal(ramp.size))
        # 2 200 and 6 700 changes of the code, known to 2 %; at 0.3 steps the zones in which it
        # changes begin to overlap, and two changes in one direction are not counted.
        assert noise.noise_before(v, step) == pytest.approx(sigma, rel=0.08, abs=0.001)
    for sigma in (0.7, 1.0, 2.0, 5.0):
        v = np.round(ramp + sigma * rng.standard_normal(ramp.size))
        # The median of sixth differences of codes is a whole number, which makes steps of 0.05.
        assert noise.noise_before(v, step) == pytest.approx(sigma, rel=0.02, abs=0.05)
        assert not noise.is_coarse(v, step)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_noise_through_the_steps_has_the_unit_of_the_record(unit):
    v = np.round(2.0 * np.random.default_rng(1).standard_normal(20_000))
    expected = unit * noise.noise_before(v, 1.0)
    np.testing.assert_allclose(noise.noise_before(unit * v, unit), expected, rtol=1e-9)


def test_the_waveform_before_rounding_keeps_a_jump_and_the_last_sample():
    """Straight lines through the change of one code, at 5.5; the record shows the rest itself."""
    v = np.array([0.0, 0.0, 0.0, 10.0, 10.0, 10.0, 11.0])
    expected = [0.0, 0.0, 0.0, 10.0, 10.2, 10.4, 11.0]
    np.testing.assert_allclose(noise._before(v, 1.0, 0.5), expected)


@pytest.mark.parametrize("codes", [True, False])
def test_a_converter_whose_noise_is_a_step_is_weighed_by_its_noise(codes):
    """12 bits of ±10 V at 40 dB: the noise is as large as a step, and was overlooked."""
    for study in (study_of(bits=12, snr_db=40.0), study_of(bits=8, snr_db=20.0)):
        for recording in study.values():
            seen = Inspected.of(recording if codes else as_float(recording))
            assert not seen.coarse.any()
            assert seen.remarks == Remark(0)


@pytest.mark.parametrize("samples", [10_000, 9999])  # nor does it fold what repeats exactly
def test_the_size_of_the_rounding_error_is_known_at_each_harmonic(samples):
    rate = 60.0 * samples / 3
    rate = 200e3 if samples == 10_000 else rate
    settings = {"snr_db": None, "full_scale": 4.0, "sample_rate": rate, "samples": samples}
    exact = study_of(bits=None, **settings)["calibration/98k8"]
    coarse = study_of(bits=8, **settings)["calibration/98k8"]
    step = Inspected.of(coarse).step[1]
    error = np.abs(harmonics(coarse.v_out - exact.v_out, 3, samples)) ** 2
    known = noise.rounding_variance(coarse.v_out, step, 3, samples)
    bands = [slice(0, 10), slice(10, 100), slice(100, 1000)]
    ratio = np.array([error[band].mean() / known[band].mean() for band in bands])
    # One draw of an error of few independent parts, weighed as at most three times as large.
    assert (ratio < 2).all()
    assert (ratio > 0.05).all()


def test_too_coarse_a_converter_says_so():
    study = study_of(bits=5, full_scale=4.0)
    driver = etid.identify_driver(study["calibration/98k8"], throw=False)
    fit = etid.identify_skin(study[DRY.trials[0].path], driver, throw=False)
    assert fit.verdict == "resolution"


@pytest.mark.parametrize(
    ("bits", "full_scale", "snr_db", "codes"),
    [
        (8, 10.0, 60.0, True),
        pytest.param(8, 4.0, None, True, marks=pytest.mark.slow),
        pytest.param(10, 10.0, None, False, marks=pytest.mark.slow),
    ],
)
def test_elements_are_right_within_wider_errors(bits, full_scale, snr_db, codes):
    study = study_of(bits=bits, full_scale=full_scale, snr_db=snr_db)
    calibration, skin = (one if codes else as_float(one) for one in study.values())
    driver = etid.identify_driver(calibration)
    fit = etid.identify_skin(skin, driver)
    assert int(driver.remarks) == int(fit.remarks) == Remark.coarse_converter
    truth = [getattr(DRY.trials[0].load, name) for name in ("r_s", "r_p", "c_p")]
    errors = np.sqrt(np.diag(fit.cov))
    assert (np.abs(fit.circuit.values() - np.array(truth)) < 4 * errors).all()
    assert (errors < 0.4 * np.array(truth)).all()


def test_a_command_of_few_values_has_no_converter_step():
    current = np.zeros(4000)
    current[200:400], current[400:600] = 5e-4, -5e-4
    v_out = 1e3 * current + 1e-3 * np.random.default_rng(0).standard_normal(current.size)
    one = etid.Recording(v_out=v_out, current=current, sample_rate=20e3, pulse_rate=5.0)
    assert np.asarray(Inspected.of(one).step).tolist() == [0.0, 0.0]
