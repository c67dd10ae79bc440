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
from jaxtyping import Bool, Complex, Float, Int

from etid.circuits.circuit import with_slopes
from etid.likelihood.gains import Gains, Slopes
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
from etid.likelihood.profile import Condensed, Profile, Records, States
from etid.likelihood.shared import Unloaded
from etid.likelihood.transient import Transient, orders, relaxations
from etid.precision import array_function, held, in_turn, namespace
from etid.signals.knots import DENSITY, Knots, knots
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal

ROWS = 32  # loads side by side: more leave the cache of a processor, fewer cost calls
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
SAME = 1.0  # largest difference of ½ Σ r² between two searches that have found one minimum
STEPS = 50  # largest number of steps at the knots of one point
FARTHEST = 3.0  # scale of a step in the logarithm of an element, and in a delay [samples]
DISTANT = 0.1  # part of ½ Σ r² that a step promises, above which a point is distant
ROUGHLY = 1e-3  # of ½ Σ r², which a step of a rough fit of a distant point reduces
WELL = 0.1  # of the distance `BEFORE`, to which the condensed terms are minimised


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Load:
    """Recordings behind one driver, with all that their likelihood needs.

    Attributes:
        gains: The gains at all harmonics.
        records: The recordings.
        centre: Prior means of the parameters.
        width: Prior standard deviations of the parameters; infinite without a prior.
        unloaded: X that the calibrations estimate; None if the recordings share none with them.
        density: Of the knots (`etid.signals.knots.knots`).
        transient: What the states at the ends of the records are made of; None if the recordings
            are of whole periods.
        ignored: E|noise|² of X that the weights leave out; None if they do not.
    """

    gains: Gains
    records: Records
    centre: Float[AnyArray, " q"]
    width: Float[AnyArray, " q"]
    unloaded: Unloaded | None = None
    density: int = dataclasses.field(default=DENSITY, metadata={"static": True})
    transient: Transient | None = None
    ignored: Float[AnyArray, "*row bin"] | None = None

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.records.x.shape[-1], self.density)

    def of(self, rows: np.ndarray) -> "Load":
        """Some of the rows."""
        unloaded = self.unloaded and self.unloaded.of(rows)
        gains, records = self.gains.of(rows), self.records.of(rows)
        transient = self.transient and self.transient.of(rows)
        of = {"gains": gains, "records": records, "unloaded": unloaded, "transient": transient}
        of["ignored"] = None if self.ignored is None else self.ignored[rows]
        return dataclasses.replace(self, **of)

    @property
    def has_current(self) -> bool:
        """Whether the current through the load was measured."""
        return self.gains.source.loaded is None or self.gains.outputs.count > 1

    def known(self, q: Float[AnyArray, "*row q"]) -> Records:
        """The records with the X that the calibrations estimate."""
        if self.unloaded is None:
            return self.records
        x, variance = self.unloaded.at(self.gains.split(q)[2])
        return self.records._replace(x=x, variance_x=variance)

    def rest(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row q"]:
        """Terms of the priors."""
        return (q - self.centre) / self.width

    @array_function
    def objective(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row"]:
        """½ Σ r² of all terms."""
        profile = self.profile(q, self.gains.at(self.knots.index))[0]
        return profile.objective + 0.5 * (self.rest(q) ** 2).sum(-1)

    def profile(
        self, q: Float[AnyArray, "*row q"], at_knots: Gains
    ) -> tuple[Profile, States | None]:
        """The likelihood at all harmonics, and what the states make of the outputs."""
        records, gains = self.known(q), self.gains(q)
        if self.transient is None:
            return Profile.of(records, gains), None
        z, frequency = at_knots.impedance(q), self.gains.frequency
        degrees = orders(type(self.gains.circuit))
        of = relaxations(degrees, at_knots.frequency, z, frequency).values
        turn = self.gains.of_states(q, self.gains.turn(q))
        states = self.transient.states(gains, turn, of)
        return Profile.of(records, gains, states), states

    def at_knots(self, q: Float[AnyArray, "*row q"], at_knots: Gains) -> Profile:
        """The likelihood of the harmonics at the knots alone."""
        records = Records(*(each[..., self.knots.index] for each in self.known(q)))
        gains, states = at_knots.at_few(q), None
        if self.transient is not None:
            f = at_knots.frequency
            turn = at_knots.of_states(q, at_knots.turn_at_few(at_knots.split(q)[1]))
            degrees = orders(type(self.gains.circuit))
            of = relaxations(degrees, f, at_knots.impedance(q), f).values
            transient = self.transient.at(self.knots.index)
            states = transient.states(gains, turn, of)
        return Profile.of(records, gains, states)


class Near(NamedTuple):
    """A likelihood near a point.

    Attributes:
        q: The point.
        objective: ½ Σ r² of all terms.
        profile: The likelihood at all harmonics.
        condensed: The same at the knots.
        slopes: The gains and their derivatives at the knots.
        by_x: Relative derivatives of X with respect to z at the knots; None if X does not depend
            on z.
        states_by_q: Derivatives of what the states make of the outputs at the knots, but for those
            by the gains; None without states.
    """

    q: Float[AnyArray, "*row q"]
    objective: Float[AnyArray, "*row"]
    profile: Profile
    condensed: Condensed
    slopes: Slopes
    by_x: Complex[AnyArray, "*row z knot"] | None
    states_by_q: Complex[AnyArray, "*row q output knot"] | None = None

    @classmethod
    def of(cls, load: Load, at_knots: Gains, q: Float[AnyArray, "*row q"]) -> "Near":
        """The likelihood near q."""
        (profile, states), every = load.profile(q, at_knots), load.knots
        objective = profile.objective + 0.5 * (load.rest(q) ** 2).sum(-1)
        by_x = None
        if load.unloaded is not None:
            xp, size = namespace(q), profile.size[..., :1, :]
            moved = load.unloaded.x_by_z * reciprocal(profile.driving[..., :1, :])
            sums = every.summed(xp.concatenate([size, size * moved.real, size * moved.imag], -2))
            total, (real, imag) = sums[..., :1, :], xp.split(sums[..., 1:, :], 2, -2)
            by_x = (real + 1j * imag) / as_complex(xp.where(total > 0, total, 1.0))
        slopes = at_knots.slopes(q)
        condensed, by_q = Condensed.of([profile], every, states), None
        if load.transient is not None:
            by_q = _states_by_q(load, at_knots, q, profile, slopes)
        return cls(q, objective, profile, condensed, slopes, by_x, by_q)

    def by_q(self, slopes: Slopes) -> Complex[AnyArray, "*row q output knot"]:
        """Derivatives of G X/X̂ with respect to the parameters."""
        if self.by_x is None:
            return slopes.by_q
        moved = self.by_x[..., None, :] * slopes.gains[..., None, :, :]
        own = slopes.by_q.shape[-3] - moved.shape[-3]
        parts = slopes.by_q[..., :own, :, :], slopes.by_q[..., own:, :, :] + moved
        return namespace(moved).concatenate(parts, -3)

    def moved(self, slopes: Slopes, z: Float[AnyArray, "*row z"]) -> AnyArray:
        """The gains times X/X̂, at z that are so much larger than those of the point."""
        if self.by_x is None:
            return slopes.gains
        change = (as_complex(z)[..., None] * self.by_x).sum(-2)
        return slopes.gains * (1 + change[..., None, :])

    @property
    def jacobian(self) -> Float[AnyArray, "*row q part"]:
        """Transposed Jacobian of the condensed terms."""
        return self.rows(self.slopes)

    def rows(self, slopes: Slopes) -> Float[AnyArray, "*row q part"]:
        """Derivatives of the condensed terms at other gains."""
        return self.condensed.rows(self.by_q(slopes), self.states_by_q)

    def terms(
        self, q: Float[AnyArray, "*row q"], slopes: Slopes, z: Float[AnyArray, "*row z"]
    ) -> Float[AnyArray, "*row part"]:
        """The condensed terms at q, with z that are so much larger than those of the point."""
        states = None
        if self.states_by_q is not None:
            states = (as_complex(q - self.q)[..., None, None] * self.states_by_q).sum(-3)
        return self.condensed.terms(self.moved(slopes, z), states)


def _states_by_q(
    load: Load, at_knots: Gains, q: Float[AnyArray, "*row q"], profile: Profile, slopes: Slopes
) -> Complex[AnyArray, "*row q output knot"]:
    """∂/∂q of what the states make, at the same X − V: by decays of the load, its delay, and δ."""
    assert load.transient is not None
    assert profile.states is not None
    xp, count, e = namespace(q), load.transient.decays.shape[-2], at_knots.elements
    logs, delays, _ = at_knots.split(q)
    f, every = at_knots.frequency, load.gains.outputs.count
    z, by_element = with_slopes(load.gains.circuit, logs, f)
    of = relaxations(orders(type(load.gains.circuit)), f, z, f, by_element)
    p = profile.states[..., count : count + of.values.shape[-2]]
    whole = (as_complex(p)[..., None] * of.values).sum(-2)[..., None, :]
    turn = at_knots.of_states(q, at_knots.turn_at_few(delays))[..., None, :]
    first = np.eye(every)[0][:, None]
    passed = load.transient.passed
    if passed is not None:  # V_out is the only output of a current
        turn = turn * passed[..., None, load.knots.index]
    own = first * turn
    by_voltage = own - slopes.gains if load.transient.behind else own + 0 * slopes.gains
    moved = xp.zeros((*q.shape[:-1], e, f.shape[-1]), complex)
    if of.by_logs is not None:
        moved = of.by_logs * whole
    by_logs = moved[..., None, :] * by_voltage[..., None, :, :]
    s = frequency_variable(f / load.gains.sample_rate)[..., None, :]
    by_delay = (-s * whole * own)[..., None, :, :]
    exact, delta = at_knots.exact, at_knots.discrepancy
    rest = xp.zeros((*q.shape[:-1], q.shape[-1] - e - 1, every, f.shape[-1]), complex)
    if delta is None:
        return xp.concatenate([by_logs, by_delay, rest], -3)
    by_delta = delta.by_coefficient(every) * (whole * own)[..., None, :, :]
    rest = rest[..., : exact - e - 1, :, :], by_delta, rest[..., at_knots.owned - e - 1 :, :, :]
    return xp.concatenate([by_logs, by_delay, *rest], -3)


def of_load(load: Load, near: "Near") -> Complex[AnyArray, "*row output knot"] | None:
    """What the states of the load make of the outputs at the knots; None without states."""
    if load.transient is None:
        return None
    assert near.profile.states is not None
    at_knots = load.gains.at(load.knots.index)
    count, every = load.transient.decays.shape[-2], load.gains.outputs.count
    f, delays = at_knots.frequency, at_knots.split(near.q)[1]
    z = at_knots.impedance(near.q)
    of = relaxations(orders(type(load.gains.circuit)), f, z, f).values
    p = near.profile.states[..., count : count + of.shape[-2]]
    turn = at_knots.of_states(near.q, at_knots.turn_at_few(delays))
    if load.transient.passed is not None:
        turn = turn * load.transient.passed[..., load.knots.index]
    whole = (as_complex(p)[..., None] * of).sum(-2) * turn
    return np.eye(every)[0][:, None] * whole[..., None, :]


def _equations(
    load: Load, near: Near, slopes: Slopes, q: Float[AnyArray, "*row q"]
) -> NormalEquations:
    """Normal equations of condensed terms, of the priors, and of the distance from the point.

    The distance keeps a step where the approximation holds (the proximal point algorithm of
    Rockafellar 1976). At the minimum it has no effect.
    """
    xp, at, split = namespace(q), near.q, load.gains.split
    rows = near.rows(slopes)
    terms = near.terms(q, slopes, split(q)[2] - split(at)[2])
    prior, owned = 1 / load.width, load.gains.owned
    close = np.where(np.arange(q.shape[-1]) < owned, 1 / FARTHEST, 0.0)
    rest, off = load.rest(q), close * (q - at)
    every = (terms**2).sum(-1) + (rest**2).sum(-1) + (off**2).sum(-1)
    gradient = (rows @ terms[..., None])[..., 0] + prior * rest + close * off
    matrix = rows @ rows.swapaxes(-1, -2) + (prior**2 + close**2) * np.eye(q.shape[-1])
    finite = xp.isfinite(every) & xp.isfinite(gradient).all(-1)
    return NormalEquations(xp.where(finite, 0.5 * every, np.inf), gradient, matrix)


@dataclasses.dataclass(frozen=True)
class _Knots:
    """Condensed terms near a point, as a function of the parameters."""

    load: Load
    at_knots: Gains
    near: Near

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        return _equations(self.load, self.near, self.at_knots.slopes(q), q)

    def of(self, rows: np.ndarray) -> "_Knots":
        return _Knots(self.load.of(rows), self.at_knots.of(rows), taken(self.near, rows))


@dataclasses.dataclass(frozen=True)
class Anew:
    """Terms that are condensed anew at each point."""

    load: Load
    at_knots: Gains

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        """The normal equations at a point."""
        return self.at(Near.of(self.load, self.at_knots, q))

    def at(self, near: Near) -> NormalEquations:
        """The normal equations where the likelihood is known."""
        found, xp = _equations(self.load, near, near.slopes, near.q), namespace(near.q)
        objective = xp.where(xp.isfinite(found.objective), near.objective, np.inf)
        return found._replace(objective=objective)

    def of(self, rows: np.ndarray) -> "Anew":
        """Some of the rows."""
        return Anew(self.load.of(rows), self.at_knots.of(rows))


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
        wrong[rows] = ~(fits(best, load.records.terms[rows]) | (abs(reduced) <= SAME))
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
    roughly = _equations(load, near, near.slopes, near.q).matrix
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
    here = _equations(load, near, near.slopes, best)
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
