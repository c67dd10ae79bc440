"""From an estimate to a fit: every one passes through a judge, so that none lacks a verdict.

Among several applicable verdicts the most fundamental is reported: a loop that cannot be simulated,
then elements that are no circuit, then a solver that did not settle, then a model that misses the
data, then parameters that the data do not determine.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import Estimate
from etid.recordings.remarks import Remark
from etid.results.fits import Fit
from etid.results.verdicts import RESULTS, first_verdict, verdict
from etid.solvers.levenberg_marquardt import NormalEquations
from etid.solvers.matrices import inverse

# Members inherited from lineax, of which the type checker thinks they are not ours.
SUCCESSFUL = verdict("successful")
MAX_STEPS_REACHED = verdict("max_steps_reached")
MISFIT_CHI2 = 1.5  # the noise is known from the record to about 5 %, chi2 therefore to 10 %
MISFIT_RRSE = (
    1e-3  # of the signal; what converters and transformers leave unexplained at their best
)
# Growth of the calibrations' sum of squares in a joint fit. It is chi-squared with as many degrees
# of freedom as Z_th and the delays have parameters at most: 12 exceed this once in ten thousand.
STRAINED = 39.0
BIASED = 16.0  # squared standard errors between an estimate and the minimum of its own model


def misses(
    chi2: Float[Array, ""], error: Float[Array, ""], least: float = MISFIT_RRSE
) -> Bool[Array, ""]:
    """Whether the residual exceeds the noise both in standard deviations and in volts.

    Args:
        chi2: Of the fit.
        error: Its RRSE.
        least: Part of the signal that it may leave unexplained.
    """
    excess = error * jnp.sqrt(jnp.maximum(1 - 1 / chi2, 0.0))
    return (chi2 > MISFIT_CHI2) & (excess > least)


def too_late(estimate: Estimate) -> Bool[Array, ""]:
    """Whether a trigger delay lies outside the one sample for which it is modelled."""
    return jnp.any(jnp.abs(estimate.delay_samples) > 1)


def judged(
    estimate: Estimate, circuit: AbstractCircuit, driver_result: RESULTS, method: str
) -> Fit:
    """The fit of an estimate, with its verdict.

    Args:
        estimate: Its parameters are the logarithms of the elements.
        circuit: Structure of the load.
        driver_result: Verdict of the driver.
        method: Name of the estimator.
    """
    fitted = circuit.with_log_values(estimate.parameters)
    values = fitted.values()
    errors = jnp.sqrt(jnp.diagonal(estimate.cov))  # of the logarithms, so relative ones
    settled = RESULTS.promote(estimate.result) == RESULTS.successful
    return Fit(
        circuit=fitted,
        cov=estimate.cov * jnp.outer(values, values),
        shared_cov=estimate.shared_cov * jnp.outer(values, values),
        rrse=estimate.rrse,
        chi2=estimate.chi2,
        result=first_verdict(
            (~jnp.isfinite(estimate.chi2), RESULTS.unstable),
            (~jnp.isfinite(values).all(), RESULTS.nonphysical),
            (fitted.is_too_steep(estimate.cov), RESULTS.nonphysical),
            (~settled, MAX_STEPS_REACHED),
            (misses(estimate.chi2, estimate.rrse) | too_late(estimate), RESULTS.misfit),
            (estimate.strain > STRAINED, RESULTS.inconsistent),
            # None of 0: that is an element without any effect.
            (~jnp.all((errors > 0) & (errors < 1)), RESULTS.insensitive),
            (driver_result != SUCCESSFUL, RESULTS.driver_failed),
        ),
        steps=estimate.steps,
        method=method,
        remarks=remarks(estimate.hum),
    )


def remarks(hum: Bool[Array, ""]) -> Int[Array, ""]:
    """The remark of a fit that shows mains hum."""
    return jnp.where(hum, jnp.array(int(Remark.mains_hum)), 0)


def unless(fit: Fit, bad: Bool[Array, ""], result: RESULTS) -> Fit:
    """The same with another verdict, if it would be successful and should not."""
    wrong = bad & (fit.result == SUCCESSFUL)
    return dataclasses.replace(fit, result=RESULTS.where(wrong, result, fit.result))


def distance_to_minimum(equations: NormalEquations) -> Float[Array, ""]:
    """Squared distance to the minimum in standard errors."""
    return equations.gradient @ inverse(equations.matrix) @ equations.gradient
