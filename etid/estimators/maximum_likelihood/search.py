"""The search for the minimum of the likelihood of a load.

At each point the likelihood of all harmonics is condensed to the knots
(`etid.estimators.maximum_likelihood.condensed`), and the minimum of the condensed terms is the next
point (`etid.solvers.successive`).
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.estimate import SOLVER
from etid.estimators.maximum_likelihood.load import AtKnots, Load, Near
from etid.estimators.unknowns import LoadUnknowns
from etid.solvers import least_squares, successive
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations

STEPS = 50  # largest number of steps at the knots of one point
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried


def _equations(_, q: Float[Array, " q"], terms: AtKnots) -> NormalEquations:
    """Normal equations of the condensed terms and of the priors."""
    found, prior = terms.equations(q), 1 / terms.gains.widths(q)
    rest = prior * (q - terms.gains.centre(q))
    return NormalEquations(
        found.objective + 0.5 * jnp.dot(rest, rest),
        found.gradient + prior * rest,
        found.matrix + jnp.diag(prior**2),
    ).finite()


ROUGHLY = LevenbergMarquardt(rtol=1e-2, ftol=1e-3)
# Next to a minimum, damping would only hold back what the data hardly determine.
WELL = LevenbergMarquardt(rtol=1e-4, ftol=SOLVER.ftol, damping=1e-9)


def best_start(load: Load, candidates: LoadUnknowns) -> Float[Array, " own"]:
    """The candidate that predicts best; `_best` has the rule."""
    if load.gains.prior is not None:
        placed = load.gains.prior.placed(candidates.log_elements)
        candidates = LoadUnknowns(placed, candidates.delay_samples)
    best = _best(load, jnp.pad(candidates.vector(), ((0, 0), (0, load.gains.outputs - 1))))
    if load.gains.outputs == 1:
        return best
    # These starts have no delays, and an approximation so far from the minimum may lead away.
    return least_squares.stepped(lambda q, load: load(q), ROUGHLY, best, load, STEPS)[0]


def _best(load: Load, starts: Float[Array, "start own"]) -> Float[Array, " own"]:
    """The likeliest start, which is the last, or the best of all if χ² of the likeliest is large.

    One loop holds the only copy of the terms: each copy compiles for 0.2 s.
    """
    # The minimum does not depend on its start, and a loop of unknown length has no gradient.
    load, starts = jax.lax.stop_gradient((load, starts))
    limit = NEAR * load.terms
    likeliest = starts.shape[0] - 1

    def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        number, _, least = state
        return (number >= 0) & ((number != likeliest - 1) | ~(least < limit))

    def tried(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, best, least = state
        squares = jnp.sum(load(starts[number]) ** 2)
        squares = jnp.where(jnp.isfinite(squares), squares, jnp.inf)
        better = squares <= least
        return number - 1, jnp.where(better, number, best), jnp.minimum(squares, least)

    first = jnp.array(likeliest), jnp.array(likeliest), jnp.array(jnp.inf, starts.dtype)
    return starts[jax.lax.while_loop(goes_on, tried, first)[1]]


def minimum(load: Load, start: Float[Array, " q"]) -> tuple[Float[Array, " q"], successive.Minimum]:
    """The minimum over the own parameters, and over z if `start` contains it."""
    return least_squares.minimum(lambda q, load: load(q), _search, start, load)


def _search(start: Float[Array, " q"], load: Load) -> tuple[Float[Array, " q"], successive.Minimum]:
    """The minimum, without a derivative."""
    gains = load.gains.at(load.knots)
    # From a distant start, a joint fit would distort Z_th: the own parameters go first. One loop
    # holds both fits, because each compiles for half a second.
    free = jnp.stack([jnp.arange(start.size) < load.gains.owned, jnp.ones(start.size, bool)])
    fields = jnp.array([[of.rtol, of.ftol, of.damping] for of in (ROUGHLY, WELL)])

    def approximate(q: Float[Array, " q"]) -> tuple[Near, Float[Array, ""]]:
        near, rest = load.near(q), load.rest(q)
        return near, near.profile.objective + 0.5 * jnp.dot(rest, rest)

    def follow(q: Float[Array, " q"], near: Near) -> tuple[Float[Array, " q"], Float[Array, ""]]:
        def stage(
            q: Float[Array, " q"], of: tuple[Float[Array, "3"], Bool[Array, " q"]]
        ) -> tuple[Float[Array, " q"], Float[Array, ""]]:
            (rtol, ftol, damping), free = of
            solver = dataclasses.replace(
                WELL, rtol=rtol, ftol=ftol, damping=damping, equations=_equations
            )
            terms = AtKnots(gains, near, free)
            q, (_, _, found) = least_squares.stepped(lambda q, of: of(q), solver, q, terms, STEPS)
            return q, found.objective

        rest, part = load.rest(q), near.condensed.part
        before = 0.5 * (jnp.dot(rest, rest) + jnp.dot(part, part))
        q, objectives = jax.lax.scan(stage, q, (fields, free))
        return q, before - objectives[-1]

    return successive.approached(approximate, follow, start, load.terms)
