"""The loads of a driver near one point, with their own parameters eliminated.

A driver acts on its records through a few functions of frequency, its *signals*: W = log(Z_th + R),
the errors of the instrument that change loads, which are constant, and the gains of its
calibrations if these estimate the unloaded record of a load. The terms r of a load are nearly
linear in the signals and in its own parameters. With the own parameters at their minimum, the sum
of squares of all loads is a quadratic function of the change δ of the signals,

    ½ |r|² + gᵀ δ + ½ δᵀ H δ − ½ |T δ + t|²,      T = Lᵀ B Aᵀ,   t = Lᵀ B r,   L Lᵀ = (B Bᵀ)⁻¹,

where A and B are the derivatives of r with respect to the signals and to the own parameters. Both
are taken at the knots (`etid.signals.knots`), so H couples only signals of one knot. The own
parameters of the minimum are p − L (T δ + t).

The signals are far from linear in the parameters of Z_th: a fast pole and a delay form a curved
valley. The way through it may take a hundred steps, but none of them evaluates a load.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.estimators.estimate import MAX_STEPS, SOLVER
from etid.estimators.joint.terms import Joint, Loads, in_turn
from etid.estimators.maximum_likelihood.condensed import apart
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.likelihood.calibrations import DENSE, Calibrations
from etid.likelihood.gains import FAULTS
from etid.signals.knots import knots
from etid.signals.transfer import AnyArray, as_complex, reciprocal
from etid.solvers import successive
from etid.solvers.least_squares import stepped
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse_root

WITHIN = 0.01  # [standard errors] from the minimum of an approximation
DIFFERENCE = 0.1  # of the step: spacing of the second difference (Transtrum and Sethna)
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


class _Signals(eqx.Module):
    """The signals as functions of the common parameters.

    Attributes:
        calibrations: The calibrations.
        frequency: Frequencies of the knots of each group [Hz].
        of_x: Whether a group of this length estimates its unloaded record from the calibrations.
    """

    calibrations: Calibrations
    frequency: list[Array]
    of_x: list[bool] = eqx.field(static=True)

    @classmethod
    def of(cls, model: Joint, groups: list[Loads]) -> "_Signals":
        """The signals of a study."""
        sizes = [loads.spectrum.x.shape[-1] for loads in groups]
        return cls(
            model.calibrations,
            [
                knots(size, DENSE).at(loads.frequency[0])
                for size, loads in zip(sizes, groups, strict=True)
            ],
            [model.shares(size) for size in sizes],
        )

    def _of_each(self, known: Array, of_w: list[Array], faults: Array) -> list[Array]:
        """The signals of each part: gains of the calibrations, W, and errors of the instrument."""
        found = [known]
        for w, of_x in zip(of_w, self.of_x, strict=True):
            constant = jnp.broadcast_to(faults[..., None], (*faults.shape, w.shape[-1]))
            found.append(jnp.concatenate([w, constant, *([known] if of_x else [])], axis=-2))
        return found

    @property
    def _resistance(self) -> Complex[Array, ""]:
        return as_complex(self.calibrations.calibration.r_load.mean())

    def __call__(self, common: Float[Array, " common"]) -> list[Float[Array, "signal knot"]]:
        """The signals of each part."""
        known = self.calibrations.gains(common, self.calibrations.knots)
        z_th = self.calibrations.source_of(common).response
        of_w = [jnp.log(z_th(f) + self._resistance)[None] for f in self.frequency]
        faults = self.calibrations.errors(common)[:FAULTS]
        return self._of_each(_parts(known), list(map(_parts, of_w)), faults)

    def slopes(self, common: Float[Array, " common"]) -> list[Float[Array, "common signal knot"]]:
        """Derivatives of the signals."""
        source, resistance = self.calibrations.source_of(common), self._resistance
        known = self.calibrations.slopes(common, self.calibrations.knots).by_q
        of_w = []
        for f in self.frequency:
            z_th, rows = source.with_slopes(f)
            rows = rows * reciprocal(z_th + resistance)[None, :]
            of_w.append(jnp.pad(rows, ((0, common.size - rows.shape[0]), (0, 0)))[:, None])
        faults = self.calibrations.errors(jnp.eye(common.size))[:, :FAULTS]
        return self._of_each(_parts(known), list(map(_parts, of_w)), faults)


class _Near(eqx.Module):
    """A study near one point.

    Attributes:
        parts: The calibrations, then each group of loads.
        roots: L of each load of each group, whose loads have other numbers of own parameters.
        centre: The signals of the point.
    """

    parts: list[_Part]
    roots: list[Array]
    centre: list[Array]

    def changes(self, signals: list[Array]) -> list[Float[Array, "signal knot"]]:
        """Changes of the signals from those of the point."""
        return [now - before for now, before in zip(signals, self.centre, strict=True)]


def _parts(values: Complex[Array, "*row of knot"]) -> Float[Array, "*row signal knot"]:
    """Real and imaginary part of each function in turn."""
    parts = jnp.stack([values.real, values.imag], axis=-2)
    return parts.reshape(*values.shape[:-2], -1, values.shape[-1])


def _equations(
    _, common: Float[Array, " common"], study: tuple[_Signals, _Near]
) -> NormalEquations:
    """Normal equations of the common parameters; the own ones are at their minima."""
    signals, near = study
    weak, by_common = signals.calibrations.weak(common)
    objective, gradient = 0.5 * jnp.dot(weak, weak), by_common @ weak
    matrix = by_common @ by_common.T
    changes, slopes = near.changes(signals(common)), signals.slopes(common)
    for part, change, rows in zip(near.parts, changes, slopes, strict=True):
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
    common: Float[Array, " common"], step: Float[Array, " common"], study: tuple[_Signals, _Near]
) -> Float[Array, " common"]:
    """Jᵀ r″, r″ the second derivative along the step; the priors are taken as linear."""
    signals, near = study
    ends = [signals(common + h * step) for h in (DIFFERENCE, 0.0, -DIFFERENCE)]
    found = jnp.zeros_like(common)
    for part, rows, after, at, before in zip(
        near.parts, signals.slopes(common), *ends, strict=True
    ):
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
    objective = near.objective
    none = jnp.zeros((0, 2 * records, size))
    return _Part(objective, pull, curvature, none, jnp.zeros(0))


def _by_signals(
    driver: GivenDriver, shared: bool, tolerances: Float[AnyArray, " fault"]
) -> GivenDriver:
    """A driver whose z are the signals at each harmonic."""
    unit, own = jnp.array([1.0, 1.0j])[:, None], W + tolerances.size
    slope, known = jnp.tile(unit, (1, driver.loaded.size)), None
    slope = jnp.pad(slope, ((0, tolerances.size), (0, 0)))
    if shared and driver.gains is not None:
        count, size = driver.gains.shape
        slope = jnp.pad(slope, ((0, 2 * count), (0, 0)))
        alone = jnp.pad(jnp.kron(jnp.eye(count, dtype=unit.dtype), unit), ((own, 0), (0, 0)))
        known = jnp.tile(alone[:, :, None], (1, 1, size))
    zero, faults = jnp.zeros(slope.shape[0]), driver.faults
    if faults is not None:
        faults = faults[0], jnp.pad(jnp.diag(tolerances), ((W, zero.size - own), (0, 0)))
    return dataclasses.replace(
        driver,
        slope=slope,
        mean=zero,
        cov=jnp.diag(zero),
        records=driver.records if shared else None,
        gains=driver.gains if shared else None,
        gain_slopes=known,
        faults=faults,
    )


def _of_group(
    model: Joint,
    common: Float[Array, " common"],
    loads: Loads,
    owns: Float[Array, "load own"],
) -> tuple[_Part, Float[Array, "load own own"]]:
    """A group of loads as a function of the signals, and L of each load."""
    size = loads.spectrum.x.shape[-1]
    every = knots(size, DENSE)
    driver = model.around(common, loads.frequency[0], slopes=False)
    tolerances = model.calibrations.tolerances[:FAULTS]
    driver, smooth = _by_signals(driver, model.shares(size), tolerances), W + tolerances.size

    def one(load: Loads, own: Float[Array, " own"]) -> tuple[_Part, Float[Array, "own own"]]:
        lane, o = load.behind(driver, model), own.size
        q = jnp.concatenate([own, driver.mean])
        prior, rest = 1 / lane.gains.widths(own), lane.rest(own)
        near = lane.near(q, every)
        part = near.condensed.part.reshape(-1, every.index.size)
        jacobian = near.jacobian.reshape(q.size, *part.shape)
        by_own, by_signal = jacobian[:o], jacobian[o:]
        told = jnp.einsum("ock,pck->op", by_own, by_own)
        root = inverse_root(told + jnp.diag(prior**2))
        pull = jnp.einsum("sck,ck->sk", by_signal, part)
        curvature = jnp.einsum("sck,tck->stk", by_signal, by_signal)
        following = jnp.einsum("po,pck,sck->osk", root, by_own, by_signal)
        if lane.unloaded is not None:  # X is not smooth in frequency
            of_x = apart(lambda _: lane.by_x(near), q)
            pull = jnp.concatenate([pull[:smooth], every.summed(of_x[smooth:])])
        found = _Part(
            objective=near.objective + 0.5 * jnp.dot(rest, rest),
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


def minimum(
    model: Joint,
    groups: list[Loads],
    common: Float[Array, " common"],
    owns: list[Array],
) -> tuple[Float[Array, " common"], list[Array], successive.Minimum]:
    """The minimum of a study; it has no derivative.

    Args:
        model: The likelihood.
        groups: The loads.
        common: Start of the common parameters.
        owns: Starts of the unknowns of the loads of each group, next to their minima behind the
            driver of `common`.

    Returns:
        The common parameters, the unknowns of the loads of each group, and what else is known.
    """
    signals = _Signals.of(model, groups)
    # The sum of squares grows with the number of loads; a detectable change of it does not.
    terms = sum(loads.terms for loads in groups)
    count = sum(loads.used.size for loads in groups)
    solver = LevenbergMarquardt(
        rtol=WITHIN / math.sqrt(terms),
        ftol=SOLVER.ftol / (1 + count),
        equations=_equations,
        bend=_second_order,
    )

    start, named = ravel_pytree((common, owns))

    def approximate(y: Float[Array, " parameter"]) -> tuple[_Near, Float[Array, ""]]:
        common, owns = named(y)
        pairs = zip(groups, owns, strict=True)
        each = [_of_group(model, common, *pair) for pair in pairs]
        known = _of_calibrations(model.calibrations, common)
        parts, roots = [known, *(part for part, _ in each)], [root for _, root in each]
        weak, _ = model.calibrations.weak(common)
        value = 0.5 * jnp.dot(weak, weak) + sum(part.objective for part in parts)
        return _Near(parts, roots, signals(common)), value

    def follow(
        y: Float[Array, " parameter"], near: _Near, objective: Float[Array, ""]
    ) -> tuple[Float[Array, " parameter"], Float[Array, ""]]:
        common, owns = named(y)
        common, (_, result, found) = stepped(
            None,
            solver,
            common,
            (signals, near),
            MAX_STEPS,
        )
        changes = near.changes(signals(common))
        moved = [part.own(change) for part, change in zip(near.parts, changes, strict=True)][1:]
        owns = [
            own - jnp.einsum("lop,lp->lo", root, of)
            for own, root, of in zip(owns, near.roots, moved, strict=True)
        ]
        promised = successive.promised(objective - found.objective, result)
        return ravel_pytree((common, owns))[0], promised

    y, least = successive.approached(approximate, follow, start, terms)
    return *named(y), least
