"""Draws and profiles of the likelihood, against the fit, against each other, and the truth."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.results.posterior import Profile

TRUTH = etid.SkinRC(33.4e3, 186e3, 0.12e-9)


def identified(snr_db, seed):
    study = etid.scenes.paper_dry(snr_db=snr_db).simulate(seed=seed)
    driver = etid.identify_driver(study["calibration/98k8"], order=5, throw=False)
    recording = study["typical/dry/01"]
    return etid.identify_skin(recording, driver, throw=False), recording, driver


@pytest.fixture(scope="module")
def clear():
    return identified(60.0, 0)


@pytest.fixture(scope="module")
def posterior(clear):
    return etid.posterior(*clear)


def test_at_60_db_the_draws_have_the_errors_of_the_fit(clear, posterior):
    fit, *_ = clear
    assert posterior.effective > 800
    logs = np.log(np.stack([np.asarray(getattr(posterior.draws, name)) for name in TRUTH.names()]))
    mean = logs @ posterior.weights
    centred = logs - mean[:, None]
    cov = (centred * posterior.weights) @ centred.T
    values = np.asarray(fit.circuit.values())
    expected = np.asarray(fit.cov) / np.outer(values, values)
    errors = np.sqrt(np.diag(expected))
    # 800 draws know a mean to 0.035, a deviation to 2.5 % and a correlation to 0.035 (one sigma).
    assert np.abs((mean - np.log(values)) / errors).max() < 0.15
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), errors, rtol=0.1)
    assert np.abs(cov / np.outer(errors, errors) - fit.correlation).max() < 0.15


def test_equal_seeds_give_equal_draws(clear, posterior):
    again = etid.posterior(*clear)
    np.testing.assert_array_equal(again.weights, posterior.weights)
    other = etid.posterior(*clear, seed=1)
    for name, (low, high) in posterior.intervals(0.9).items():
        ends = np.array(other.intervals(0.9)[name])
        # The 5 % quantile of 900 draws is known to 0.07 standard errors.
        assert np.abs(ends - (low, high)).max() < 0.3 * (high - low) / 3.3


@pytest.mark.slow
def test_a_profile_and_the_draws_give_one_interval_where_the_likelihood_is_skewed():
    """They share the likelihood and nothing else: one refits, the other integrates."""
    fit, recording, driver = identified(20.0, 0)
    profile = etid.profile(fit, recording, driver, "c_p")
    assert profile.deviance.min() == pytest.approx(0.0, abs=1e-3)
    low, high = profile.interval()
    drawn = etid.posterior(fit, recording, driver, draws=4000).intervals()["c_p"]
    error = float(fit.stderr.c_p)
    assert np.abs(np.array(drawn) - (low, high)).max() < 0.6 * error
    # The upper side is longer in both; the standard error makes both equal. It is 1.14 times as
    # long by 4000 draws, which know it to 0.04.
    value = float(fit.circuit.c_p)
    for ends in (drawn, (low, high)):
        assert ends[1] - value > 1.05 * (value - ends[0])


def test_the_interval_of_a_parabola_is_that_of_the_normal_distribution():
    values = np.linspace(90e3, 110e3, 41)
    profile = Profile("r_p", "ohm", 100e3, 2e3, values, ((values - 100e3) / 2e3) ** 2)
    np.testing.assert_allclose(profile.interval(0.95), [96080.07, 103919.93], rtol=1e-6)
    assert profile.interval(1 - 1e-12) == (-np.inf, np.inf)
    assert "100.0 ± 2.0 kΩ" in str(profile)


def test_few_effective_draws_are_mentioned(posterior):
    weights = np.zeros(posterior.weights.size)
    weights[:3] = 1 / 3
    assert "draw more" in str(dataclasses.replace(posterior, weights=weights))
    assert "draw more" not in str(posterior)
    assert "r_s" in posterior._repr_html_()


def test_what_has_no_likelihood_is_refused(clear):
    fit, recording, driver = clear
    other = dataclasses.replace(fit, method="output_error")
    with pytest.raises(ValueError, match="method='maximum_likelihood'"):
        etid.posterior(other, recording, driver)
    with pytest.raises(ValueError, match="no element 'cp'; it has r_s, r_p, c_p"):
        etid.profile(fit, recording, driver, "cp")
    with pytest.raises(ValueError, match="at least 1"):
        etid.posterior(fit, recording, driver, draws=0)
    unknown = dataclasses.replace(fit, cov=jnp.full((3, 3), jnp.nan))
    with pytest.raises(ValueError, match="does not determine"):
        etid.posterior(unknown, recording, driver)


@pytest.mark.slow
def test_at_20_db_intervals_contain_the_truth_in_95_percent():
    """Without the stretching they contain R_s in 83 %, R_p in 88 % and C_p in 83 %."""
    inside, truth = [], np.asarray(TRUTH.values())
    for seed in range(200):
        fit, recording, driver = identified(20.0, 1000 + seed)
        if fit.verdict != "successful":
            continue
        ends = etid.posterior(fit, recording, driver, draws=2000).intervals()
        inside.append(
            [low < true < high for (low, high), true in zip(ends.values(), truth, strict=True)]
        )
    assert len(inside) > 150
    share = np.mean(inside, axis=0)
    print(len(inside), share)
    # 93 to 97 % within 1.5 standard deviations of a count of 180 (1.6 %).
    assert (share > 0.93 - 0.024).all()
    assert (share < 0.97 + 0.024).all()
