import dataclasses

import numpy as np
import pytest
import scipy

import etid
from etid.recordings.errors import RecordingError
from etid.results.variation import REST, _levels, _Model
from tests import pictures

SUBJECTS, SESSIONS, TRIALS = 10, 3, 5
SUBJECT = np.repeat(np.arange(SUBJECTS), SESSIONS * TRIALS)
SESSION = np.tile(np.repeat(np.arange(SESSIONS), TRIALS), SUBJECTS)


def drawn(seed, stds, s):
    """Logarithms of an element that varies between subjects, sessions and trials."""
    normal = np.random.default_rng(seed).standard_normal
    parts = normal(SUBJECTS)[SUBJECT], normal((SUBJECTS, SESSIONS))[SUBJECT, SESSION]
    parts = *parts, normal(SUBJECT.size)
    return sum(std * part for std, part in zip(stds, parts, strict=True)) + s * normal(SUBJECT.size)


def model_of(y, s, drivers):
    columns = SUBJECT.astype(str), SESSION.astype(str)
    levels = _levels(columns, ("subject", "session"), y.size)
    assert list(levels) == ["subject", "session", REST]
    return _Model(y, s, list(levels.values()), drivers)


def test_the_restricted_likelihood_is_that_of_all_contrasts():
    s = np.full(SUBJECT.size, 0.02)
    y = drawn(0, (0.3, 0.1, 0.05), s)
    of_driver = SESSION[:, None] == np.arange(SESSIONS)
    drivers = np.linspace(0.1, 0.2, y.size)[:, None] * of_driver
    model = model_of(y, s, drivers)
    same_session = (SUBJECT[:, None] == SUBJECT) & (SESSION[:, None] == SESSION)
    first, *others = ((0.3, 0.1, 0.05), (0.2, 0.2, 0.02), (0.0, 0.1, 0.3))
    # ln L of the contrasts y_i − y_1, which do not depend on the mean, but for a constant.
    contrasts = np.eye(y.size)[1:] - np.eye(y.size)[0]

    def deviance(std):
        v = std[0] ** 2 * (SUBJECT[:, None] == SUBJECT) + std[1] ** 2 * same_session
        v = v + np.diag(s**2 + std[2] ** 2)
        v = contrasts @ (v + drivers @ drivers.T) @ contrasts.T
        rest = contrasts @ y
        return np.linalg.slogdet(v)[1] + rest @ np.linalg.solve(v, rest)

    for other in others:
        ours = model.at(np.array(other))[0] - model.at(np.array(first))[0]
        assert ours == pytest.approx(deviance(other) - deviance(first), rel=1e-6)


@pytest.fixture(scope="module")
def fits():
    """Fits of one skin with their errors, moved by a known factor for each subject."""
    found = pictures.fits().take(np.zeros(24, int))
    subject, session = np.arange(24) // 8, np.arange(24) // 4 % 2
    factor = np.exp(np.array([-0.5, 0.0, 0.5])[subject])
    noise = np.exp(pictures.RELATIVE[1] * np.random.default_rng(0).standard_normal(24))
    r_p = factor * noise * np.asarray(found.circuit.r_p)
    cov = found.cov * (factor[:, None, None] ** 2)
    fit = dataclasses.replace(
        found.fit, circuit=dataclasses.replace(found.circuit, r_p=r_p), cov=cov
    )
    labels = {**found.labels, "subject": subject.astype(str), "session": session.astype(str)}
    return dataclasses.replace(found, fit=fit, labels=labels)


def test_a_variation_that_is_there_is_found_and_one_that_is_not_is_zero(fits):
    found = etid.variation(fits, "r_p")
    assert list(found.between) == ["subject", "session", REST]
    subjects, sessions, recordings = found.between.values()
    assert subjects.low < 0.5 < subjects.high
    assert subjects.std == pytest.approx(0.5, rel=0.05)
    assert sessions.low == 0.0
    assert max(sessions.high, recordings.high) < 0.02  # the error of a fit is 0.005
    assert "between subjects" in str(found)


def test_an_interval_has_95_per_cent():
    """Without errors and groups, the restricted deviance is (n − 1) ln σ² + Σ (y − ȳ)² / σ²."""
    y = np.random.default_rng(2).standard_normal(20)
    squares, free = np.sum((y - y.mean()) ** 2), y.size - 1

    def beyond(std):
        return free * np.log(std**2) + squares / std**2 - least - scipy.stats.chi2.ppf(0.95, 1)

    best = np.sqrt(squares / free)
    least = free * np.log(best**2) + free
    expected = [scipy.optimize.brentq(beyond, *of) for of in ((0.1, best), (best, 10.0))]
    model = _Model(y, np.zeros(y.size), [np.arange(y.size)], np.zeros((y.size, 0)))
    found = model.best()
    # The search ends within 1e-5 of the deviance, its root within 1e-4; 90 % would be 8 % narrower.
    assert found[0] == pytest.approx(best, rel=2e-3)
    np.testing.assert_allclose(model.interval(0, found), expected, rtol=1e-3)


@pytest.mark.slow
def test_errors_of_drivers_are_no_variation_between_the_sessions_that_share_them():
    """Three sessions, each with its driver, whose error is twice the variation between sessions.

    Of 30 intervals of 95 %, 25 hold the truth in 996 of 1000 runs.
    """
    s, truth = np.full(SUBJECT.size, 0.02), (0.3, 0.05, 0.03)
    drivers = 0.1 * (SESSION[:, None] == np.arange(SESSIONS))
    held = {True: 0, False: 0}
    for seed in range(30):
        errors = np.random.default_rng([seed, 1]).standard_normal(SESSIONS)
        y = drawn(seed, truth, s) + drivers @ errors
        for told in held:
            model = model_of(y, s, told * drivers)
            low, high = model.interval(1, model.best())
            held[told] += low <= truth[1] <= high
    assert held[True] >= 25
    assert held[False] < 25  # drivers of their own must be told


def test_an_error_that_all_fits_share_is_none_of_their_variation(fits):
    """The driver's error moves all elements by one factor, and hides no variation between them."""
    shared = 50 * fits.cov
    fit = dataclasses.replace(fits.fit, cov=fits.cov + shared, shared_cov=shared)
    found, alone = (etid.variation(of, "r_p") for of in (dataclasses.replace(fits, fit=fit), fits))
    assert found.error == pytest.approx(alone.error)
    parts = [list(of.between.values()) for of in (found, alone)]
    np.testing.assert_allclose(parts[0], parts[1], rtol=1e-3, atol=1e-6)  # the search's tolerance


@pytest.mark.parametrize(
    ("element", "by", "error", "message"),
    [
        ("r_q", ("subject",), ValueError, "must be one of r_s, r_p, c_p"),
        ("r_p", ("subjekt",), RecordingError, "did you mean subject"),
        ("r_p", ("site",), ValueError, "no variation by site in 1 usable fit"),
    ],
)
def test_refusals_of_a_variation(fits, element, by, error, message):
    one = fits.take(np.arange(1)) if by == ("site",) else fits
    with pytest.raises(error, match=message):
        etid.variation(one, element, by)
