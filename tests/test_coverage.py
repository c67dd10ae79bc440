"""Monte Carlo: the intervals contain the truth as often as they say."""

import numpy as np
import pytest
import scipy.stats

import etid
from benchmarks.coverage import monte_carlo, scene
from benchmarks.estimators import Drivers
from benchmarks.ladder import LOADS

SUCCESSFUL = 0.9
# Limits are those within which numbers of a normal error are in 997 of 1000 sets of draws. Errors
# that are 1.5 times as large as they say are beyond them: of three elements in 16 draws the rms may
# be 1.31, that of one in 40 draws 1.35.
SURE = 0.9973
# Standard errors: an estimate that is not linear in the data is biased at high noise. A third of
# one lowers the coverage from 95 to 93.7 %.
BIAS = 1 / 3
# Spread in standard errors: second-order terms make them a fifth too wide at 40 dB.
WIDE = 0.6


@pytest.fixture(scope="module")
def drivers():
    """All methods on the harmonics have one driver, which is identified once for each draw."""
    return Drivers()


def limits(draws):
    """Part of the intervals that hold the truth, and spread in standard errors, exactly."""
    low, high = scipy.stats.binom.interval(SURE, draws, 0.95)
    spread = np.sqrt(np.array(scipy.stats.chi2.interval(SURE, draws - 1)) / (draws - 1))
    return low / draws, high / draws, spread[0], spread[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "snr_db", "samples", "shared_v_th", "repetitions"),
    [
        ("maximum_likelihood", 60.0, 10_000, False, 40),
        ("maximum_likelihood", 60.0, 10_000, True, 40),
        ("joint", 60.0, 10_000, True, 20),
        ("maximum_likelihood", 40.0, 3334, False, 40),
    ],
)
def test_intervals_of_95_per_cent_contain_the_truth_in_95_per_cent(
    method, snr_db, samples, shared_v_th, repetitions, drivers
):
    more = 4 if method == "joint" else 0
    of_scene = scene(snr_db, samples, shared_v_th=shared_v_th, more=more)
    assert_honest(monte_carlo(of_scene, repetitions, method, drivers=drivers), repetitions)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "snr_db", "repetitions", "least"),
    [
        ("maximum_likelihood", 60.0, 100, 0.9),
        ("maximum_likelihood", 40.0, 100, 0.9),
        # It weighs all frequencies alike, though the noise of the current passes Z_L.
        ("output_error", 50.0, 60, 0.7),
    ],
)
def test_intervals_from_a_measured_current_hold_the_truth_and_attain_the_bound(
    method, snr_db, repetitions, least
):
    of_scene = scene(snr_db, 10_000, resistors=(), current_snr_db=snr_db)
    draws = monte_carlo(of_scene, repetitions, method)
    assert_honest(draws, repetitions)
    most = scipy.stats.chi2.ppf(SURE, repetitions) / repetitions
    for name, bound in etid.bound(of_scene).items():
        limit = np.array(list(bound.relative.values()))
        assert (np.mean(draws[name].error ** 2, axis=0) < most * limit**2 / least).all()


def assert_honest(draws, repetitions):
    """Intervals that contain the truth as often as they say, spread and bias within chance."""
    for name in LOADS:
        of = draws[name]
        good = int(np.sum(of.verdicts == "successful"))
        assert good > SUCCESSFUL * repetitions, np.unique(of.verdicts, return_counts=True)
        low, high, narrow, wide = limits(good)
        assert (of.covered >= low).all(), of.covered
        assert (of.covered <= high).all(), of.covered
        spread = of.z.std(0, ddof=1)
        assert (spread < wide).all(), spread
        assert (spread > min(WIDE, narrow)).all(), spread
        assert (np.abs(of.z.mean(0)) < max(BIAS, 3 / np.sqrt(good))).all(), of.z.mean(0)
        most = scipy.stats.chi2.interval(SURE, of.error.shape[1] * good)[1]
        assert of.distance.sum() < most, of.distance.sum() / (of.error.shape[1] * good)
