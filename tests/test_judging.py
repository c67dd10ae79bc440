"""The thresholds between verdicts, on numbers of which it is clear what they are."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.estimators.judgement import SUCCESSFUL, distance_to_minimum
from etid.estimators.maximum_likelihood import verdict as judging
from etid.likelihood.fit import Estimate
from etid.likelihood.linear import NormalEquations
from etid.likelihood.noise import MISFIT_CHI2, MISFIT_RRSE, misses
from etid.recordings.remarks import Remark
from etid.results.fit import Support
from etid.results.instrument import Effects
from etid.results.verdicts import verdict

NO, YES = np.asarray(False), np.asarray(True)
FLAGS = "hum", "falls", "doubtful", "far", "other", "inconsistent", "biased", "approximate"


def estimate(
    logs=(10.0, 12.0, -23.0), relative: Any = 0.01, chi2=1.0, rrse=1e-3, delay=0.0, **more: Any
):
    """Of a skin; `relative` are the standard errors."""
    count = len(logs)
    cov = np.diag(np.broadcast_to(relative, count) ** 2)
    of: dict[str, Any] = dict.fromkeys(FLAGS, NO) | {
        "logs": np.asarray(logs),
        "delays": np.array([delay]),
        "z": np.zeros(0),
        "cov": cov,
        "shared_cov": 0.25 * cov,
        "chi2": np.asarray(chi2),
        "rrse": np.asarray(rrse),
        "settled": YES,
        "points": np.asarray(5),
        "strain": np.zeros(()),
        "support": Support.unknown(count),
        "effects": Effects.unknown(count),
        "tested": {},
    }
    return Estimate(**of | more)


def judged(of, circuit, driver=SUCCESSFUL, bounds=(), changed=False, accept=judging.ACCEPT):
    return judging.judged(of, circuit, changed, driver, "a method", None, bounds, accept)


def name(of, driver=SUCCESSFUL, **more):
    return judged(of, etid.SkinRC(), driver, **more).verdict


@pytest.mark.parametrize(
    ("chi2", "error", "expected"),
    [
        (1.05 * MISFIT_CHI2, 1e-2, True),
        (0.95 * MISFIT_CHI2, 1e-2, False),  # chi2 is known to a tenth
        (100.0, 0.9 * MISFIT_RRSE, False),  # in volts it is what any converter leaves
        (100.0, 1.1 * MISFIT_RRSE, True),
        (2.0, 1.3 * MISFIT_RRSE, False),  # half of the squares is noise: √½ of 1.3 is below 1
        (2.0, 1.5 * MISFIT_RRSE, True),
        (0.5, 1.0, False),
    ],
)
def test_a_misfit_exceeds_the_noise_in_standard_deviations_and_in_volts(chi2, error, expected):
    assert bool(misses(jnp.asarray(chi2), jnp.asarray(error))) is expected
    assert name(estimate(chi2=chi2, rrse=error)) == ("misfit" if expected else "successful")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, "successful"),
        ({"chi2": np.nan}, "unstable"),
        ({"logs": (10.0, np.nan, -23.0)}, "nonphysical"),
        ({"settled": NO}, "max_steps_reached"),
        ({"falls": YES}, "misfit"),
        ({"strain": np.asarray(38.0)}, "successful"),
        ({"strain": np.asarray(40.0)}, "inconsistent"),
        ({"relative": (0.01, 0.99, 0.01)}, "successful"),
        ({"relative": (0.01, 0.01, 1.01)}, "insensitive"),
        ({"relative": (0.0, 0.01, 0.01)}, "insensitive"),  # without any effect
        ({"relative": (0.01, np.nan, 0.01)}, "insensitive"),
        # Where noise hides C_p a fit may take it to 1e-190 F, and its derivative underflows.
        ({"logs": (10.0, 12.0, -437.0), "relative": (0.01, 0.01, 1e6)}, "insensitive"),
        # A trigger that is more than a sample late or early.
        ({"delay": 1.05}, "misfit"),
        ({"delay": -1.05}, "misfit"),
        ({"delay": 0.95}, "successful"),
        ({"delay": -0.95}, "successful"),
        ({"other": YES}, "misfit"),
        ({"far": YES}, "driver_unclear"),
        ({"inconsistent": YES}, "inconsistent"),
        ({"biased": YES}, "biased"),
        ({"approximate": YES, "chi2": 9.0, "rrse": 0.015}, "approximate"),
        ({"approximate": YES, "chi2": 9.0, "rrse": 0.025}, "misfit"),
        ({"approximate": YES, "chi2": 9.0, "rrse": 9e-4}, "successful"),
    ],
)
def test_every_reason_has_its_verdict(change, expected):
    of = estimate(**change)
    assert name(of) == expected
    rows = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), of)
    assert name(rows).tolist() == [expected] * 2
    traced = jax.jit(lambda of: judged(of, etid.SkinRC()).result._value)(of)
    assert int(traced) == int(verdict(expected)._value)


@pytest.mark.parametrize(
    ("chi2", "driver", "changed", "expected"),
    [
        (1.0, "successful", False, "successful"),
        (1.0, "successful", True, "inconsistent"),
        (9.0, "successful", True, "misfit"),
        (9.0, "successful", False, "misfit"),
        (1.0, "nonphysical", True, "driver_failed"),  # nothing follows from a failed driver
        (9.0, "nonphysical", False, "misfit"),
    ],
)
def test_of_several_reasons_one_is_the_verdict(chi2, driver, changed, expected):
    of = estimate(chi2=chi2, rrse=0.1)
    assert name(of, verdict(driver), changed=changed) == expected


def test_what_an_estimate_shows_beside_its_elements_are_remarks():
    names = {
        "hum": Remark.mains_hum,
        "falls": Remark.falls_with_current,
        "doubtful": Remark.gain_doubtful,
    }
    for seen in itertools.product([True, False], repeat=len(names)):
        flags: Any = dict(zip(names, map(np.asarray, seen), strict=True))
        expected = sum(name for name, one in zip(names.values(), seen, strict=True) if one)
        assert int(judged(estimate(**flags), etid.SkinRC()).remarks) == expected


def test_the_distance_to_the_minimum_is_in_standard_errors():
    """Of a parabola with its minimum at 0: at y the gradient is H y, and the square yᵀ H y."""
    matrix, y = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([0.5, -2.0])
    equations = NormalEquations(0.5 * y @ matrix @ y, matrix @ y, matrix)
    np.testing.assert_allclose(distance_to_minimum(equations), y @ matrix @ y, rtol=1e-12)


def test_logarithms_become_elements_and_their_errors():
    of = estimate(relative=(0.01, 0.02, 0.03))
    fit = judged(of, etid.SkinRC())
    values = np.exp([10.0, 12.0, -23.0])
    np.testing.assert_allclose(fit.circuit.values(), values, rtol=1e-12)
    np.testing.assert_allclose(fit.stderr.values(), values * [0.01, 0.02, 0.03], rtol=1e-12)
    np.testing.assert_allclose(fit.shared_cov, 0.25 * fit.cov, rtol=1e-12)
    # An exponent far above one is no circuit: of 1 % standard error, it is no accident.
    for alpha, expected in ((1.02, "successful"), (1.1, "nonphysical")):
        of = estimate(np.log([33e3, 186e3, 22e-6, alpha]))
        assert judged(of, etid.SkinCole()).verdict == expected
