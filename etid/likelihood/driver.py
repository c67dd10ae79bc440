"""The driver of some calibrations, from several starts side by side.

Some steps with bands of harmonics (`etid.signals.knots`) bring the starts near their minima. From a
distant start, the derivatives of the terms themselves, which contain their noise, find deeper
minima than those with X̂. Then each goes to its minimum with all harmonics, by successive
approximations like those of `etid.likelihood.search`, and the deepest is the driver. The start that
is behind after a hundred steps may be the one that ends deepest; one is left out only if the
minimum of its approximation is above the deepest point, or if it creeps far above it.

Z_th and a delay form a curved valley, along which a fit creeps. So the steps at the knots follow
its curvature: there are a quarter as many.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.likelihood.calibrations import Calibrations, Near
from etid.likelihood.gains import Slopes
from etid.likelihood.linear import (
    DIFFERENCE,
    LevenbergMarquardt,
    NormalEquations,
    bend,
    repeated,
    replaced,
    taken,
)
from etid.likelihood.search import BEFORE, POINTS, WELL, decided, select
from etid.precision import array_function, namespace
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import AnyArray, as_complex, power

ROUGHLY = 0.2  # [standard errors] length of the last steps with bands
ROUGH_STEPS = 60  # with bands; with half of them a driver takes twice as long, with more as long
PATIENCE = 3  # short steps that end a search: a step after a rejected one is short, too
SURE = 2  # points of a start after which its approximation says where it ends
BEHIND = 1.0  # of ½ Σ r² above the deepest point, where a start may end no more
# A start is left out that needs more points like its last one to come to the deepest. In 260 fits
# of drawn transformers, of one and three periods, a start that ended deepest needed at most 11.
REACH = 20
MAX_STEPS = 500  # at the knots of one point


@dataclasses.dataclass(frozen=True)
class _Bands:
    """The terms of all bands, with their own derivatives."""

    model: Calibrations

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        xp, s = namespace(q), self.model.spectra
        slopes, (weak, by_weak) = self.model.slopes(q), self.model.weak(q)
        expected = s.variance_y + power(slopes.gains) * s.variance_x
        scale = as_complex(xp.where(s.selected, xp.sqrt(2 / expected), 0.0))
        missed = (s.y - slopes.gains * s.x) * scale
        # A change of a gain also changes the variance that its term is scaled by.
        towards = xp.conj(slopes.gains) * as_complex(s.variance_x / expected)
        rows = slopes.by_q * (-s.x * scale)[..., None, :, :]
        rows = rows - missed[..., None, :, :] * (slopes.by_q * towards[..., None, :, :]).real
        flat = [real_parts(each.reshape(*each.shape[:-2], -1)) for each in (missed, rows)]
        terms, rows = xp.concatenate([flat[0], weak], -1), xp.concatenate([flat[1], by_weak], -1)
        return NormalEquations.of(terms, rows)

    def of(self, rows: np.ndarray) -> "_Bands":
        del rows  # all starts are of the same calibrations
        return self


@dataclasses.dataclass(frozen=True)
class AtKnots:
    """Condensed terms near a point, as `linear.Curved`."""

    model: Calibrations
    near: Near

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        """The normal equations at a point."""
        return self.at(q, self.model.slopes(q, self.model.knots))

    def bend(
        self, q: Float[AnyArray, "*row q"], at: NormalEquations, move: Float[AnyArray, "*row q"]
    ) -> Float[AnyArray, "*row q"]:
        """Jᵀ r″ of a step from a point."""
        q = q + DIFFERENCE * move
        ahead = self.near.terms(q, self.model.gains(q, self.model.knots))
        return bend(at, namespace(q).concatenate([ahead, self.model.weak(q)[0]], -1), move)

    def at(self, q: Float[AnyArray, "*row q"], slopes: Slopes) -> NormalEquations:
        """The normal equations where the slopes are known."""
        xp, near, (weak, by_weak) = namespace(q), self.near, self.model.weak(q)
        at = xp.concatenate([near.terms(q, slopes.gains), weak], -1)
        rows = xp.concatenate([near.rows(slopes), by_weak], -1)
        return NormalEquations.of(at, rows)

    def of(self, rows: np.ndarray) -> "AtKnots":
        """Some of the rows."""
        return AtKnots(self.model, taken(self.near, rows))


@array_function
def brought_near(
    model: Calibrations, bands: Spectrum, starts: Float[AnyArray, "start q"]
) -> tuple[Float[AnyArray, "start q"], Int[AnyArray, "start"]]:
    """Points near the minima of the starts, and the steps to them, with bands of the harmonics.

    Each calibration has an X of its own here, as if no two shared an unloaded record.
    """
    problem = _Bands(dataclasses.replace(model, spectra=bands, instrument=None))
    search = LevenbergMarquardt(1e-2, ROUGH_STEPS, PATIENCE)
    found = search(problem, starts, problem.equations(starts), 0.5 * ROUGHLY**2)
    return found.q, found.steps


class Minimum(NamedTuple):
    """The minimum with all harmonics.

    Attributes:
        q: The common parameters.
        objective: ½ Σ r² next to it.
        matrix: Curvature there.
        settled: Whether it is a minimum.
        points: Number of points of the search.
    """

    q: Float[AnyArray, "*row q"]
    objective: Float[AnyArray, "*row"]
    matrix: Float[AnyArray, "*row q q"]
    settled: Bool[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]


class _Followed(NamedTuple):
    """The minimum at the knots near a point, what it promises, and the curvature there."""

    q: Float[AnyArray, "*row q"]
    promised: Float[AnyArray, "*row"]
    matrix: Float[AnyArray, "*row q q"]


class _State(NamedTuple):
    """Where the search is: the best point, what is known there, and the next one.

    `gained` is what the last better point has brought.
    """

    near: Near
    objective: Float[AnyArray, "*row"]
    gained: Float[AnyArray, "*row"]
    ahead: _Followed
    target: Float[AnyArray, "*row q"]
    trial: Float[AnyArray, "*row q"]
    settled: Bool[AnyArray, "*row"]
    idle: Int[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]
    moves: Bool[AnyArray, "*row"]


@array_function
def minimum(model: Calibrations, start: Float[AnyArray, "*row q"]) -> Minimum:
    """The minimum of the likelihood of all harmonics."""
    xp = namespace(start)

    def evaluated(q: Float[AnyArray, "*row q"]) -> tuple[Near, Float[AnyArray, "*row"]]:
        near, (weak, _) = model.near(q), model.weak(q)
        return near, near.objective + 0.5 * (weak**2).sum(-1)

    def followed(near: Near, unit: Float[AnyArray, "*row"]) -> _Followed:
        problem = AtKnots(model, near)
        first, enough = problem.at(near.q, near.slopes), (WELL * BEFORE) ** 2 * unit
        found = LevenbergMarquardt(1e-6, MAX_STEPS, PATIENCE, True)(problem, near.q, first, enough)
        # A fit that did not settle promises everything: it is at no minimum.
        left = xp.where(found.moves, -np.inf, found.equations.objective)
        return _Followed(found.q, first.objective - left, found.equations.matrix)

    def ahead(near: Near, objective: AnyArray, better: AnyArray, before: _Followed) -> _Followed:
        """The minimum at the knots near the best points, of which only better ones are new."""
        unit = objective / model.terms
        if xp is not np or start.ndim == 1 or better.all():
            return select(better, followed(near, unit), before)
        rows = np.flatnonzero(better)
        return (
            replaced(before, rows, followed(taken(near, rows), unit[rows])) if rows.size else before
        )

    def step(state: _State) -> _State:
        if xp is np and start.ndim > 1 and not state.moves.all():
            live = np.flatnonzero(state.moves)
            return replaced(state, live, step(taken(state, live)))
        near, objective = evaluated(state.trial)
        reduced = state.objective - objective
        better = reduced >= 0
        best = select(better, (near, objective), (state.near, state.objective))
        gained = xp.where(better, reduced, state.gained)
        of = ahead(*best, better, state.ahead), state.trial, better, reduced, state.idle
        return select(state.moves, decision(*best, gained, *of, state.points), state)

    def in_front(state: _State) -> _State:
        """The same without the starts that end above the deepest point, or creep."""
        promised = state.ahead.promised
        within = xp.where(xp.isfinite(promised), promised, REACH * state.gained)
        ends = state.objective - within
        behind = (state.points > SURE) & (ends > state.objective.min() + BEHIND)
        return state._replace(moves=state.moves & ~behind)

    def decision(
        near: Near,
        objective: AnyArray,
        gained: AnyArray,
        found: _Followed,
        last: AnyArray,
        better: AnyArray,
        reduced: AnyArray,
        idle: AnyArray,
        points: AnyArray,
    ) -> _State:
        of = found[:2], last, better, reduced, idle
        to = decided(near.q, objective, objective / model.terms, *of, not model.spectra.whole)
        moves = ~to.settled & xp.isfinite(objective)
        going = to.target, to.trial, to.settled, to.idle, points + 1, moves
        return _State(near, objective, gained, found, *going)

    near, objective = evaluated(start)
    none = xp.zeros(objective.shape, int)
    found = followed(near, objective / model.terms)
    of = start, xp.isfinite(objective), xp.zeros_like(objective), none, none
    unknown = xp.zeros_like(objective) + xp.inf
    going = step if start.ndim == 1 else lambda state: in_front(step(state))
    last = repeated(going, decision(near, objective, unknown, found, *of), POINTS - 1)
    q = xp.where(last.settled[..., None], last.target, last.near.q)
    return Minimum(q, last.objective, last.ahead.matrix, last.settled, last.points)


@array_function
def cost(model: Calibrations, least: Minimum) -> Float[AnyArray, "*row"]:
    """−2 ln likelihood per degree of freedom, but for a constant, by which starts compete.

    A spurious resonance fits noise, so that it lowers Σ r²; but it raises the variances.
    """
    xp, s, gains = namespace(least.q), model.spectra, model.gains(least.q)
    logs = xp.log(s.variance_y + power(gains) * s.variance_x)
    logs = xp.where(s.selected, logs, 0.0).sum((-2, -1))
    return (least.objective + logs) / model.terms
