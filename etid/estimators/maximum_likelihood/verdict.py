"""The verdicts of estimates, which make them fits.

If several verdicts apply, the most fundamental one is reported. The order is: the loop cannot be
simulated, the elements are no circuit, the solver did not converge, the model does not explain the
data, the data do not determine the parameters.
"""

import dataclasses

import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float

from etid.circuits.branches import exchangeable, in_order
from etid.circuits.circuit import AbstractCircuit, too_steep
from etid.estimators import judgement
from etid.estimators.element_limits import Limits, limited, of_circuit, within
from etid.estimators.element_prior import FIXED, ElementPrior
from etid.estimators.judgement import STRAINED, unless
from etid.likelihood.fit import Estimate
from etid.likelihood.linear import diagonal
from etid.likelihood.noise import MISFIT_RRSE, misses
from etid.recordings.remarks import Remark
from etid.results.fit import Fit, Limited, left
from etid.results.verdicts import RESULTS, usable, verdicts_of

ACCEPT = 0.02  # of the signal: a circuit that leaves more is the wrong one


def judged(
    found: Estimate,
    circuit: AbstractCircuit,
    changed: Bool[np.ndarray, " row"],
    driver: RESULTS,
    method: str,
    prior: ElementPrior | None,
    bounds: Limits,
    accept: float,
) -> Fit:
    """The fits with their verdicts.

    Args:
        found: The estimates.
        circuit: Structure of the load.
        changed: Whether unloaded voltages show that the driver has changed.
        driver: Verdict of the driver.
        method: Name of the method.
        prior: What is known of the elements; None if nothing is.
        bounds: Bounds of elements; those of elements that the circuit lacks do not count.
        accept: What a circuit may leave beyond the noise, relative to the signal.
    """
    count = found.logs.shape[-1]
    told, width = np.ones(count), np.full(count, np.inf)
    if prior is not None:
        told, width = np.asarray(prior.told), np.asarray(prior.width)
    own = of_circuit(bounds, circuit)
    found = _ordered(found, circuit, told, width, own)
    values, support = np.exp(found.logs), found.support
    errors = np.sqrt(diagonal(found.cov))  # of the logarithms, so they are relative
    outer = values[:, :, None] * values[:, None, :]
    cov, shared_cov = found.cov * outer, found.shared_cov * outer
    outside, contradicted = None, np.zeros(len(values), bool)
    if own:
        numbers = within(circuit, values, cov, shared_cov, own)
        inside, cov, shared_cov, outside, deviance, contradicted = numbers
        support = dataclasses.replace(support, deviance=support.deviance + deviance)
        errors = np.sqrt(diagonal(cov)) / inside
        sound = np.isfinite(inside).all(-1, keepdims=True)
        values = np.where(sound, inside, values)
    values = np.where(width <= FIXED, told, values)
    late = (np.abs(found.delays) > 1).any(-1)  # the model holds for delays of up to one sample
    rest = left(found.chi2, found.rrse)
    missed = np.where(found.approximate, rest > accept, misses(found.chi2, found.rrse))
    verdicts = (
        (~np.isfinite(found.chi2), "unstable"),
        (~np.isfinite(values).all(-1), "nonphysical"),
        (too_steep(circuit, found.logs, found.cov), "nonphysical"),
        (~found.settled, "max_steps_reached"),
        (missed | late, "misfit"),
        (found.falls, "misfit"),  # which can pass for a change of the driver
        (found.strain > STRAINED, "inconsistent"),
        (contradicted, "out_of_bounds"),
        # An error of 0 also fails: the element has no effect. So does a value of 0, exp() of a far
        # parameter: files of fits hold positive elements where a fit is successful.
        (~((errors > 0) & (errors < 1) & (values > 0)).all(-1), "insensitive"),
        (
            np.full(len(values), ~usable(driver)),
            "driver_failed",
        ),
        (found.inconsistent | changed, "inconsistent"),
        (found.far, "driver_unclear"),
        (found.other, "misfit"),
        (found.approximate & (rest > MISFIT_RRSE), "approximate"),
    )
    conditions, names = zip(*verdicts, strict=True)
    names = np.select(conditions, names, "successful")
    remarks = (
        (found.hum, Remark.mains_hum),
        (found.falls, Remark.falls_with_current),
        (found.doubtful, Remark.gain_doubtful),
        (np.zeros(len(values), bool) if outside is None else (outside != 0).any(-1),
         Remark.at_bound),
    )  # fmt: skip
    return Fit(
        circuit=circuit.of_fit(np.moveaxis(values, -1, 0)),
        cov=cov,
        shared_cov=shared_cov,
        rrse=found.rrse,
        chi2=found.chi2,
        result=verdicts_of(names),
        steps=found.points,
        method=method,
        remarks=np.sum([np.where(on, int(one), 0) for on, one in remarks], axis=0),
        support=support,
        limits=_limits(circuit, own, outside, len(values)),
        by_tolerance=found.effects,
    )


