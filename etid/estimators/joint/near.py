"""The loads of a driver near one point, with their own parameters eliminated.

A driver acts on its records through a few functions of frequency, its *signals*: W = log(Z_th + R),
and the gains of its calibrations if these estimate the unloaded record of a load. The terms r of a
load are nearly linear in the signals and in its own parameters. With the own parameters at their
minimum, the sum of squares of all loads is a quadratic function of the change δ of the signals,

    ½ |r|² + gᵀ δ + ½ δᵀ H δ − ½ |T δ + t|²,      T = Lᵀ B Aᵀ,   t = Lᵀ B r,   L Lᵀ = (B Bᵀ)⁻¹,

where A and B are the derivatives of r with respect to the signals and to the own parameters. Both
are taken at the knots (`etid.signals.knots`), so H couples only signals of one knot. The own
parameters of the minimum are p − L (T δ + t).

The signals are far from linear in the parameters of Z_th: a fast pole and a delay form a curved
valley. The way through it may take a hundred steps, but none of them evaluates a load.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.estimators.estimate import MAX_STEPS
from etid.estimators.joint.terms import DriverStudy, Loads, Own, in_turn
from etid.estimators.maximum_likelihood.calibrations import DENSE, Calibrations
from etid.estimators.maximum_likelihood.condensed import apart
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.profile import total
from etid.signals.knots import knots
from etid.signals.transfer import as_complex, reciprocal
from etid.solvers.arrowhead import join
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import DIFFERENCE, LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse_root

ROUNDS = 10  # largest number of points; from 40 dB on, two or three are enough
ENOUGH = 0.02  # reduction of ½ Σ r² below which the next point is the minimum
W = 2  # number of signals of W: real and imaginary part


class _Part(eqx.Module):
    """Part of ½ Σ r² as a function of signals.

    Attributes:
        objective: Its value without change.
        pull: g.
        curvature: H.
        following: T, stacked for all loads.
        rest: t.
    """

    objective: Float[Array, ""]
    pull: Float[Array, "signal knot"]
    curvature: Float[Array, "signal signal knot"]
    following: Float[Array, "*load own signal knot"]
    rest: Float[Array, "*load own"]

    def own(self, change: Float[Array, "signal knot"]) -> Float[Array, "*load own"]:
        """T δ + t."""
        return jnp.tensordot(self.following, change, 2) + self.rest

    def slope(
        self, change: Float[Array, "signal knot"], own: Float[Array, "*load own"]
    ) -> Float[Array, "signal knot"]:
        """H δ − Tᵀ `own`."""
        bent = jnp.einsum("stk,tk->sk", self.curvature, change)
        return bent - jnp.tensordot(own, self.following, own.ndim)


class _Near(eqx.Module):
    """A study near one point.

    Attributes:
        calibrations: The calibrations.
        centre: Common parameters of the point.
        frequency: Frequencies of the knots of each group [Hz].
        parts: The calibrations, then each group of loads.
    """

    calibrations: Calibrations
    centre: Float[Array, " common"]
    frequency: list[Float[Array, " knot"]]
    parts: list[_Part]

    def _of_each(self, known: Array, of_w: list[Array], axis: int) -> list[Array]:
        """The signals of each part, from the gains of the calibrations and from W."""
        found = [known]
        for w, part in zip(of_w, self.parts[1:], strict=True):
            signals = [w] if part.pull.shape[0] == W else [w, known]
            found.append(jnp.concatenate(signals, axis))
        return found

    def _loaded(
        self, common: Float[Array, " common"], frequency: Float[Array, " knot"]
    ) -> Complex[Array, " knot"]:
        resistance = as_complex(self.calibrations.calibration.r_load.mean())
        return self.calibrations.source_of(common).response(frequency) + resistance

    def signals(self, common: Float[Array, " common"]) -> list[Float[Array, "signal knot"]]:
        """The signals of each part."""
        known = self.calibrations.gains(common, self.calibrations.knots)
        of_w = [jnp.log(self._loaded(common, f))[None] for f in self.frequency]
        return self._of_each(_parts(known), list(map(_parts, of_w)), 0)

    def slopes(self, common: Float[Array, " common"]) -> list[Float[Array, "common signal knot"]]:
        """Derivatives of the signals."""
        source = self.calibrations.source_of(common)
        known = self.calibrations.slopes(common, self.calibrations.knots).by_common
        of_w = []
        for f in self.frequency:
            rows = source.slopes(f) * reciprocal(self._loaded(common, f))[None, :]
            of_w.append(jnp.pad(rows, ((0, common.size - rows.shape[0]), (0, 0)))[:, None])
        return self._of_each(_parts(known), list(map(_parts, of_w)), 1)

    def changes(self, common: Float[Array, " common"]) -> list[Float[Array, "signal knot"]]:
        """Changes of the signals from those of the point."""
        both = zip(self.signals(common), self.signals(self.centre), strict=True)
        return [now - before for now, before in both]


def _parts(values: Complex[Array, "*row of knot"]) -> Float[Array, "*row signal knot"]:
    """Real and imaginary part of each function in turn."""
    parts = jnp.stack([values.real, values.imag], axis=-2)
    return parts.reshape(*values.shape[:-2], -1, values.shape[-1])


def _equations(_, common: Float[Array, " common"], near: _Near) -> NormalEquations:
    """Normal equations of the common parameters; the own ones are at their minima."""
    weak, by_common = near.calibrations.weak(common)
    objective, gradient = 0.5 * jnp.dot(weak, weak), by_common @ weak
    matrix = by_common @ by_common.T
    for part, change, rows in zip(
        near.parts, near.changes(common), near.slopes(common), strict=True
    ):
        own, bent = part.own(change), jnp.einsum("stk,tk->sk", part.curvature, change)
        value = part.objective + jnp.sum(change * (0.5 * bent + part.pull))
        objective = objective + value - 0.5 * jnp.sum(own**2)
        slope = part.slope(change, own) + part.pull
        gradient = gradient + jnp.tensordot(rows, slope, 2)
        by_own = jnp.tensordot(part.following, rows, [[-2, -1], [1, 2]]).reshape(-1, common.size)
        bent = jnp.einsum("stk,ctk->csk", part.curvature, rows)
        matrix = matrix + jnp.tensordot(bent, rows, [[1, 2], [1, 2]]) - by_own.T @ by_own
    return NormalEquations(objective, gradient, matrix).finite()


def _second_order(
    _, common: Float[Array, " common"], step: Float[Array, " common"], near: _Near
) -> Float[Array, " common"]:
    """Jᵀ r″ as in `levenberg_marquardt.second_order`; the priors are taken as linear."""
    ends = [near.signals(common + h * step) for h in (DIFFERENCE, 0.0, -DIFFERENCE)]
    found = jnp.zeros_like(common)
    for part, rows, after, at, before in zip(near.parts, near.slopes(common), *ends, strict=True):
        bent = (after - 2 * at + before) / DIFFERENCE**2
        slope = part.slope(bent, part.own(bent) - part.rest)
        found = found + jnp.tensordot(rows, slope, 2)
    return found


def _of_calibrations(calibrations: Calibrations, common: Float[Array, " common"]) -> _Part:
    """The calibrations as a function of their gains."""
    near = calibrations.near(common)
    records, size = near.condensed.gains.shape
    unit = jnp.array([1.0, 1.0j])
    alone = as_complex(jnp.eye(records))[:, None, :] * unit[None, :, None]
    alone = jnp.tile(alone.reshape(2 * records, records, 1), (1, 1, size))
    rows = near.condensed.rows(alone).reshape(2 * records, -1, size)
    part = near.condensed.part.reshape(-1, size)
    pull = jnp.einsum("stk,tk->sk", rows, part)
    curvature = jnp.einsum("stk,utk->suk", rows, rows)
    objective = total([of.objective for of in near.profiles])
    none = jnp.zeros((0, 2 * records, size))
    return _Part(objective, pull, curvature, none, jnp.zeros(0))


def _by_signals(driver: GivenDriver, shared: bool) -> GivenDriver:
    """A driver whose z are the signals at each harmonic."""
    unit = jnp.array([1.0, 1.0j])[:, None]
    slope, known = jnp.tile(unit, (1, driver.loaded.size)), None
    if shared and driver.gains is not None:
        count, size = driver.gains.shape
        slope = jnp.pad(slope, ((0, 2 * count), (0, 0)))
        alone = jnp.pad(jnp.kron(jnp.eye(count, dtype=unit.dtype), unit), ((W, 0), (0, 0)))
        known = jnp.tile(alone[:, :, None], (1, 1, size))
    zero = jnp.zeros(slope.shape[0])
    return dataclasses.replace(
        driver,
        slope=slope,
        mean=zero,
        cov=jnp.diag(zero),
        records=driver.records if shared else None,
        gains=driver.gains if shared else None,
        gain_slopes=known,
    )


def _of_group(
    study: DriverStudy, common: Float[Array, " common"], loads: Loads, owns: Own
) -> tuple[_Part, Float[Array, "load own own"]]:
    """A group of loads as a function of the signals, and L of each load."""
    every, o = knots(loads.spectrum.x.shape[-1], DENSE), loads.owned
    same_size = loads.spectrum.x.shape[-1] == study.model.calibrations.spectra.x.shape[-1]
    driver = study.model.around(common, loads.frequency[0], slopes=False)
    driver = _by_signals(driver, study.model.shared and same_size)

    def one(load: Loads, own: Own) -> tuple[_Part, Float[Array, "own own"]]:
        lane = study.lane(driver, load)
        q = jnp.concatenate([own.vector(), driver.mean])
        prior, rest = 1 / lane.gains.widths(own.vector()), lane.rest(own.vector())
        near, size = lane.near(q, every), every.index.size
        part = near.condensed.part.reshape(-1, size)
        jacobian = near.jacobian.reshape(q.size, -1, size)
        by_own, by_signal = jacobian[:o], jacobian[o:]
        told = jnp.einsum("ock,pck->op", by_own, by_own)
        root = inverse_root(told + jnp.diag(prior**2))
        pull = jnp.einsum("sck,ck->sk", by_signal, part)
        curvature = jnp.einsum("sck,tck->stk", by_signal, by_signal)
        following = jnp.einsum("po,pck,sck->osk", root, by_own, by_signal)
        if lane.unloaded is not None:  # X is not smooth in frequency
            of_x = apart(lambda _: lane.by_x(near), q)
            pull = jnp.concatenate([pull[:W], every.summed(of_x[W:])])
        found = _Part(
            objective=near.profile.objective + 0.5 * jnp.dot(rest, rest),
            pull=pull,
            curvature=curvature,
            following=following,
            rest=root.T @ (jnp.einsum("ock,ck->o", by_own, part) + prior * rest),
        )
        return jax.tree.map(lambda leaf: jnp.where(load.used, leaf, 0.0), found), root

    found, roots = in_turn(one, loads, owns)
    objective, pull, curvature = (
        of.sum(0) for of in (found.objective, found.pull, found.curvature)
    )
    return _Part(objective, pull, curvature, found.following, found.rest), roots


class _State(NamedTuple):
    """The best point so far, and the point to try next.

    Attributes:
        best: The best point.
        least: Its ½ Σ r².
        trial: The next point.
        promised: Reduction of ½ Σ r² that the next point promises.
        better: Whether the last point was better than all before.
        rounds: Number of points.
    """

    best: Float[Array, " parameter"]
    least: Float[Array, ""]
    trial: Float[Array, " parameter"]
    promised: Float[Array, ""]
    better: Bool[Array, ""]
    rounds: Int[Array, ""]


def approached(
    study: DriverStudy, start: Float[Array, " parameter"], solver: LevenbergMarquardt
) -> Float[Array, " parameter"]:
    """A point close to the minimum of a study; with much noise it may be far from it.

    Args:
        study: Calibrations and loads.
        start: Start of all parameters.
        solver: Solver of the common parameters near one point.
    """
    solver = dataclasses.replace(solver, equations=_equations, second_order=_second_order)

    def goes_on(state: _State) -> Bool[Array, ""]:
        return state.better & (state.promised > ENOUGH) & (state.rounds < ROUNDS)

    def again(state: _State) -> _State:
        following, value, promised = _next(study, state.trial, solver)
        better = value < state.least
        best = jnp.where(better, state.trial, state.best)
        least = jnp.where(better, value, state.least)
        return _State(best, least, following, promised, better, state.rounds + 1)

    large, number = jnp.array(jnp.inf), jnp.array(0)
    first = _State(start, large, start, large, jnp.array(True), number)
    last = jax.lax.while_loop(goes_on, again, first)
    return jnp.where(last.better & jnp.isfinite(last.trial).all(), last.trial, last.best)


def _next(
    study: DriverStudy, y: Float[Array, " parameter"], solver: LevenbergMarquardt
) -> tuple[Float[Array, " parameter"], Float[Array, ""], Float[Array, ""]]:
    """The minimum of a study as it looks from `y`, ½ Σ r² at `y`, and its expected reduction."""
    common, parts = study.split(y)
    known = _of_calibrations(study.model.calibrations, common)
    groups = [_of_group(study, common, *group) for group in zip(study.groups, parts, strict=True)]
    near = _Near(
        study.model.calibrations,
        common,
        [knots(g.spectrum.x.shape[-1], DENSE).at(g.frequency[0]) for g in study.groups],
        [known, *(part for part, _ in groups)],
    )
    solution = least_squares(
        lambda y, _: y,  # not evaluated: the solver takes the equations
        solver,
        common,
        near,
        MAX_STEPS,
    )
    changes, own = near.changes(solution.value)[1:], []
    for (part, root), change, before in zip(groups, changes, parts, strict=True):
        found = before.vector() - jnp.einsum("lop,lp->lo", root, part.own(change))
        own.append(study.widened(found))
    weak, _ = near.calibrations.weak(common)
    value = 0.5 * jnp.dot(weak, weak) + sum(part.objective for part in near.parts)
    promised = value - solution.stats["normal_equations"].objective
    return join(solution.value, jnp.concatenate(own)), value, promised
