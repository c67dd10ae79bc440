"""What a fit leaves: noise is inside of the bands, a wrong circuit and a changing load outside."""

import dataclasses

import numpy as np
import pytest

import etid
from benchmarks.ladder import CALIBRATION, LOADS, rung
from etid.plotting import figure_of
from etid.results.residual import ByPeriod, Correlation
from tests import test_filters
from tests.test_changes import falling, recorded

TRIALS = 10
QUANTILE = 2.576  # standard deviations of the band, which holds 99 %


@pytest.fixture(scope="module")
def study():
    return etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)


@pytest.fixture(scope="module")
def driver(study):
    return etid.identify_driver(study["calibration/98k8"], order=5)


@pytest.fixture(scope="module")
def fit(study, driver):
    return etid.identify_skin(study["typical/dry/01"], driver)


@pytest.fixture(scope="module")
def of_noise(study, driver):
    """The residuals of ten trials."""
    trials = [study[f"typical/dry/{number:02}"] for number in range(1, TRIALS + 1)]
    return [etid.identify_skin(one, driver).residual() for one in trials]


@pytest.fixture(scope="module")
def spectrum():
    """Frequencies, an impedance of Cole's circuit with 1 % of noise, and its standard error."""
    f, rng = np.geomspace(1e2, 1e5, 60), np.random.default_rng(0)
    z = np.asarray(etid.SkinCole(33.4e3, 186e3, 22e-6, 0.8).response(f))
    return f, z + 0.01 * np.abs(z) * (rng.normal(size=(2, 60)).T @ [1, 1j]), 0.01 * np.abs(z)


def periods_of(left):
    assert left.by_period is not None
    return left.by_period


@pytest.mark.parametrize("name", ["own", "with_input"])
def test_the_lags_of_noise_have_the_spread_of_the_band(of_noise, name):
    found = [getattr(one, name) for one in of_noise]
    scores = np.array([QUANTILE * one.values / one.band for one in found])
    # The standard error of the spread of n independent numbers is 1/√(2n); four of them.
    assert abs(scores.std() - 1) < 4 / np.sqrt(2 * scores.size)
    # 1 % of n lags, and four standard deviations of their count.
    assert np.mean([one.outside for one in found]) < 0.01 + 4 * np.sqrt(0.01 / scores.size)


def test_noise_is_seldom_taken_for_more(of_noise):
    # Three tests of ten residuals, each with a false alarm in a hundred: three are 1 in 300.
    assert sum(len(one._left) for one in of_noise) < 3
    # The mean of 1/41 for each of ten trials, four times.
    assert np.mean([one.rms**2 for one in of_noise]) == pytest.approx(1, abs=4 / 41 / TRIALS**0.5)


def test_another_circuit_leaves_a_residual_that_correlates(study, driver):
    circuit = etid.ParallelRC()
    found = etid.identify_skin(study["typical/dry/01"], driver, circuit=circuit, throw=False)
    left = found.residual()
    assert not left.own.is_noise
    assert not left.correlations["with the input"].is_noise
    assert periods_of(left).is_noise
    assert left.own.outside > 0.05
    assert left.rms > 3
    assert "correlates with itself and with the input" in str(left)


def test_a_load_that_changes_differs_between_the_periods():
    scene = rung("dry")
    driver = etid.identify_driver(scene.simulate(0)[CALIBRATION])
    changing = recorded(scene, falling(LOADS["dry"], "r_p", 0.02))
    left = etid.identify_skin(changing, driver, throw=False).residual()
    assert not periods_of(left).is_noise
    assert left.own.is_noise
    assert "differs between the periods" in left.note


def test_the_residual_in_time_is_predicted_minus_measured(study, driver, fit):
    recording, left = study["typical/dry/01"], fit.residual()
    expected = etid.predict(recording, driver, fit.circuit) - recording.v_out
    np.testing.assert_array_equal(left.in_time, expected)
    assert np.isnan(left.in_time[0])


def test_a_recording_that_was_not_fitted_tests_the_fit(study, driver, fit):
    left = fit.residual(study["typical/dry/02"], driver)
    # One chance in a hundred for each of three tests, and this seed; elements of another fit.
    assert left.is_noise
    assert "typical/dry/02" in str(left)


