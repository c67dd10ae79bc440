"""The minimum of the likelihood of a study, whose loads are seen near one point only.

The terms r of a load are nearly linear in the signals of its driver (`etid.likelihood.joint.loads`)
and in its own parameters. With the own parameters at their minimum, the sum of squares of all loads
is a quadratic function of the change δ of the signals,

    ½ |r|² + gᵀ δ + ½ δᵀ H δ − ½ |T δ + t|²,      T = Lᵀ B Aᵀ,   t = Lᵀ B r,   L Lᵀ = (B Bᵀ)⁻¹,

where A and B are the derivatives of r with respect to the signals and to the own parameters
(Pintelon and Schoukens, System Identification, 2012, ch. 9). Both are taken at the knots
(`etid.signals.knots`), so H couples only signals of one knot. The own parameters of the minimum are
p − L (T δ + t).

The signals are far from linear in the parameters of Z_th: a fast pole and a delay form a curved
valley. The way through it may take a hundred steps, but none of them evaluates a load.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from etid.likelihood import driver
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.driver import MAX_STEPS, PATIENCE
from etid.likelihood.joint.loads import Loads, Signals
from etid.likelihood.linear import DIFFERENCE, LevenbergMarquardt, NormalEquations
from etid.likelihood.load import Load, Near
from etid.likelihood.search import BEFORE, POINTS, decided
from etid.precision import array_function
from etid.signals.transfer import AnyArray, power
from etid.solvers.matrices import inverse_root

NEXT = 1e-3  # [standard errors] spacing of a difference of slopes


class Part(NamedTuple):
    """½ Σ r² of loads of one length as a function of a change of their signals.

    Signals are in one row: those of a knot are apart by the number of knots.

    Attributes:
        objective: ½ |r|² of the point.
        pull: g − Tᵀ t.
        curvature: H.
        following: T of all loads.
        rest: t of each load.
        roots: L of each load.
    """

    objective: float
    pull: Float[np.ndarray, " change"]
    curvature: Float[np.ndarray, "signal signal knot"]
    following: Float[np.ndarray, "owns change"]
    rest: Float[np.ndarray, "load own"]
    roots: Float[np.ndarray, "load own own"]

    @property
    def reducible(self) -> float:
        """½ |t|²: what the own parameters alone take from the objective."""
        return 0.5 * float((self.rest**2).sum())

    def bent(self, change: Float[np.ndarray, "*row change"]) -> AnyArray:
        """H δ − Tᵀ T δ."""
        parts = change.reshape(*change.shape[:-1], self.curvature.shape[0], -1)
        parts = np.einsum("stk,...tk->...sk", self.curvature, parts).reshape(change.shape)
        return parts - (change @ self.following.T) @ self.following

    def moved(
        self, owns: Float[np.ndarray, "load own"], change: Float[np.ndarray, " change"]
    ) -> Float[np.ndarray, "load own"]:
        """The own parameters of the minimum, from those of the point."""
        by = (self.following @ change).reshape(owns.shape) + self.rest
        return owns - (self.roots @ by[..., None])[..., 0]


@dataclasses.dataclass(frozen=True)
class _Study:
    """A study near a point, as a function of the common parameters; `linear.Curved`.

    Attributes:
        calibrations: The calibrations near the point.
        signals: The signals of the loads of each length.
        parts: The loads of each length.
        centre: The signals of the point.
    """

    calibrations: driver.AtKnots
    signals: Sequence[Signals]
    parts: Sequence[Part]
    centre: Sequence[Float[np.ndarray, " change"]]

    def changes(self, common: Float[np.ndarray, " common"]) -> list[AnyArray]:
        """The change of the signals of each length."""
        return [of(common) - at for of, at in zip(self.signals, self.centre, strict=True)]

    def equations(self, q: Float[np.ndarray, "1 common"]) -> NormalEquations:
        """The normal equations of the common parameters; the own ones are at their minima."""
        found = self.calibrations.equations(q)
        objective, gradient, matrix = (np.array(one) for one in found[:3])
        for part, of, change in zip(self.parts, self.signals, self.changes(q[0]), strict=True):
            rows = of.slopes(q[0])
            bent = part.bent(np.concatenate([change[None], rows]))
            slope = bent[0] + part.pull
            objective += part.objective - part.reducible + change @ (0.5 * bent[0] + part.pull)
            gradient += rows @ slope
            matrix += bent[1:] @ rows.T
            if of.loads.same is not None:
                matrix = _with_residual(matrix, of, q, rows, slope)
        objective = np.where(np.isfinite(gradient).all(-1), objective, np.inf)
        return found._replace(objective=objective, gradient=gradient, matrix=matrix)

    def bend(
        self,
        q: Float[np.ndarray, "1 common"],
        at: NormalEquations,
        move: Float[np.ndarray, "1 common"],
    ) -> Float[np.ndarray, "1 common"]:
        """Jᵀ r″ of a step."""
        found, ends = self.calibrations.bend(q, at, move), (DIFFERENCE, 0.0, -DIFFERENCE)
        for part, of in zip(self.parts, self.signals, strict=True):
            after, here, before = (of(q[0] + h * move[0]) for h in ends)
            bent = part.bent((after - 2 * here + before) / DIFFERENCE**2)
            found = found + of.slopes(q[0]) @ bent
        return found

    def of(self, rows: np.ndarray) -> "_Study":
        """There is one row."""
        del rows
        return self


def _with_residual(
    matrix: Float[np.ndarray, "1 common common"],
    of: Signals,
    q: Float[np.ndarray, "1 common"],
    rows: Float[np.ndarray, "common change"],
    slope: Float[np.ndarray, " change"],
) -> Float[np.ndarray, "1 common common"]:
    """The curvature with its part from second derivatives of the signals, if it is positive then.

    Loads with one unloaded record miss it alike, so that this part is not small: without it, a
    search takes a hundred steps.
    """
    steps = NEXT / np.sqrt(np.diagonal(matrix[0]))
    ahead = of.slopes(q + np.diag(steps))
    more = (ahead - rows) @ slope / steps[:, None]
    whole = matrix + 0.5 * (more + more.T)
    return whole if np.linalg.eigvalsh(whole[0])[0] > 0 else matrix


class Minimum(NamedTuple):
    """The minimum of a study.

    Attributes:
        common: The common parameters.
        owns: The own parameters of the loads of each length (load, own).
        settled: Whether it is a minimum.
        points: Number of points of the search.
    """

    common: Float[np.ndarray, " common"]
    owns: list[AnyArray]
    settled: bool
    points: int


@array_function
def minimum(
    calibrations: Calibrations,
    groups: Sequence[Loads],
    common: Float[np.ndarray, " common"],
    owns: Sequence[AnyArray],
) -> Minimum:
    """The minimum of a study, by successive approximations.

    Args:
        calibrations: The calibrations.
        groups: The loads that take part, of each length.
        common: Start of the common parameters.
        owns: Starts of the own parameters, near their minima behind the driver of `common`; one
            array (load, own) for each length.
    """
    signals = [Signals(calibrations, loads) for loads in groups]
    terms = calibrations.terms + sum(loads.load.records.terms.sum() for loads in groups)
    ends = np.cumsum([common.size, *(own.size for own in owns)])

    def named(y: AnyArray) -> tuple[AnyArray, list[AnyArray]]:
        first, *rest = np.split(y, ends[:-1])
        return first, [one.reshape(own.shape) for one, own in zip(rest, owns, strict=True)]

    def approximated(y: AnyArray) -> tuple[_Study, Float[np.ndarray, "1"]]:
        """The study near a point, and ½ Σ r² there."""
        common, owns = named(y)
        near, (weak, _) = calibrations.near(common[None]), calibrations.weak(common)
        parts = [_part(of, common, own) for of, own in zip(signals, owns, strict=True)]
        objective = near.objective + 0.5 * weak @ weak + sum(part.objective for part in parts)
        centre = [of(common) for of in signals]
        return _Study(driver.AtKnots(calibrations, near), signals, parts, centre), objective

    def followed(
        y: AnyArray, study: _Study, unit: Float[np.ndarray, "1"]
    ) -> tuple[AnyArray, AnyArray]:
        """The minimum near a point, and what it promises."""
        common, owns = named(y)
        first = study.equations(common[None])
        search = LevenbergMarquardt(1e-6, MAX_STEPS, PATIENCE, True)
        found = search(study, common[None], first, BEFORE**2 * unit)
        moves = zip(study.parts, owns, study.changes(found.q[0]), strict=True)
        owns = [of.moved(own, change).ravel() for of, own, change in moves]
        here = first.objective + sum(part.reducible for part in study.parts)
        # A fit that did not settle promises everything: it is at no minimum.
        promised = here - np.where(found.moves, -np.inf, found.equations.objective)
        return np.concatenate([found.q[0], *owns])[None], promised

    trial = np.concatenate([common, *(own.ravel() for own in owns)])
    least, idle = np.full(1, np.inf), np.zeros(1, int)
    best, target = trial, None
    points = 0
    while points < POINTS:
        points += 1
        study, objective = approximated(trial)
        better = objective <= least
        reduced = np.where(points == 1, 0.0, least - objective)
        if better:
            best, least = trial, objective
            target = followed(best, study, least / terms)
        if target is None:
            break  # the start is not finite
        of = target, trial[None], better, reduced, idle
        going = decided(best[None], least, least / terms, *of)
        trial, idle = going.trial[0], going.idle
        if going.settled:
            return Minimum(*named(going.target[0]), True, points)
    return Minimum(*named(best), False, points)


def _part(of: Signals, common: Float[np.ndarray, " common"], owns: AnyArray) -> Part:
    """The loads of one length near a point."""
    parts = [
        _of_few(of.behind(common, few), of.smooth, owns[rows]) for rows, few in of.loads.parts()
    ]
    value, pull, curvature, *each = zip(*parts, strict=True)
    sums = sum(value), np.sum(pull, axis=0), np.sum(curvature, axis=0)
    return Part(*sums, *map(np.concatenate, each))


def _of_few(load: Load, smooth: int, owns: Float[np.ndarray, "load own"]) -> Part:
    """The same for a few loads behind a source whose z are the signals, the `smooth` ones first."""
    every, count = load.knots, owns.shape[1]
    q = np.concatenate([owns, np.zeros((len(owns), load.centre.size - count))], 1)
    near, prior = Near.of(load, load.gains.at(every.index), q), load.told(q)
    jacobian, terms = near.jacobian, near.condensed.part
    by_own = jacobian[:, :count]
    told = by_own @ by_own.swapaxes(1, 2) + prior.matrix[..., :count, :count]
    roots = np.stack([inverse_root(one) for one in told])
    back = roots.swapaxes(1, 2)
    gradient = (by_own @ terms[..., None])[..., 0] + prior.gradient[:, :count]

    def apart(values: AnyArray) -> AnyArray:  # an axis of knots of its own
        return values.reshape(*values.shape[:-1], -1, every.index.size)

    by_signal, rest = apart(jacobian[:, count:]), (back @ gradient[..., None])[..., 0]
    pull = np.einsum("rsck,rck->sk", by_signal, apart(terms))
    if load.unloaded is not None:  # X is not smooth in frequency
        pull[smooth:] = every.summed(_by_x(load, near).sum(0)[smooth:])
    following = np.einsum("rock,rsck->rosk", apart(back @ by_own), by_signal)
    following = following.reshape(rest.size, -1)
    return Part(
        objective=near.objective.sum(),
        pull=pull.reshape(-1) - rest.reshape(-1) @ following,
        curvature=np.einsum("rsck,rtck->stk", by_signal, by_signal),
        following=following,
        rest=rest,
        roots=roots,
    )


def _by_x(load: Load, near: Near) -> Float[np.ndarray, "load z bin"]:
    """Derivatives of ½ Σ r² by the z that X depends on, at each harmonic.

    X̂ is at its minimum of |x − X̂|²/v + Σ |Y − G X̂|²/σ².
    """
    of, records = load.unloaded, load.known(near.q)
    assert of is not None
    off, variance = records.x - near.profile.x, records.variance_x
    towards = (np.conj(off)[:, None] * of.x_by_z).real * (2 / variance)[:, None]
    return towards - (power(off) / variance)[:, None] * of.log_variance_by_z
