"""One driver, many loads: a joint maximum-likelihood fit whose cost is linear in the loads.

The normal equations are an arrowhead (`etid.arrowhead`; Pintelon and Schoukens, System
Identification, 2012, ch. 9), of which a few loads at a time are evaluated side by side.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from etid.arrowhead import Arrowhead, ArrowheadEquations, EliminationDescent, join
from etid.levenberg_marquardt import LevenbergMarquardt, normal_equations, second_order
from etid.maximum_likelihood import Joint
from etid.output_error import MAX_STEPS, SOLVER, Estimate
from etid.shared_errors import estimates
from etid.shared_terms import DriverStudy, Loads, over

NEAR = 0.05  # standard errors of all parameters together from their minimum


def _equations(_, y: Float[Array, " parameter"], study: DriverStudy) -> ArrowheadEquations:
    """Normal equations of a study, load by load."""
    common, parts = study.split(y)
    c = common.size

    def one(load, own):
        found = normal_equations(
            lambda q, _: study.of_load(load, q[:c], q[c:]), jnp.concatenate([common, own])
        )
        return jax.tree.map(lambda leaf: jnp.where(load.used, leaf, 0.0), found)

    found = [over(one, loads, own) for loads, own in zip(study.groups, parts, strict=True)]
    loads = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
    known = normal_equations(lambda q, _: study.of_calibrations(q), common)
    return ArrowheadEquations(
        known.objective + loads.objective.sum(),
        join(known.gradient + loads.gradient[:, :c].sum(0), loads.gradient[:, c:]),
        Arrowhead(
            known.matrix + loads.matrix[:, :c, :c].sum(0),
            loads.matrix[:, c:, :c],
            loads.matrix[:, c:, c:],
        ),
    )


def _empty(y: Float[Array, " parameter"], study: DriverStudy) -> ArrowheadEquations:
    shapes = jax.eval_shape(lambda: _equations(None, y, study))
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


def _second_order(_, y, step, study: DriverStudy) -> Float[Array, " parameter"]:
    """Jᵀ r″ of a study, load by load."""
    (common, parts), (towards, steps) = study.split(y), study.split(step)
    c = common.size

    def one(load, own, step):
        bent = second_order(
            lambda q, _: study.of_load(load, q[:c], q[c:]),
            jnp.concatenate([common, own]),
            jnp.concatenate([towards, step]),
        )
        return jnp.where(load.used, bent, 0.0)

    found = [over(one, *lanes) for lanes in zip(study.groups, parts, steps, strict=True)]
    loads = jnp.concatenate(found)
    known = second_order(lambda q, _: study.of_calibrations(q), common, towards)
    return join(known + loads[:, :c].sum(0), loads[:, c:])


def fit(
    model: Joint, groups: list[Loads], several: Sequence[int]
) -> tuple[Float[Array, " common"], Float[Array, "common common"], list[Estimate]]:
    """Identify all loads and their driver.

    Args:
        model: Calibrations, kind of circuit, and the driver to start from.
        groups: The recordings, one group for each length.
        several: In each group, how many unloaded records several loads have.

    Returns:
        Common parameters, their covariance, and the estimates of each group, stacked. In them
        `shared_cov` is what the uncertainty of `common`, and the noise of an unloaded record that
        is not the load's alone, add: it is the same in every load.
    """
    study = DriverStudy(model, groups)
    # The sum of squares grows with the number of loads, what can be seen in it does not.
    terms = sum(2 * loads.spectrum.x.size for loads in groups)
    count = sum(loads.sample_rate.shape[0] for loads in groups)
    solver = LevenbergMarquardt(
        rtol=NEAR / math.sqrt(terms),
        ftol=SOLVER.ftol / (1 + count),
        geodesic=True,
        descent=EliminationDescent(),
        equations=_equations,
        second_order=_second_order,
        empty=_empty,
    )
    solution = optx.least_squares(
        lambda y, study: study(y), solver, study.start(), study, max_steps=MAX_STEPS, throw=False
    )
    common, parts = study.split(solution.value)
    # The loads that take no part have been waiting for Z_th.
    refitted = [
        over(lambda load, own: _refit(study, load, common, own), loads, own)
        for loads, own in zip(groups, parts, strict=True)
    ]
    cov, found = estimates(study, common, refitted, several, solution)
    return common, cov, found


def _refit(study: DriverStudy, load: Loads, common, own):
    """A load at its minimum with this Z_th, and how its solver ended."""
    solution = optx.least_squares(
        lambda own, _: study.of_load(load, common, own),
        SOLVER,
        own,
        max_steps=MAX_STEPS,
        throw=False,
    )
    return solution.value, solution.result
