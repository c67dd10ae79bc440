"""The search for the minimum of the likelihood of a load.

At each point the likelihood of all harmonics is condensed to the knots
(`etid.estimators.maximum_likelihood.condensed`), and the minimum of the condensed terms is the next
point (`etid.solvers.successive`).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.estimate import SOLVER
from etid.estimators.maximum_likelihood.condensed import Near, apart
from etid.estimators.maximum_likelihood.gains import Gains
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.transfer import combined
from etid.solvers import least_squares, successive
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations

STEPS = 50  # largest number of steps at the knots of one point
# Scale of a step in the logarithm of an element, and in a delay [samples].
FARTHEST = 3.0
DISTANT = 0.1  # part of ½ Σ r² that a step promises, above which a point is distant
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried


class _AtKnots(NamedTuple):
    """The condensed terms of a load near one point, of which some parameters are fixed."""

    gains: Gains
    near: Near
    free: Bool[Array, " q"]


def _equations(_, q: Float[Array, " q"], of: _AtKnots) -> NormalEquations:
    """Normal equations of the condensed terms, of the priors, and of the distance from the point.

    The distance keeps a step where the approximation holds (the proximal point algorithm of
    Rockafellar 1976). At the minimum it has no effect.
    """
    near, at = of.near, of.near.q
    slopes = apart(of.gains.slopes, q)
    gains, rows = slopes.gains, near.condensed.rows(near.by_unknown(slopes))
    if near.by_x is not None:
        moved = of.gains.split(q)[2] - of.gains.split(at)[2]
        gains = gains + gains * combined(moved, near.by_x)[None, :]
    rows = jnp.where(of.free[:, None], rows, 0.0)
    rows = jnp.concatenate([rows, near.condensed.terms(gains)[None, :]])
    products = rows @ rows.T  # one matrix product gives all sums
    prior = 1 / of.gains.widths(q)
    rest = prior * (q - of.gains.centre(q))
    close = jnp.where(jnp.arange(q.size) < of.gains.owned, 1 / FARTHEST, 0.0)
    off = close * (q - at)
    return NormalEquations(
        0.5 * (products[-1, -1] + jnp.dot(rest, rest) + jnp.dot(off, off)),
        products[:-1, -1] + prior * rest + close * off,
        products[:-1, :-1] + jnp.diag(prior**2 + close**2),
    ).finite()


def _equations_of_load(_, q: Float[Array, " q"], load: Load) -> NormalEquations:
    """The same with the terms condensed at `q`, and the objective of all harmonics."""
    near, objective = _approximate(load, q)
    terms = _AtKnots(load.gains.at(load.knots), near, jnp.ones(q.size, bool))
    return dataclasses.replace(_equations(None, q, terms), objective=objective).finite()


def _approximate(load: Load, q: Float[Array, " q"]) -> tuple[Near, Float[Array, ""]]:
    """The load near `q`, and ½ Σ r² of all harmonics there."""
    near, rest = load.near(q), load.rest(q)
    return near, near.objective + 0.5 * jnp.dot(rest, rest)


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
    solver = dataclasses.replace(ROUGHLY, equations=_equations_of_load)
    return least_squares.stepped(None, solver, best, load, STEPS)[0]


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
    every = jnp.ones(start.size, bool)
    free = jnp.stack([jnp.arange(start.size) < load.gains.owned, every])
    fields = jnp.array([[of.rtol, of.ftol, of.damping] for of in (ROUGHLY, WELL)])

    def follow(
        q: Float[Array, " q"], near: Near, objective: Float[Array, ""]
    ) -> tuple[Float[Array, " q"], Float[Array, ""]]:
        here = _equations(None, q, _AtKnots(gains, near, every))
        newton = here.newton()
        promised = -0.5 * jnp.dot(newton, here.gradient)
        close = successive.close(promised, objective, load.terms)
        wanted = jnp.stack([~(promised < DISTANT * objective), ~close])

        def stage(
            q: Float[Array, " q"], of: tuple[Float[Array, "3"], Bool[Array, " q"], Bool[Array, ""]]
        ) -> tuple[Float[Array, " q"], Float[Array, ""]]:
            (rtol, ftol, damping), free, wanted = of
            solver = dataclasses.replace(
                WELL, rtol=rtol, ftol=ftol, damping=damping, equations=_equations
            )
            terms = _AtKnots(gains, near, free)

            def stepped(q: Float[Array, " q"]) -> tuple[Float[Array, " q"], Float[Array, ""]]:
                q, (_, result, last) = least_squares.stepped(None, solver, q, terms, STEPS)
                return q, successive.promised(here.objective - last.objective, result)

            return jax.lax.cond(wanted, stepped, lambda q: (q, jnp.zeros(())), q)

        target, reduced = jax.lax.scan(stage, q, (fields, free, wanted))
        target = jnp.where(close, q + newton, target)
        return target, jnp.where(close, promised, reduced[-1])

    return successive.approached(lambda q: _approximate(load, q), follow, start, load.terms)