def test_without_whole_periods_and_without_a_driver(study, driver):
    whole = study["typical/dry/01"]
    part = whole.replace(v_th=whole.v_th[:3000], v_out=whole.v_out[:3000])
    left = etid.identify_skin(part, driver).residual()
    assert left.is_noise
    assert left.by_period is None


def test_aliases_of_the_edges_are_no_difference_of_periods():
    """The card has no filter: above 0.1 of its rate, aliases differ by up to 16 times the noise."""
    scene = etid.scenes.paper_dry(**etid.scenes.INSTRUMENTS["multifunction_card"])
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["calibration/98k8"])
    left = etid.identify_skin(study["typical/dry/01"], driver).residual()
    assert periods_of(left).is_noise


def test_behind_a_known_filter_nothing_is_predicted_in_time():
    rng, stated = np.random.default_rng(0), "butterworth 1 30e3"
    filtered = test_filters.recorded(rng, v_out=("butterworth", 1, 30e3), v_out_filter=stated)
    left = etid.identify_skin(filtered).residual()
    assert np.isnan(left.in_time).all()
    assert left.is_noise


def test_the_autocorrelation_is_that_of_the_residual_in_time():
    size, rng = 400, np.random.default_rng(3)
    number = np.arange(1, size // 2)
    whitened = rng.normal(size=(2, number.size)).T @ [1, 1j]
    in_time = np.fft.irfft(np.concatenate([[0], whitened, [0]]))
    lag = np.arange(1, 30)
    expected = np.array([in_time @ np.roll(in_time, by) for by in lag]) / (in_time @ in_time)
    expected -= np.cos(2 * np.pi * np.outer(lag, number) / size).mean(1)  # of white noise
    found = Correlation.of_power(np.abs(whitened) ** 2, number * 1.0, lag / size)
    np.testing.assert_allclose(found.values, expected, atol=1e-13)  # rounding of 400 terms


def test_a_residual_that_follows_the_input_correlates_at_its_lag():
    rng, frequency = np.random.default_rng(4), np.arange(1.0, 200.0)
    x = 10 ** rng.normal(size=frequency.size) * np.exp(2j * np.pi * rng.random(frequency.size))
    late = x / np.abs(x) * np.exp(-2j * np.pi * frequency * 5e-3)
    found = Correlation.with_input(late, x, frequency, np.arange(-4, 5) * 2.5e-3)
    assert found.lag[np.argmax(found.values)] == 5e-3
    assert found.values.max() == pytest.approx(1, rel=1e-12)  # rounding of 200 terms


def test_periods_of_noise_differ_by_it():
    rng = np.random.default_rng(5)
    off = rng.normal(size=(200, 4, 60))
    off -= off.mean(1, keepdims=True)
    rms = np.sqrt((off**2).mean(2) / (1 - 1 / 4))
    # 2 of 200 by chance; more than 8 by chance once in 4 000.
    assert sum(not ByPeriod(one, 60).is_noise for one in rms) <= 8
    assert not ByPeriod(1.3 * rms[0], 60).is_noise


def test_neighbours_of_an_impedance(spectrum):
    f, z, stderr = spectrum
    for error in (None, stderr):
        fit = etid.identify_impedance(f, z, stderr=error, circuit=etid.SkinCole())
        good = fit.residual()
        bad = etid.identify_impedance(f, z, stderr=error, throw=False).residual()
        assert good.is_noise
        assert not bad.is_noise
        assert len(good.plot()) == len(fit.plot(show="residual")) == 2
    assert bad.rms > 3 > good.rms


def test_the_picture_shows_time_frequency_and_lags(fit):
    figure = figure_of(fit.residual())
    labels = [axis.get_xlabel() for axis in figure.axes]
    assert labels == ["time [ms]", "frequency [kHz]", "lag [ms]", "lag [ms]"]


def test_what_has_no_residual_says_why(study, driver, fit):
    fits = etid.identify_skins([study["typical/dry/01"]], driver)
    with pytest.raises(ValueError, match="does not know its recording"):
        fits[0].residual()
    with pytest.raises(ValueError, match="batch"):
        fits.fit.residual(study["typical/dry/01"], driver)
    failed = dataclasses.replace(fit, circuit=etid.SkinRC.of_fit([np.nan, 1.0, 1.0]))
    with pytest.raises(ValueError, match=r"no elements.*: SkinRC: [^\n]*$"):
        failed.residual(study["typical/dry/01"], driver)