def judged_one(
    found: Estimate,
    circuit: AbstractCircuit,
    driver: RESULTS,
    method: str,
    bounds: Limits,
    prior: ElementPrior | None,
) -> Fit:
    """The same of one estimate by JAX; for the arguments see `judgement.judged`."""
    settled = optx.RESULTS.where(
        found.settled, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    estimate = judgement.Estimate(
        parameters=found.logs,
        delay_samples=found.delays,
        cov=found.cov,
        chi2=found.chi2,
        rrse=found.rrse,
        result=settled,
        steps=found.points,
        shared_cov=found.shared_cov,
        strain=found.strain,
        hum=found.hum,
        falls=found.falls,
        doubtful=found.doubtful,
        support=found.support,
        by_tolerance=found.effects,
    )
    fit = judgement.judged(estimate, circuit, driver, method, bounds, prior)
    fit = unless(fit, found.inconsistent, RESULTS.inconsistent)
    return unless(unless(fit, found.far, RESULTS.driver_unclear), found.other, RESULTS.misfit)


def _limits(
    circuit: AbstractCircuit,
    bounds: Limits,
    outside: Float[np.ndarray, "row element"] | None,
    count: int,
) -> Limited | None:
    """The bounds of the elements of each fit; None without bounds."""
    if outside is None:
        return None
    found = limited(circuit, bounds)
    assert found is not None
    lower, upper = (np.tile(end, (count, 1)) for end in (found.lower, found.upper))
    return Limited(lower, upper, outside)


def _ordered(
    found: Estimate,
    circuit: AbstractCircuit,
    told: Float[np.ndarray, " element"],
    width: Float[np.ndarray, " element"],
    bounds: Limits,
) -> Estimate:
    """The estimates, with branches that can be exchanged in their order."""
    if not exchangeable(type(circuit)):
        return found
    limits = {name: ends for name, *ends in bounds}
    ends = np.array([limits.get(name, (0.0, np.inf)) for name in circuit.names()]).T
    places = np.stack([np.asarray(in_order(circuit, one, told, width, *ends))
                       for one in found.logs])  # fmt: skip
    rows = np.arange(len(places))[:, None]
    both = rows[..., None], places[:, :, None], places[:, None, :]
    support, effects = found.support, found.effects
    by_error = np.take_along_axis(np.asarray(effects.moved), places[:, None, :], -1)
    by_rest = np.asarray(effects.discrepancy)[rows, places]
    return found._replace(
        logs=found.logs[rows, places],
        cov=found.cov[both],
        shared_cov=found.shared_cov[both],
        support=type(support)(
            support.deviance,
            support.terms,
            support.z,
            support.spread_stderr,
            support.spread_slope[rows, places],
            support.layer_shows,
        ),
        effects=type(effects)(by_error, effects.stated, by_rest),
    )
