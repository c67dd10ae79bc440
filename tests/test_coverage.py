"""Monte Carlo: the intervals contain the truth as often as they say."""

import dataclasses
import functools

import numpy as np
import pytest
import scipy.stats

import etid
from benchmarks import coverage
from benchmarks.coverage import monte_carlo, scene
from benchmarks.estimators import shared
from benchmarks.failure_axes import cells
from benchmarks.failure_map import Effort, answers
from benchmarks.ladder import LOADS

SUCCESSFUL = 0.9  # Steiglitz-McBride calls one of 20 biased that it need not
# A driver costs half a second on the harmonics, several by output error or with a study.
REPETITIONS = 100
DEAR = 40
# Limits are those within which numbers of a normal error are in 997 of 1000 sets of draws.
SURE = 0.9973
# Standard errors: an estimate that is not linear in the data is biased at high noise. A third of
# one lowers the coverage from 95 to 93.7 %.
BIAS = 1 / 3
# Spread in standard errors: second-order terms make them a fifth too wide at 40 dB. Behind one
# resistor, harmonic Steiglitz-McBride has large errors of C_p where its standard errors are larger
# still: 0.61 at 60 dB, with 98 of 100 intervals that hold the truth.
WIDE = 0.6


@pytest.fixture(scope="module", autouse=True)
def _drivers_once():
    """All methods on the harmonics have one driver, which is identified once for each draw."""
    found, real = {}, etid.identify_driver

    def once(calibrations, *, method=None, throw=True):
        key = tuple(record.v_out.tobytes() for record in calibrations), shared(method)
        if key not in found:
            found[key] = real(calibrations, method=shared(method), throw=throw)
        return found[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(coverage.etid, "identify_driver", once)
        yield


@functools.cache
def limits(draws):
    """Part of the intervals that hold the truth, and spread in standard errors, exactly."""
    low, high = scipy.stats.binom.interval(SURE, draws, 0.95)
    spread = np.sqrt(np.array(scipy.stats.chi2.interval(SURE, draws - 1)) / (draws - 1))
    return low / draws, high / draws, spread[0], spread[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "snr_db", "samples", "shared_v_th", "repetitions"),
    [
        ("maximum_likelihood", 60.0, 10_000, False, REPETITIONS),
        ("maximum_likelihood", 60.0, 10_000, True, REPETITIONS),
        ("non_parametric", 60.0, 10_000, False, REPETITIONS),
        ("non_parametric", 60.0, 10_000, True, REPETITIONS),
        ("joint", 60.0, 10_000, False, DEAR),
        ("joint", 60.0, 10_000, True, DEAR),
        ("output_error", 60.0, 10_000, False, DEAR),
        ("output_error", 40.0, 3334, False, REPETITIONS),
    ],
)
def test_intervals_of_95_per_cent_contain_the_truth_in_95_per_cent(
    method, snr_db, samples, shared_v_th, repetitions
):
    of_scene = scene(snr_db, samples, shared_v_th=shared_v_th, more=10 if method == "joint" else 0)
    assert_honest(monte_carlo(of_scene, repetitions, method), repetitions)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "snr_db", "repetitions", "least"),
    [
        ("maximum_likelihood", 60.0, 2 * REPETITIONS, 0.9),
        ("maximum_likelihood", 40.0, 2 * REPETITIONS, 0.9),
        # It weighs all frequencies alike, though the noise of the current passes Z_L. The first 200
        # draws of damp skin are unlucky for every method: 0.90 to 0.93; 1000 others had 0.95.
        ("output_error", 50.0, 4 * REPETITIONS, 0.7),
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


@pytest.mark.slow
def test_a_driver_has_no_section_that_noise_has_split():
    """One of 200 calibrations: of two minima the one with two sections in one place was taken.

    Its standard errors were too small, and C_p of dry skin 6.4 of them off, called successful.
    """
    study = scene(60.0, 10_000, jitter=0.0).simulate(seed=5041)
    driver = etid.identify_driver(list(study.calibrations.recordings()))
    fit = etid.identify_skin(study["dry"], driver)
    error = np.asarray(fit.circuit.values()) - dataclasses.astuple(LOADS["dry"])
    # One draw that was looked for, of 600 errors: 4 in one of 30 sets of them.
    assert (np.abs(error) < 4 * np.asarray(fit.stderr.values())).all()


@pytest.mark.slow
def test_a_resistor_fitted_to_skin_is_refused_at_20_db():
    """It was called successful in 158 of 160 fits."""
    place = ("SNR and circuit fitted to skin", "20 dB", "resistor")
    [cell] = [cell for cell in cells() if tuple(cell.place.values()) == place]
    found = answers(cell, {"default": Effort(2, 10), "steiglitz_mcbride": Effort(2, 10)})
    assert len(found) == 20  # the other method knows skin only
    assert sum(of.successful for of in found) <= 1  # one of 80 was
    assert not any(of.exact for of in found)
