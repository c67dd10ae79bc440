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
from etid.solvers import least_squares, successive
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations

STEPS = 50  # largest number of steps at the knots of one point


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
