"""The likelihood of loads behind one driver: of all harmonics, and condensed near a point."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float

from etid.circuits.circuit import with_slopes
from etid.likelihood.gains import Gains, Slopes
from etid.likelihood.linear import NormalEquations
from etid.likelihood.own_prior import OwnPrior, slopes_of, terms_of
from etid.likelihood.profile import Condensed, Profile, Records, States
from etid.likelihood.shared import Unloaded
from etid.likelihood.transient import Transient, orders, relaxations
from etid.precision import array_function, namespace
from etid.signals.knots import DENSITY, Knots, knots
from etid.signals.transfer import AnyArray, as_complex, frequency_variable, reciprocal

ROWS = 32  # loads side by side: more leave the cache of a processor, fewer cost calls
FARTHEST = 3.0  # scale of a step in the logarithm of an element, and in a delay [samples]


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
        own: Prior of the elements as a function of the circuit, beside those of `centre` and
            `width`.
    """

    gains: Gains
    records: Records
    centre: Float[AnyArray, " q"]
    width: Float[AnyArray, " q"]
    unloaded: Unloaded | None = None
    density: int = dataclasses.field(default=DENSITY, metadata={"static": True})
    transient: Transient | None = None
    ignored: Float[AnyArray, "*row bin"] | None = None
    own: OwnPrior | None = dataclasses.field(default=None, metadata={"static": True})

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

    def louder(self, factor: Float[np.ndarray, " row"]) -> "Load":
        """The same with so many times the power of all noise."""
        factor, records, unloaded = factor[:, None], self.records, self.unloaded
        of_y = factor[:, None] * records.variance_y
        records = records._replace(variance_x=factor * records.variance_x, variance_y=of_y)
        unloaded = unloaded and unloaded._replace(variance=factor * unloaded.variance)
        ignored = None if self.ignored is None else factor * self.ignored
        return dataclasses.replace(self, records=records, unloaded=unloaded, ignored=ignored)

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

    def rest(self, q: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row prior"]:
        """Terms of the priors: one of each parameter, then those of `own`."""
        terms = (q - self.centre) / self.width
        if self.own is None:
            return terms
        own = terms_of(self.own, self.gains.circuit, self.gains.split(q)[0])
        return namespace(q).concatenate([terms, own], -1)

    def told(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        """The normal equations of the priors."""
        rest, prior, xp = self.rest(q), 1 / self.width, namespace(q)
        count = prior.size
        gradient, matrix = prior * rest[..., :count], prior**2 * np.eye(count)
        if self.own is not None:
            slopes = slopes_of(self.own, self.gains.circuit, self.gains.split(q)[0])
            beside = xp.zeros((*slopes.shape[:-1], count - slopes.shape[-1]))
            slopes = xp.concatenate([slopes, beside], -1)
            back = slopes.swapaxes(-1, -2)
            gradient = gradient + (back @ rest[..., count:, None])[..., 0]
            matrix = matrix + back @ slopes
        return NormalEquations(0.5 * (rest**2).sum(-1), gradient, matrix)

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


def equations(
    load: Load, near: Near, slopes: Slopes, q: Float[AnyArray, "*row q"]
) -> NormalEquations:
    """Normal equations of condensed terms, of the priors, and of the distance from the point.

    The distance keeps a step where the approximation holds (the proximal point algorithm of
    Rockafellar 1976). At the minimum it has no effect.
    """
    xp, at, split = namespace(q), near.q, load.gains.split
    rows = near.rows(slopes)
    terms = near.terms(q, slopes, split(q)[2] - split(at)[2])
    told, owned = load.told(q), load.gains.owned
    close = np.where(np.arange(q.shape[-1]) < owned, 1 / FARTHEST, 0.0)
    off = close * (q - at)
    objective = 0.5 * (terms**2).sum(-1) + told.objective + 0.5 * (off**2).sum(-1)
    gradient = (rows @ terms[..., None])[..., 0] + told.gradient + close * off
    matrix = rows @ rows.swapaxes(-1, -2) + told.matrix + close**2 * np.eye(q.shape[-1])
    finite = xp.isfinite(objective) & xp.isfinite(gradient).all(-1)
    return NormalEquations(xp.where(finite, objective, np.inf), gradient, matrix)


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
        found, xp = equations(self.load, near, near.slopes, near.q), namespace(near.q)
        objective = xp.where(xp.isfinite(found.objective), near.objective, np.inf)
        return found._replace(objective=objective)

    def of(self, rows: np.ndarray) -> "Anew":
        """Some of the rows."""
        return Anew(self.load.of(rows), self.at_knots.of(rows))
