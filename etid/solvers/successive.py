"""The minimum of a likelihood by successive approximations.

A likelihood of many harmonics is expensive; an approximation of it near one point is not
(`etid.estimators.maximum_likelihood.condensed`). The minimum of the approximation is the next
point, where the likelihood is approximated again. A point that is worse than the best before it is
replaced by the middle between both. Mostly two or three points are enough.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

POINTS = 100  # largest number of points; below 24 dB some fits take dozens
BEFORE = 0.05  # [standard errors] largest distance to the minimum before the last step
# [standard errors] An approximation errs by a tenth: if a point so near is no better, the best
# point is the minimum.
NO_BETTER = 0.3
IDLE = 3  # points in a row with a reduction below the rounding errors of ½ Σ r²
ROUNDING = 1e-6  # of ½ Σ r²

Approximate = Callable[[Float[Array, " q"]], tuple[Any, Float[Array, ""]]]
Follow = Callable[
    [Float[Array, " q"], Any, Float[Array, ""]], tuple[Float[Array, " q"], Float[Array, ""]]
]


class Minimum(NamedTuple):
    """The best point and what is known there.

    Attributes:
        point: The best point.
        near: The approximation near it.
        objective: ½ Σ r² there.
        promised: Reduction of it by the step to the minimum; 0 if the search failed.
        result: Verdict of the search.
        points: Number of points.
    """

    point: Float[Array, " q"]
    near: Any
    objective: Float[Array, ""]
    promised: Float[Array, ""]
    result: optx.RESULTS
    points: Int[Array, ""]


def close(
    promised: Float[Array, ""], objective: Float[Array, ""], terms: Float[Array, ""] | int
) -> Bool[Array, ""]:
    """Whether a step that promises this is the last; in units of the residual, whatever χ² is."""
    return promised <= BEFORE**2 * objective / terms


def promised(reduction: Float[Array, ""], result: optx.RESULTS) -> Float[Array, ""]:
    """The reduction of ½ Σ r² by a fit of an approximation; infinite if the fit did not settle.

    A solver that cannot move reduces nothing, but it is at no minimum.
    """
    return jnp.where(result == optx.RESULTS.successful, reduction, jnp.inf)


class _State(NamedTuple):
    trial: Float[Array, " q"]
    best: Float[Array, " q"]
    near: Any
    objective: Float[Array, ""]
    target: Float[Array, " q"]
    promised: Float[Array, ""]
    settled: Bool[Array, ""]
    idle: Int[Array, ""]
    points: Int[Array, ""]


def approached(
    approximate: Approximate,
    follow: Follow,
    start: Float[Array, " q"],
    terms: Float[Array, ""] | int,
) -> tuple[Float[Array, " q"], Minimum]:
    """The minimum, one step from the best point.

    Args:
        approximate: The likelihood near a point, and ½ Σ r² at it.
        follow: The minimum of an approximation, from its point, where ½ Σ r² is given, and the
            reduction of ½ Σ r².
        start: First point.
        terms: Number of terms r; ½ Σ r² is about half of it if the model is right.
    """
    # JAX remembers the trace of this function: its shapes and its use in the loop need only one.
    evaluate = jax.jit(lambda q: approximate(q))

    def goes_on(state: _State) -> Bool[Array, ""]:
        finite = jnp.isfinite(state.objective) | (state.points == 0)
        return ~state.settled & finite & (state.points < POINTS)

    def again(state: _State) -> _State:
        near, objective = evaluate(state.trial)
        reduced = state.objective - objective
        better = (reduced >= 0) | (state.points == 0)
        best, near, objective = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (state.trial, near, objective),
            (state.best, state.near, state.objective),
        )
        target, promised = follow(best, near, objective)
        stays = ~better & (promised <= NO_BETTER**2 * objective / terms)
        target, promised = jnp.where(stays, best, target), jnp.where(stays, 0.0, promised)
        idle = jnp.maximum(jnp.abs(reduced), promised) <= ROUNDING * objective
        idle = jnp.where(idle, state.idle + 1, 0)
        next_one = jnp.where(better, target, 0.5 * (state.trial + best))
        trial = jnp.where(jnp.isfinite(next_one).all(), next_one, best)
        settled = close(promised, objective, terms) | (idle >= IDLE)
        points = state.points + 1
        return _State(trial, best, near, objective, target, promised, settled, idle, points)

    near, objective = jax.tree.map(
        lambda of: jnp.zeros(of.shape, of.dtype), jax.eval_shape(evaluate, start)
    )
    zero, none = jnp.zeros_like(objective), jnp.array(0)
    first = _State(start, start, near, objective, start, zero, jnp.array(False), none, none)
    last = jax.lax.while_loop(goes_on, again, first)
    result = optx.RESULTS.where(
        last.settled, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    promised = jnp.where(last.settled, last.promised, 0.0)
    found = Minimum(last.best, last.near, last.objective, promised, result, last.points)
    return jnp.where(last.settled, last.target, last.best), found
