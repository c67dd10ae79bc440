"""The minimum of the likelihood of a load, by successive approximations.

The likelihood of all harmonics is expensive. Condensed to the knots near one point
(`etid.likelihood.profile`) it is not: the minimum of the condensed terms is the next point, where
it is condensed again. A point that is worse than the best before it is replaced by the middle
between both. Mostly two or three points are enough.

JAX differentiates the minimum as an implicit function. The gradient g of ½ Σ r² of all terms is 0
there, so that with any number θ of the problem the minimum q moves by

    ∂q/∂θ = −H⁻¹ ∂g/∂θ,      H = ∂g/∂q.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from etid.likelihood.gains import Gains
from etid.likelihood.linear import (
    Arrays,
    LevenbergMarquardt,
    NormalEquations,
    chosen,
    conjugate_gradients,
    inverse,
    replaced,
    taken,
)
from etid.likelihood.load import Anew, Load, Near, equations
from etid.precision import array_function, held, in_turn, namespace
from etid.signals.transfer import AnyArray

POINTS = 100  # largest number of points; below 24 dB some fits take dozens
FEWER = 20  # the same with δ, near which the search begins; those that settle take up to seven
BEFORE = 0.05  # [standard errors] largest distance to the minimum before the last step
# [standard errors] An approximation errs by a tenth: if a point so near is no better, the best
# point is the minimum.
NO_BETTER = 0.3
# The same where states make it err by more, of a point so close relative to the step.
ROUGH, CLOSE = 1.0, 2.0**-7
IDLE = 3  # points in a row with a reduction below the rounding errors of ½ Σ r²
ROUNDING = 1e-6  # of ½ Σ r²
NEAR = 4.0  # χ² of the likeliest start; below this value the other starts are not tried
WRONG = 1.5  # χ² of a minimum with states, from which on other starts are tried; wrong ones had 2.7
SAME = 1.0  # variances of a term by which two searches differ that have found one minimum
STEPS = 50  # largest number of steps at the knots of one point
DISTANT = 0.1  # part of ½ Σ r² that a step promises, above which a point is distant
ROUGHLY = 1e-3  # of ½ Σ r², which a step of a rough fit of a distant point reduces
WELL = 0.1  # of the distance `BEFORE`, to which the condensed terms are minimised


@dataclasses.dataclass(frozen=True)
class _Knots:
    """Condensed terms near a point, as a function of the parameters."""

    load: Load
    at_knots: Gains
    near: Near

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        return equations(self.load, self.near, self.at_knots.slopes(q), q)

    def of(self, rows: np.ndarray) -> "_Knots":
        return _Knots(self.load.of(rows), self.at_knots.of(rows), taken(self.near, rows))


class Minimum(NamedTuple):
    """The minimum and what is known of the best point, next to it.

    Attributes:
        q: The minimum, one step from the best point.
        near: The likelihood near the best point.
        promised: Reduction of ½ Σ r² by this step; 0 if the search failed.
        settled: Whether this is the minimum.
        points: Number of points.
    """

    q: Float[AnyArray, "*row q"]
    near: Near
    promised: Float[AnyArray, "*row"]
    settled: Bool[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]


class _State(NamedTuple):
    trial: Float[AnyArray, "*row q"]
    near: Near
    target: Float[AnyArray, "*row q"]
    promised: Float[AnyArray, "*row"]
    settled: Bool[AnyArray, "*row"]
    idle: Int[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]


@array_function
def minimum(
    load: Load, starts: Float[AnyArray, "start *row q"], aside: Float[AnyArray, ""] | float = 0.0
) -> Minimum:
    """The minimum. Under JAX its `q` has a derivative, if the load has no axis of rows.

    Args:
        load: The recordings.
        starts: Starts, the likeliest first.
        aside: Distance of the first delay from that of the start [samples].
    """
    least = _search(load, starts, aside)
    if namespace(least.q) is np:
        return least if load.transient is None else _searched_again(load, starts, aside, least)
    return least._replace(q=_with_derivative(least.q, least.near, load))


def _searched_again(
    load: Load,
    starts: Float[np.ndarray, "start row q"],
    aside: Float[np.ndarray, ""] | float,
    least: Minimum,
) -> Minimum:
    """The minima, some of them from other starts, in NumPy.

    A record that begins in a pulse does not show how its likeliest start is wrong by its states.
    Two starts that lead to the same minimum are enough.
    """

    def fits(least: Minimum, terms: Float[np.ndarray, " row"]) -> Bool[np.ndarray, " row"]:
        return 2 * least.near.objective < WRONG * terms

    wrong = ~fits(least, load.records.terms)
    for start in starts[1:]:
        if not wrong.any():
            break
        rows = np.flatnonzero(wrong)
        other, best = _search(load.of(rows), start[None, rows], aside), taken(least, rows)
        reduced = best.near.objective - other.near.objective
        best = select(reduced > 0, other, best)
        least = replaced(least, rows, best)
        terms = load.records.terms[rows]
        alike = abs(reduced) <= SAME * np.maximum(best.near.objective / terms, 1.0)
        wrong[rows] = ~(fits(best, terms) | alike)
    return least


@jax.custom_jvp
def _with_derivative(
    q: Float[AnyArray, "*row q"], near: Near, load: Load
) -> Float[AnyArray, "*row q"]:
    """The minimum q of a load, next to which the likelihood is known."""
    del near, load
    return q


@_with_derivative.defjvp
@array_function
def _moved(
    primals: tuple[Any, Near, Load], tangents: tuple[Any, Near, Load]
) -> tuple[AnyArray, AnyArray]:
    (q, near, load), (_, _, change) = primals, tangents
    gradient = jax.grad(lambda q, load: load.objective(q))
    _, by_load = jax.jvp(lambda load: gradient(q, load), (load,), (change,))
    _, curved = jax.linearize(lambda q: gradient(q, load), q)
    roughly = equations(load, near, near.slopes, near.q).matrix
    return q, -conjugate_gradients(curved, inverse(roughly), by_load)


@held
def _search(
    load: Load, starts: Float[AnyArray, "start *row q"], aside: Float[AnyArray, ""] | float
) -> Minimum:
    xp, at_knots = namespace(starts), load.gains.at(load.knots.index)
    most = POINTS if load.gains.discrepancy is None else FEWER
    place = np.arange(starts.shape[-1])
    delays = (place >= load.gains.delays.start) & (place < load.gains.delays.stop)
    if load.has_current and load.transient is None:  # all harmonics have told its starts apart
        starts = starts[:1]

    def step(load: Load, at_knots: Gains, state: _State) -> _State:
        near = Near.of(load, at_knots, state.trial)
        reduced = state.near.objective - near.objective
        better = reduced >= 0
        kept = select(better, near, state.near)
        reduced = xp.where(state.points > 0, reduced, 0.0)
        before = state.target, state.promised
        found = _next(load, at_knots, kept, state.trial, better, reduced, state.idle, before)
        return found._replace(points=state.points + 1)

    def goes_on(state: _State) -> Bool[AnyArray, "*row"]:
        finite = xp.isfinite(state.near.objective) | (state.points == 0)
        return ~state.settled & finite & (state.points < most)

    if xp is np:
        near = _likeliest(load, at_knots, starts)
        if load.gains.outputs.count > 1:
            near = _approached(load, at_knots, near)
        if aside != 0:
            near = Near.of(load, at_knots, near.q + aside * delays)
        none, better = np.zeros(starts.shape[1:-1], int), np.isfinite(near.objective)
        nothing = np.zeros_like(near.objective)
        nowhere = near.q, nothing
        state = _next(load, at_knots, near, near.q, better, nothing, none, nowhere)
        while (live := np.flatnonzero(goes_on(state))).size:
            if live.size == len(none):
                state = step(load, at_knots, state)
            else:
                part = step(load.of(live), at_knots.of(live), taken(state, live))
                state = replaced(state, live, part)
    else:
        start = _best(load, at_knots, starts)
        if load.gains.outputs.count > 1:
            start = _approached(load, at_knots, Near.of(load, at_knots, start)).q
        # Only the loop evaluates the likelihood: each copy of its text compiles for a second.
        state = jax.lax.while_loop(
            lambda state: goes_on(state).any(),
            lambda state: select(goes_on(state), step(load, at_knots, state), state),
            _nowhere(load, at_knots, start + aside * delays),
        )
    q = xp.where(state.settled[..., None], state.target, state.near.q)
    promised = xp.where(state.settled, state.promised, 0.0)
    return Minimum(q, state.near, promised, state.settled, state.points)


def _nowhere(load: Load, at_knots: Gains, start: Float[AnyArray, "*row q"]) -> _State:
    """The state before the first point, under JAX."""
    shapes = jax.eval_shape(lambda q: Near.of(load, at_knots, q), start)
    near = jax.tree.map(lambda of: jnp.full(of.shape, np.nan, of.dtype), shapes)
    infinite = jnp.full_like(near.objective, np.inf)
    none = jnp.zeros(infinite.shape, int)
    near = near._replace(objective=infinite)
    return _State(start, near, start, infinite, infinite < 0, none, none)


def _likeliest(load: Load, at_knots: Gains, starts: Float[AnyArray, "start *row q"]) -> Near:
    """The likelihood near the best start in NumPy, which tries the others only where it needs."""
    first = Near.of(load, at_knots, starts[0])
    far = ~(2 * first.objective < NEAR * load.records.terms)
    if len(starts) == 1 or not far.any():
        return first
    rows, of = np.flatnonzero(far), load.of(np.flatnonzero(far))
    near = Near.of(of, at_knots.of(rows), _best(of, at_knots.of(rows), starts[:, rows]))
    return replaced(first, rows, near) if rows.size < far.size else near


def _best(
    load: Load, at_knots: Gains, starts: Float[AnyArray, "start *row q"]
) -> Float[AnyArray, "*row q"]:
    """The first start, or the best of all where its χ² is large.

    The harmonics at the knots tell starts apart, at a fifteenth of the time of all.
    """
    if len(starts) == 1:
        return starts[0]
    xp, used = namespace(starts), load.records.used[..., load.knots.index]
    objectives = load.at_knots(starts, at_knots).objective
    objectives = objectives + 0.5 * (load.rest(starts) ** 2).sum(-1)
    place = likeliest(objectives, 2.0 * used.sum((-2, -1)))
    return xp.take_along_axis(starts, place[None, ..., None], 0)[0]


def likeliest(
    objectives: Float[AnyArray, "start *row"], terms: Float[AnyArray, "*row"]
) -> Int[AnyArray, "*row"]:
    """Number of the first start, or of the best of all where its χ² is large."""
    xp = namespace(objectives)
    near = 2 * objectives[0] < NEAR * terms
    objectives = xp.where(xp.isfinite(objectives), objectives, np.inf)
    return xp.where(near, 0, xp.argmin(objectives, axis=0))


def _approached(load: Load, at_knots: Gains, near: Near) -> Near:
    """The likelihood near a point from which an approximation leads on, if `near` is far away.

    The starts with a current have no delays, and an approximation so far from the minimum may lead
    away. So the likelihood is condensed anew at each step of Levenberg-Marquardt.
    """
    problem = Anew(load, at_knots)
    search = LevenbergMarquardt(damping=1e-2, steps=STEPS)
    found = search(problem, near.q, problem.at(near), ROUGHLY * near.objective)
    return Near.of(load, at_knots, found.q)


def _next(
    load: Load,
    at_knots: Gains,
    near: Near,
    last: Float[AnyArray, "*row q"],
    better: Bool[AnyArray, "*row"],
    reduced: Float[AnyArray, "*row"],
    idle: Int[AnyArray, "*row"],
    before: tuple[Float[AnyArray, "*row q"], Float[AnyArray, "*row"]],
) -> _State:
    """Where the search goes from the best point.

    `better` says whether the last one is the best. If not, the minimum of the approximation and
    what it promises are those of `before`.
    """
    xp, best, scale = namespace(near.q), near.q, near.objective / load.records.terms
    here = equations(load, near, near.slopes, best)
    newton = here.step()
    promised = here.promised(newton)
    close = promised <= BEFORE**2 * scale
    target = xp.where(close[..., None], best + newton, best)
    goes = better & ~close & xp.isfinite(promised)
    if xp is not np or goes.any():
        target, left = _followed(load, at_knots, near, here, target, goes, promised)
        promised = xp.where(goes, here.objective - left, promised)
    found = xp.where(better[..., None], target, before[0]), xp.where(better, promised, before[1])
    going = decided(best, near.objective, scale, found, last, better, reduced, idle)
    trial, target, promised, settled, idle = going
    return _State(trial, near, target, promised, settled, idle, xp.ones_like(idle))


class _Stage(NamedTuple):
    """Where a part of a search at the knots has ended, and whether it would move on."""

    q: Float[AnyArray, "*row q"]
    equations: NormalEquations
    moves: Bool[AnyArray, "*row"]


class Decision(NamedTuple):
    """Where a search by successive approximations goes.

    Attributes:
        trial: The next point.
        target: The minimum of the approximation near the best point.
        promised: Reduction of ½ Σ r² by the step to it.
        settled: Whether it is the minimum.
        idle: Points in a row that have brought nothing.
    """

    trial: Float[AnyArray, "*row q"]
    target: Float[AnyArray, "*row q"]
    promised: Float[AnyArray, "*row"]
    settled: Bool[AnyArray, "*row"]
    idle: Int[AnyArray, "*row"]


def decided(
    best: Float[AnyArray, "*row q"],
    objective: Float[AnyArray, "*row"],
    scale: Float[AnyArray, "*row"],
    found: tuple[Float[AnyArray, "*row q"], Float[AnyArray, "*row"]],
    last: Float[AnyArray, "*row q"],
    better: Bool[AnyArray, "*row"],
    reduced: Float[AnyArray, "*row"],
    idle: Int[AnyArray, "*row"],
    rough: bool = False,
) -> Decision:
    """The next point, and whether the search ends.

    Args:
        best: The best point.
        objective: ½ Σ r² there.
        scale: The same for each term.
        found: The minimum of the approximation near the best point, and what it promises.
        last: The last point.
        better: Whether it is the best.
        reduced: By how much it is better.
        idle: Points in a row before it that have brought nothing.
        rough: Whether the approximation errs by more, as it does for the states of a driver.
    """
    xp, (target, promised) = namespace(best), found
    stays = ~better & (promised <= NO_BETTER**2 * scale)
    if rough:
        close = (xp.abs(last - best) <= CLOSE * xp.abs(target - best)).all(-1)
        stays = stays | (~better & close & (promised <= ROUGH**2 * scale))
    target = xp.where(stays[..., None], best, target)
    promised = xp.where(stays, 0.0, promised)
    idles = xp.maximum(xp.abs(reduced), promised) <= ROUNDING * objective
    idle = xp.where(idles, idle + 1, 0)
    trial = xp.where(better[..., None], target, 0.5 * (last + best))
    trial = xp.where(xp.isfinite(trial).all(-1)[..., None], trial, best)
    settled = (promised <= BEFORE**2 * scale) | (idle >= IDLE)
    return Decision(trial, target, promised, settled, idle)


def _followed(
    load: Load,
    at_knots: Gains,
    near: Near,
    here: NormalEquations,
    target: Float[AnyArray, "*row q"],
    goes: Bool[AnyArray, "*row"],
    promised: Float[AnyArray, "*row"],
) -> tuple[Float[AnyArray, "*row q"], Float[AnyArray, "*row"]]:
    """The minimum of the condensed terms in the rows that go on, and the objective there.

    From a distant point, a joint fit would distort Z_th: the own parameters go first.
    """
    xp = namespace(target)
    if xp is np and not goes.all():
        rows, found = np.flatnonzero(goes), target.copy()
        left = np.zeros(target.shape[:-1])
        of = taken(near, rows), taken(here, rows), target[rows], goes[rows], promised[rows]
        found[rows], left[rows] = _followed(load.of(rows), at_knots.of(rows), *of)
        return found, left
    at, scale = near.q, near.objective / load.records.terms
    own = np.arange(at.shape[-1]) < load.gains.owned
    distant = goes & (promised >= DISTANT * near.objective)
    problem = _Knots(load, at_knots, near)

    def stage(
        state: _Stage,
        free: Bool[AnyArray, " q"],
        damping: Float[AnyArray, ""],
        enough: Float[AnyArray, "*row"],
    ) -> _Stage:
        if xp is np and not np.isfinite(enough).any():
            return state
        search = LevenbergMarquardt(damping, STEPS, free=free)
        found = search(problem, state.q, state.equations, enough)
        return _Stage(found.q, found.equations, found.moves)

    enough = (
        xp.where(distant, ROUGHLY * near.objective, np.inf),
        xp.where(goes, (WELL * BEFORE) ** 2 * scale, np.inf),
    )
    stages = xp.stack([own, own | True]), np.array([1e-2, 1e-9]), xp.stack(enough)
    last = in_turn(stage, _Stage(at, here, ~goes), stages)
    # A fit that did not settle promises everything: it is at no minimum.
    left = xp.where(last.moves, -np.inf, last.equations.objective)
    return xp.where(goes[..., None], last.q, target), left


def select(rows: Bool[AnyArray, "*row"], new: Arrays, old: Arrays) -> Arrays:
    """All arrays, from `new` in these rows and from `old` in the others."""
    if isinstance(rows, np.ndarray):
        if rows.all():
            return new
        if not rows.any():
            return old
    leaves, structure = jax.tree.flatten(new)
    return structure.unflatten(chosen(rows, leaves, jax.tree.leaves(old)))
