"""1/f noise: how it is found in a record, and what a fit does with it."""

import numpy as np
import pytest

import etid
from benchmarks.noise import Flicker
from benchmarks.perturbed_study import all_records, both, undisturbed
from etid.estimators.lanes import Harmonics
from etid.recordings.preflight import Inspected
from etid.signals.noise import coloured, corner, noise_std
from tests.skins import off

RATE, SIGMA = 200e3, 0.02
OF_RECORD = {3: 10_000, 2: 6667, 10: 33_333}


def pulses(periods):
    """Rounded pulses with a slow tail, at 60 Hz; ten periods are no whole number of samples."""
    time = np.arange(OF_RECORD[periods]) / RATE
    late = np.mod(time - 1e-3, 1 / 60)
    return 50 * np.exp(-late / 2e-3) * (1 - np.exp(-late / 1e-5))


def noise(periods, f_c, seed):
    rng, time = np.random.default_rng(seed), np.arange(OF_RECORD[periods]) / RATE
    return SIGMA * rng.standard_normal(time.size) + Flicker(SIGMA, f_c)(time, rng)


@pytest.mark.parametrize("periods", OF_RECORD)
def test_white_noise_stays_white(periods):
    """In a drift, and where the last period is no whole number of samples, too."""
    drift = np.linspace(0, 1, OF_RECORD[periods]) ** min(periods - 1, 3)
    for seed in range(20):
        v = pulses(periods) + drift + noise(periods, 0.0, seed)
        assert corner(v, SIGMA, RATE, periods, v.size) == 0.0
    frequency, v = np.arange(60.0, 1e5, 60.0), noise(periods, 0.0, 0)
    assert (coloured(v, SIGMA, frequency, RATE, periods, v.size) == 1.0).all()


@pytest.mark.parametrize("periods", OF_RECORD)
@pytest.mark.parametrize("f_c", [2e3, 2e4])
def test_the_corner_of_flicker_noise_is_found(periods, f_c):
    found = []
    for seed in range(12):
        v = pulses(periods) + noise(periods, f_c, seed)
        found.append(corner(v, float(noise_std(v)), RATE, periods, v.size))
    # Some 60 values of |b|² know the corner to a quarter, their mean to a tenth.
    assert np.mean(found) == pytest.approx(f_c, rel=0.3)


def test_a_fit_weighs_flicker_noise():
    """Taken for white, this noise made eleven of twelve such fits a misfit."""
    study = undisturbed(0, 60.0)
    corners = (0.0, 1e4)
    variances, fits = [], []
    for f_c in corners:
        made = all_records(lambda of, f_c=f_c: both(added=(Flicker(of.sigma, f_c),))(of))(study)
        driver = etid.identify_driver([one.recording(0) for one in made.calibrations], throw=False)
        recordings = [one.recording(0) for one in made.trials]
        variances.append(Harmonics.of(Inspected(recordings[0])).variance_y)
        fits.append(etid.identify_skins(recordings, driver))
    for path, fit in zip((one.path for one in study.trials), fits[1].fit.chi2, strict=True):
        assert fit == pytest.approx(1.0, abs=0.1), path
    # The periods of such noise differ: one of ten records is `changed`.
    assert set(fits[1].verdicts) <= {"successful", "changed"}
    truth = np.array([study.truths[one.path].low for one in study.trials])
    assert (np.abs(off(fits[1], truth)) < 4).all()
    ratio = variances[1][:10] / variances[0][:10]
    expected = 1 + 1e4 / (60 * np.arange(1, 11))
    # White noise is known to 2 %, the corner to a quarter.
    np.testing.assert_allclose(ratio, expected, rtol=0.5)
    wider = np.asarray(fits[1].stderr.r_p) / np.asarray(fits[0].stderr.r_p)
    assert wider[0] > 2
