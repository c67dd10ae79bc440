"""The thresholds between verdicts, on numbers of which it is clear what they are."""

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import etid
from etid.estimators.estimate import Estimate
from etid.estimators.judgement import (
    SUCCESSFUL,
    distance_to_minimum,
    judged,
    remarks,
    too_late,
    unless,
)
from etid.likelihood.linear import NormalEquations
from etid.likelihood.noise import MISFIT_CHI2, MISFIT_RRSE, misses
from etid.recordings.remarks import Remark
from etid.results.verdicts import RESULTS, verdict


def estimate(
    parameters=(10.0, 12.0, -23.0),
    relative: Any = 0.01,
    chi2=1.0,
    rrse=1e-3,
    delay=0.0,
    **more: Any,
):
    """Of a skin; `relative` are the standard errors."""
    cov = jnp.diag(jnp.broadcast_to(jnp.asarray(relative), 3) ** 2)
    of = {"result": optx.RESULTS.successful, "strain": jnp.zeros(())} | more
    return Estimate(
        parameters=jnp.asarray(parameters),
        delay_samples=jnp.array([delay]),
        cov=cov,
        chi2=jnp.asarray(chi2),
        rrse=jnp.asarray(rrse),
        steps=jnp.asarray(5),
        shared_cov=0.25 * cov,
        **of,
    )


def name(of, driver=SUCCESSFUL):
    return judged(of, etid.SkinRC(), driver, "a method").verdict


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
        ({"parameters": (10.0, np.nan, -23.0)}, "nonphysical"),
        ({"result": optx.RESULTS.nonlinear_max_steps_reached}, "max_steps_reached"),
        ({"falls": jnp.asarray(True)}, "misfit"),
        ({"strain": jnp.asarray(38.0)}, "successful"),
        ({"strain": jnp.asarray(40.0)}, "inconsistent"),
        ({"relative": (0.01, 0.99, 0.01)}, "successful"),
        ({"relative": (0.01, 0.01, 1.01)}, "insensitive"),
        ({"relative": (0.0, 0.01, 0.01)}, "insensitive"),  # without any effect
        ({"relative": (0.01, np.nan, 0.01)}, "insensitive"),
        # Where noise hides C_p a fit may take it to 1e-190 F, and its derivative underflows.
        ({"parameters": (10.0, 12.0, -437.0), "relative": (0.01, 0.01, 1e6)}, "insensitive"),
        # A trigger that is more than a sample late or early.
        ({"delay": 1.05}, "misfit"),
        ({"delay": -1.05}, "misfit"),
        ({"delay": 0.95}, "successful"),
        ({"delay": -0.95}, "successful"),
    ],
)
def test_every_reason_has_its_verdict(change, expected):
    of = estimate(**change)
    assert name(of) == expected
    assert bool(too_late(of)) is ("delay" in change and expected == "misfit")


@pytest.mark.parametrize(
    ("chi2", "driver", "later", "expected"),
    [
        (1.0, "successful", False, "successful"),
        (1.0, "successful", True, "biased"),  # a later test overrules success only
        (9.0, "successful", True, "misfit"),
        (9.0, "successful", False, "misfit"),
        (1.0, "nonphysical", False, "driver_failed"),  # a failed driver comes last
        (9.0, "nonphysical", False, "misfit"),
    ],
)
def test_of_several_reasons_one_is_the_verdict(chi2, driver, later, expected):
    fit = judged(estimate(chi2=chi2, rrse=0.1), etid.SkinRC(), verdict(driver), "a method")
    assert unless(fit, jnp.asarray(later), RESULTS.biased).verdict == expected


def test_what_an_estimate_shows_beside_its_elements_are_remarks():
    names = {
        "hum": Remark.mains_hum,
        "falls": Remark.falls_with_current,
        "doubtful": Remark.gain_doubtful,
    }
    for seen in itertools.product([True, False], repeat=len(names)):
        flags: Any = dict(zip(names, map(jnp.asarray, seen), strict=True))
        of = estimate(**flags)
        expected = sum(name for name, one in zip(names.values(), seen, strict=True) if one)
        assert int(remarks(of)) == expected
        assert int(judged(of, etid.SkinRC(), SUCCESSFUL, "a method").remarks) == expected


def test_the_distance_to_the_minimum_is_in_standard_errors():
    """Of a parabola with its minimum at 0: at y the gradient is H y, and the square yᵀ H y."""
    matrix, y = np.array([[4.0, 1.0], [1.0, 9.0]]), np.array([0.5, -2.0])
    equations = NormalEquations(0.5 * y @ matrix @ y, matrix @ y, matrix)
    np.testing.assert_allclose(distance_to_minimum(equations), y @ matrix @ y, rtol=1e-12)


def test_logarithms_become_elements_and_their_errors():
    of = estimate(relative=(0.01, 0.02, 0.03))
    fit = judged(of, etid.SkinRC(), SUCCESSFUL, "a method")
    values = np.exp([10.0, 12.0, -23.0])
    np.testing.assert_allclose(fit.circuit.values(), values, rtol=1e-12)
    np.testing.assert_allclose(fit.stderr.values(), values * [0.01, 0.02, 0.03], rtol=1e-12)
    np.testing.assert_allclose(fit.shared_cov, 0.25 * fit.cov, rtol=1e-12)
    # An exponent far above one is no circuit: of 1 % standard error, it is no accident.
    for alpha, expected in ((1.02, "successful"), (1.1, "nonphysical")):
        logs, cov = jnp.log(jnp.array([33e3, 186e3, 22e-6, alpha])), 1e-4 * jnp.eye(4)
        of = Estimate(**{**vars(of), "parameters": logs, "cov": cov, "shared_cov": 0 * cov})
        assert judged(of, etid.SkinCole(), SUCCESSFUL, "a method").verdict == expected
