"""The verdicts of estimates, which make them fits.

If several verdicts apply, the most fundamental one is reported. The order is: the loop cannot be
simulated, the elements are no circuit, the solver did not converge, the model does not explain the
data, the data do not determine the parameters.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from etid.circuits.branches import exchangeable, in_order
from etid.circuits.circuit import AbstractCircuit, too_steep
from etid.estimators.element_limits import Limits, limited, of_circuit, within
from etid.estimators.element_prior import FIXED, ElementPrior
from etid.estimators.judgement import STRAINED
from etid.likelihood.fit import Estimate
from etid.likelihood.linear import diagonal
from etid.likelihood.noise import MISFIT_RRSE, misses
from etid.precision import namespace
from etid.recordings.remarks import Remark
from etid.results.fit import Fit, Limited
from etid.results.verdicts import RESULTS, first_reason, left, usable
from etid.signals.transfer import AnyArray

ACCEPT = 0.02  # of the signal: a circuit that leaves more is the wrong one


def judged(
    found: Estimate,
    circuit: AbstractCircuit,
    changed: Bool[AnyArray, "*row"] | bool,
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
    xp, count = namespace(found.logs), found.logs.shape[-1]
    told, width = np.ones(count), np.full(count, np.inf)
    if prior is not None:
        told, width = prior.told, prior.width
    own = of_circuit(bounds, circuit)
    found = _ordered(found, circuit, told, width, own)
    values, support = xp.exp(found.logs), found.support
    errors = xp.sqrt(diagonal(found.cov))  # of the logarithms, so they are relative
    outer = values[..., :, None] * values[..., None, :]
    cov, shared_cov = found.cov * outer, found.shared_cov * outer
    none = xp.zeros(values.shape[:-1], bool)
    rest = left(found.chi2, found.rrse)
    # A circuit that leaves more than is accepted competes with others without its δ.
    alone = found.approximate & (rest > accept)
    deviance = xp.where(alone, found.chi2 * support.terms, support.deviance)
    outside, contradicted = None, none
    if own:
        numbers = within(circuit, values, cov, shared_cov, own)
        inside, cov, shared_cov, outside, more, contradicted = numbers
        deviance = deviance + more
        errors = xp.sqrt(diagonal(cov)) / inside
        sound = xp.isfinite(inside).all(-1, keepdims=True)
        values = xp.where(sound, inside, values)
    values = xp.where(width <= FIXED, told, values)
    late = (xp.abs(found.delays) > 1).any(-1)  # the model holds for delays of up to one sample
    missed = xp.where(found.approximate, rest > accept, misses(found.chi2, found.rrse))
    reasons = (
        (~xp.isfinite(found.chi2), "unstable"),
        (~xp.isfinite(values).all(-1), "nonphysical"),
        (too_steep(circuit, found.logs, found.cov), "nonphysical"),
        (~found.settled, "max_steps_reached"),
        (missed | late, "misfit"),
        (found.falls, "misfit"),  # which can pass for a change of the driver
        (found.strain > STRAINED, "inconsistent"),
        (contradicted, "out_of_bounds"),
        # An error of 0 also fails: the element has no effect. So does a value of 0, exp() of a far
        # parameter: files of fits hold positive elements where a fit is successful.
        (~((errors > 0) & (errors < 1) & (values > 0)).all(-1), "insensitive"),
        (none | ~usable(driver), "driver_failed"),
        (found.inconsistent | changed, "inconsistent"),
        (found.far, "driver_unclear"),
        (found.other, "misfit"),
        (found.biased, "biased"),
        (found.approximate & (rest > MISFIT_RRSE), "approximate"),
    )
    remarks = (
        (found.hum, Remark.mains_hum),
        (found.falls, Remark.falls_with_current),
        (found.doubtful, Remark.gain_doubtful),
        (none if outside is None else (outside != 0).any(-1), Remark.at_bound),
    )
    return Fit(
        circuit=circuit.of_fit(xp.moveaxis(values, -1, 0)),
        cov=cov,
        shared_cov=shared_cov,
        rrse=found.rrse,
        chi2=found.chi2,
        result=first_reason(reasons),
        steps=found.points,
        method=method,
        remarks=xp.asarray(sum(xp.where(on, int(one), 0) for on, one in remarks)),
        support=dataclasses.replace(support, deviance=xp.asarray(deviance)),
        limits=_limits(circuit, own, outside),
        by_tolerance=found.effects,
    )


def _limits(
    circuit: AbstractCircuit,
    bounds: Limits,
    outside: Float[AnyArray, "*row element"] | None,
) -> Limited | None:
    """The bounds of the elements of each fit; None without bounds."""
    found = limited(circuit, bounds)
    if found is None or outside is None:
        return None
    lower, upper = (end + 0 * outside for end in (found.lower, found.upper))
    return Limited(lower, upper, outside)


def _ordered(
    found: Estimate,
    circuit: AbstractCircuit,
    told: Float[AnyArray, " element"],
    width: Float[AnyArray, " element"],
    bounds: Limits,
) -> Estimate:
    """The estimates, with branches that can be exchanged in their order."""
    if not exchangeable(type(circuit)):
        return found
    limits = {name: ends for name, *ends in bounds}
    ends = np.array([limits.get(name, (0.0, np.inf)) for name in circuit.names()]).T
    places = in_order(circuit, found.logs, told, width, *ends)
    xp, support, effects = namespace(places), found.support, found.effects

    def ordered(numbers: Float[AnyArray, "*row element"]) -> AnyArray:
        return xp.take_along_axis(numbers, places, -1)

    def ordered_both(cov: Float[AnyArray, "*row element element"]) -> AnyArray:
        rows = xp.take_along_axis(cov, places[..., :, None], -2)
        return xp.take_along_axis(rows, places[..., None, :], -1)

    moved = xp.take_along_axis(effects.moved, places[..., None, :], -1)
    return found._replace(
        logs=ordered(found.logs),
        cov=ordered_both(found.cov),
        shared_cov=ordered_both(found.shared_cov),
        support=dataclasses.replace(support, spread_slope=ordered(support.spread_slope)),
        effects=dataclasses.replace(effects, moved=moved, discrepancy=ordered(effects.discrepancy)),
    )
