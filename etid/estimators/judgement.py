"""The verdict of an estimate, which makes it a fit.

If several verdicts apply, the most fundamental one is reported. The order is: the loop cannot be
simulated, the elements are no circuit, the solver did not converge, the model does not explain the
data, the data do not determine the parameters.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from etid.circuits.branches import exchangeable, in_order
from etid.circuits.circuit import AbstractCircuit, too_steep
from etid.estimators.element_limits import Limits, limited, of_circuit, within
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimate import Estimate
from etid.likelihood.linear import NormalEquations
from etid.likelihood.noise import misses
from etid.recordings.remarks import Remark
from etid.results.fit import Fit, Support
from etid.results.instrument import Effects
from etid.results.verdicts import RESULTS, first_verdict, usable, verdict
from etid.signals.transfer import AnyArray
from etid.solvers.matrices import inverse

# Inherited from lineax; the type checker does not see them as members of our class.
SUCCESSFUL = verdict("successful")
MAX_STEPS_REACHED = verdict("max_steps_reached")
# Increase of the calibrations' sum of squares in a joint fit. Its distribution is chi-squared. The
# degrees of freedom are at most the number of parameters of Z_th and the delays. With 12 degrees of
# freedom the increase exceeds this value once in ten thousand.
STRAINED = 39.0
BIASED = 16.0  # squared standard errors from an estimate to the minimum of its model


def too_late(estimate: Estimate) -> Bool[Array, ""]:
    """Whether a trigger delay exceeds one sample; the model holds up to one sample."""
    return jnp.any(jnp.abs(estimate.delay_samples) > 1)


def judged(
    estimate: Estimate,
    circuit: AbstractCircuit,
    driver_result: RESULTS,
    method: str,
    bounds: Limits = (),
    prior: ElementPrior | None = None,
) -> Fit:
    """The fit of an estimate of the logarithms of the elements, with its verdict.

    Branches that can be exchanged get their order. Bounds of elements that the circuit lacks do not
    count. Elements that `prior` fixes are exact.
    """
    estimate = ordered(estimate, circuit, bounds, prior)
    fitted = circuit.with_log_values(estimate.parameters)
    values = fitted.values()
    errors = jnp.sqrt(jnp.diagonal(estimate.cov))  # of the logarithms, so they are relative
    cov, shared_cov = (of * jnp.outer(values, values) for of in (estimate.cov, estimate.shared_cov))
    own, outside, contradicted = of_circuit(bounds, circuit), None, jnp.array(False)
    support = estimate.support
    if own:
        found = within(circuit, values, cov, shared_cov, own)
        inside, cov, shared_cov, outside, deviance, contradicted = found
        if support is not None:  # bounds are a part of what a choice of circuits compares
            support = dataclasses.replace(support, deviance=support.deviance + deviance)
        errors = jnp.sqrt(jnp.diagonal(cov)) / inside
        values = jnp.where(jnp.isfinite(inside), inside, values)
    if prior is not None:
        values = prior.exact(values)
    fitted, at_bound = circuit.with_values(values), 0
    if outside is not None:
        at_bound = jnp.where(jnp.any(outside != 0), int(Remark.at_bound), 0)
    settled = estimate.result == optx.RESULTS.successful
    return Fit(
        circuit=fitted,
        cov=cov,
        shared_cov=shared_cov,
        rrse=estimate.rrse,
        chi2=estimate.chi2,
        result=first_verdict(
            (~jnp.isfinite(estimate.chi2), RESULTS.unstable),
            (~jnp.isfinite(values).all(), RESULTS.nonphysical),
            (too_steep(fitted, fitted.log_values(), estimate.cov), RESULTS.nonphysical),
            (~settled, MAX_STEPS_REACHED),
            (misses(estimate.chi2, estimate.rrse) | too_late(estimate), RESULTS.misfit),
            (estimate.falls, RESULTS.misfit),  # which can pass for a change of the driver
            (estimate.strain > STRAINED, RESULTS.inconsistent),
            (contradicted, RESULTS.out_of_bounds),
            # An error of 0 also fails: the element has no effect. So does a value of 0, exp() of a
            # far parameter: files of fits hold positive elements where a fit is successful.
            (~jnp.all((errors > 0) & (errors < 1) & (values > 0)), RESULTS.insensitive),
            (~usable(driver_result), RESULTS.driver_failed),
        ),
        steps=estimate.steps,
        method=method,
        remarks=remarks(estimate) + at_bound,
        support=support or Support.unknown(values.size),
        limits=limited(circuit, own, outside),
        by_tolerance=estimate.by_tolerance or Effects.unknown(values.size),
    )


def places_of(
    estimate: Estimate, circuit: AbstractCircuit, bounds: Limits, prior: ElementPrior | None
) -> Int[Array | np.ndarray, " element"]:
    """Places of the elements in the order of their branches (`etid.circuits.branches`)."""
    limits = {name: ends for name, *ends in bounds}
    ends = np.array([limits.get(name, (0.0, np.inf)) for name in circuit.names()])
    told = () if prior is None else (prior.told, prior.width)
    return in_order(circuit, estimate.parameters, *told, *ends.T)


def ordered(
    estimate: Estimate, circuit: AbstractCircuit, bounds: Limits, prior: ElementPrior | None
) -> Estimate:
    """The estimate, with branches that can be exchanged in their order."""
    if not exchangeable(type(circuit)):
        return estimate
    places = places_of(estimate, circuit, bounds, prior)
    support, effects = estimate.support, estimate.by_tolerance
    if support is not None:
        support = dataclasses.replace(support, spread_slope=support.spread_slope[places])
    return dataclasses.replace(
        estimate,
        parameters=estimate.parameters[places],
        cov=estimate.cov[places][:, places],
        shared_cov=estimate.shared_cov[places][:, places],
        support=support,
        by_tolerance=effects and effects.of_elements(places),
    )


def remarks(estimate: Estimate) -> Int[Array, ""]:
    """The remarks that an estimate makes."""
    of = (
        (estimate.hum, Remark.mains_hum),
        (estimate.falls, Remark.falls_with_current),
        (estimate.doubtful, Remark.gain_doubtful),
    )
    return sum((jnp.where(on, int(one), 0) for on, one in of), jnp.zeros((), int))


def unless(fit: Fit, bad: Bool[Array, ""], result: RESULTS) -> Fit:
    """The fit with the verdict `result`, if it is successful and `bad` is true."""
    wrong = bad & (fit.result == SUCCESSFUL)
    return dataclasses.replace(fit, result=RESULTS.where(wrong, result, fit.result))


def distance_to_minimum(equations: NormalEquations) -> Float[AnyArray, ""]:
    """Squared distance to the minimum [standard errors squared]."""
    return equations.gradient @ inverse(equations.matrix) @ equations.gradient
