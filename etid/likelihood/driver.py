"""The driver of some calibrations: all starts side by side, then the best with all harmonics.

The starts use bands of harmonics (`etid.signals.knots`), which is near enough to tell which of them
leads to the deepest minimum. None is left out on the way: after ten steps the one that wins is not
among the best two in a sixth of all calibrations. From a distant start, the derivatives of the
terms themselves, which contain their noise, find deeper minima than those with X̂.

Z_th and a delay form a curved valley, along which a fit creeps. So the last steps, at the knots,
follow its curvature: they take a quarter of the steps.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.likelihood.calibrations import Calibrations, Near
from etid.likelihood.linear import NormalEquations, levenberg_marquardt, repeated
from etid.likelihood.search import BEFORE, IDLE, NO_BETTER, POINTS, ROUNDING, WELL, select
from etid.precision import array_function, namespace
from etid.signals.harmonics import Spectrum, real_parts
from etid.signals.transfer import AnyArray, as_complex, power

ROUGHLY = 0.2  # [standard errors] length of the last steps of a rough fit
ROUGH_STEPS = 100  # a start that still creeps along the valley is compared as it is
PATIENCE = 3  # short steps that end a search: a step after a rejected one is short, too
MAX_STEPS = 500  # at the knots of one point


class Rough(NamedTuple):
    """The minima with bands of harmonics, near those with all harmonics.

    Attributes:
        q: Parameters of Z_th, and delays.
        matrix: Curvature.
        cost: −2 ln likelihood per degree of freedom, but for a constant.
        steps: Number of steps.
    """

    q: Float[AnyArray, "start q"]
    matrix: Float[AnyArray, "start q q"]
    cost: Float[AnyArray, "start"]
    steps: Int[AnyArray, "start"]


@array_function
def rough(model: Calibrations, bands: Spectrum, starts: Float[AnyArray, "start q"]) -> Rough:
    """The minima of all starts, with bands of the harmonics of the calibrations.

    Each calibration has an X of its own here, as if no two shared an unloaded record.
    """
    xp, model = namespace(starts), dataclasses.replace(model, instrument=None)
    of = dataclasses.replace(model, spectra=bands)
    x, y, used = bands.x, bands.y, bands.selected
    variance_x, variance_y = bands.variance_x, bands.variance_y

    def equations(q: Float[AnyArray, "start q"]) -> NormalEquations:
        slopes, (weak, by_weak) = of.slopes(q), of.weak(q)
        expected = variance_y + power(slopes.gains) * variance_x
        scale = as_complex(xp.where(used, xp.sqrt(2 / expected), 0.0))
        missed = (y - slopes.gains * x) * scale
        # A change of a gain also changes the variance that its term is scaled by.
        towards = xp.conj(slopes.gains) * as_complex(variance_x / expected)
        rows = slopes.by_q * (-x * scale)[..., None, :, :]
        rows = rows - missed[..., None, :, :] * (slopes.by_q * towards[..., None, :, :]).real
        flat = [real_parts(each.reshape(*each.shape[:-2], -1)) for each in (missed, rows)]
        terms, rows = xp.concatenate([flat[0], weak], -1), xp.concatenate([flat[1], by_weak], -1)
        return NormalEquations.of(terms, rows)

    first = equations(starts)
    enough = xp.zeros_like(first.objective) + 0.5 * ROUGHLY**2
    found = levenberg_marquardt(equations, starts, first, 1e-2, enough, ROUGH_STEPS, PATIENCE)
    # A spurious resonance fits noise, so that it lowers Σ r²; but it raises the variances.
    s, gains = model.spectra, model.gains(found.q)
    logs = xp.log(s.variance_y + power(gains) * s.variance_x)
    logs = xp.where(s.selected, logs, 0.0).sum((-2, -1))
    cost = (found.equations.objective + logs) / model.terms
    return Rough(found.q, found.equations.matrix, cost, found.steps)


class Minimum(NamedTuple):
    """The minimum with all harmonics.

    Attributes:
        q: The common parameters.
        objective: ½ Σ r² next to it.
        settled: Whether it is a minimum.
        points: Number of points of the search.
    """

    q: Float[AnyArray, "*row q"]
    objective: Float[AnyArray, "*row"]
    settled: Bool[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]


class _State(NamedTuple):
    """Where the search is: the best point, what is known there, and the next one."""

    near: Near
    objective: Float[AnyArray, "*row"]
    target: Float[AnyArray, "*row q"]
    trial: Float[AnyArray, "*row q"]
    settled: Bool[AnyArray, "*row"]
    idle: Int[AnyArray, "*row"]
    points: Int[AnyArray, "*row"]
    moves: Bool[AnyArray, "*row"]


@array_function
def minimum(model: Calibrations, start: Float[AnyArray, "*row q"]) -> Minimum:
    """The minimum of the likelihood of all harmonics, by successive approximations.

    The approximations are those of `etid.likelihood.search`.
    """
    xp, every = namespace(start), model.knots

    def evaluated(q: Float[AnyArray, "*row q"]) -> tuple[Near, Float[AnyArray, "*row"]]:
        near, (weak, _) = model.near(q), model.weak(q)
        return near, near.objective + 0.5 * (weak**2).sum(-1)

    def followed(near: Near, unit: Float[AnyArray, "*row"]) -> tuple[AnyArray, AnyArray]:
        """The minimum at the knots, and what it promises."""

        def terms(q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row term"]:
            at = near.condensed.terms(model.gains(q, every))
            return xp.concatenate([at, model.weak(q)[0]], -1)

        def equations(q: Float[AnyArray, "*row q"]) -> NormalEquations:
            slopes, (weak, by_weak) = model.slopes(q, every), model.weak(q)
            at = xp.concatenate([near.condensed.terms(slopes.gains), weak], -1)
            rows = xp.concatenate([near.condensed.rows(slopes.by_q), by_weak], -1)
            return NormalEquations.of(at, rows)

        first, enough = equations(near.q), (WELL * BEFORE) ** 2 * unit
        of = equations, near.q, first, 1e-6, enough, MAX_STEPS, PATIENCE, terms
        found = levenberg_marquardt(*of)
        # A fit that did not settle promises everything: it is at no minimum.
        left = xp.where(found.moves, -np.inf, found.equations.objective)
        return found.q, first.objective - left

    def going(
        near: Near, objective: AnyArray, better: AnyArray, reduced: AnyArray, state: AnyArray
    ) -> _State:
        idle, points = state
        unit = objective / model.terms
        target, promised = followed(near, unit)
        stays = ~better & (promised <= NO_BETTER**2 * unit)
        target = xp.where(stays[..., None], near.q, target)
        promised = xp.where(stays, 0.0, promised)
        idles = xp.maximum(xp.abs(reduced), promised) <= ROUNDING * objective
        idle = xp.where(idles, idle + 1, 0)
        trial = xp.where(better[..., None], target, 0.5 * (target + near.q))
        trial = xp.where(xp.isfinite(trial).all(-1)[..., None], trial, near.q)
        settled = (promised <= BEFORE**2 * unit) | (idle >= IDLE)
        moves = ~settled & xp.isfinite(objective)
        return _State(near, objective, target, trial, settled, idle, points + 1, moves)

    def step(state: _State) -> _State:
        near, objective = evaluated(state.trial)
        reduced = state.objective - objective
        better = reduced >= 0
        kept = select(better, (near, objective), (state.near, state.objective))
        found = going(*kept, better, reduced, (state.idle, state.points))
        return select(state.moves, found, state)

    near, objective = evaluated(start)
    none = xp.zeros(objective.shape, int)
    better = xp.isfinite(objective)
    first = going(near, objective, better, xp.zeros_like(objective), (none, none))
    last = repeated(step, first, POINTS - 1)
    q = xp.where(last.settled[..., None], last.target, last.near.q)
    return Minimum(q, last.objective, last.settled, last.points)


class Identified(NamedTuple):
    """A driver that was identified.

    Attributes:
        model: The calibrations with its Z_th, delays and errors.
        near: Their likelihood at its minimum.
        least: The minimum; it counts the steps of the start, too.
        start: Number of the start that led here.
    """

    model: Calibrations
    near: Near
    least: Minimum
    start: int


def identified(model: Calibrations, found: Rough, ranked: Sequence[int]) -> Identified:
    """The driver from the best start; the others are tried only if it does not converge.

    Several calibrations show errors of the instrument, which are then unknowns, too; behind one
    they are 0. If no start converges, the result is that of the best.
    """
    if model.calibration.r_load.shape[0] == 1:
        model = dataclasses.replace(model, instrument=None)
    none = np.zeros_like(model.tolerances)
    tried = []
    for number in ranked:
        least = minimum(model, np.concatenate([found.q[number], none]))
        tried.append((least._replace(points=least.points + found.steps[number]), number))
        if least.settled:
            break
    least, start = tried[-1] if tried[-1][0].settled else tried[0]
    q = least.q
    errors = None if model.instrument is None else model.errors(q)
    of = dataclasses.replace(model.calibration, delay_samples=model.delays(q), errors=errors)
    near = model.near(q)
    model = dataclasses.replace(model, source=model.source_of(q), calibration=of)
    return Identified(model, near, least, start)
