"""One load, given the calibrations of its driver: its likelihood and the derivatives.

The likelihood is that of `etid.estimators.maximum_likelihood.profile` at the gains of
`etid.estimators.maximum_likelihood.gains`, with the z of
`etid.estimators.maximum_likelihood.given_driver` as parameters of Z_th. Near a point it is
condensed (`etid.estimators.maximum_likelihood.condensed`): the search, covariance and score tests
see only its knots.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.directions import DIRECTIONS, At, scored
from etid.estimators.element_prior import ElementPrior
from etid.estimators.maximum_likelihood.condensed import Condensed, Near, apart
from etid.estimators.maximum_likelihood.gains import (
    AbstractOutputs,
    Gains,
    Voltage,
    VoltageAndCurrent,
)
from etid.estimators.maximum_likelihood.given_driver import GivenDriver, UnloadedEstimate
from etid.estimators.maximum_likelihood.profile import Profile, Records
from etid.estimators.score_tests import falling_resistance
from etid.precision import array_function
from etid.signals.knots import Knots, knots
from etid.signals.transfer import (
    as_complex,
    combined,
    reciprocal,
    turns,
)


class Load(eqx.Module):
    """One recording, with all data that its likelihood needs.

    Attributes:
        gains: The gains at all harmonics.
        records: The recording.
        unloaded: Its X that the calibrations estimate; None if they share none with it.
    """

    gains: Gains
    records: Records
    unloaded: UnloadedEstimate | None = None

    @classmethod
    def behind(
        cls,
        driver: GivenDriver,
        circuit: AbstractCircuit,
        records: Records,
        sample_rate: Float[Array, ""],
        prior: ElementPrior | None = None,
        measured: AbstractOutputs | None = None,
    ) -> "Load":
        """A recording that was made with `driver`.

        Its outputs are V_out, and the current if there are two, unless `measured` says otherwise.
        """
        if measured is None:
            measured = Voltage() if records.y.shape[0] == 1 else VoltageAndCurrent()
        gains = Gains(driver, circuit, records.frequency, sample_rate, prior, measured)
        return cls(gains, records, driver.unloaded(records))

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.records.frequency.size)

    @property
    def terms(self) -> Float[Array, ""]:
        """Number of terms of the records."""
        return 2 * jnp.sum(self.records.selected, dtype=self.records.variance_x.dtype)

    def rest(self, q: Float[Array, " q"]) -> Float[Array, " q"]:
        """Terms of the priors."""
        return (q - self.gains.centre(q)) / self.gains.widths(q)

    def predicted(self, q: Float[Array, " q"]) -> Complex[Array, "output harmonic"]:
        """The gains."""
        f, late = self.gains.frequency, self.gains.split(q)[1]
        cycles = -f[0] * late / self.gains.sample_rate
        turned = jnp.stack([turns(of, f.size) for of in cycles])
        return self.gains.undelayed(q) * turned

    def known(self, q: Float[Array, " q"]) -> Records:
        """The records with the X that the calibrations estimate."""
        of = self.unloaded
        if of is None:
            return self.records
        z = self.gains.split(q)[2]
        x, growth = of.x + combined(z, of.x_by_z), jnp.exp(z @ of.log_variance_by_z)
        return dataclasses.replace(self.records, x=x, variance_x=of.variance * growth)

    def profile(self, q: Float[Array, " q"]) -> Profile:
        """The likelihood at these parameters."""
        return apart(lambda q: Profile.of(self.known(q), self.predicted(q)), q)

    def residual(self, q: Float[Array, " q"]) -> Float[Array, " part"]:
        """Terms of the records."""
        return self.profile(q).terms.ravel()

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " term"]:
        """Terms of the records and of the priors."""
        return jnp.concatenate([self.residual(q), self.rest(q)])

    def near(self, q: Float[Array, " q"], every: Knots | None = None) -> Near:
        """The load near `q`, at these knots or its own."""
        every, profile = every or self.knots, self.profile(q)
        condensed = apart(lambda _: Condensed.of([profile], every), q)
        slopes, by_x = apart(self.gains.at(every).slopes, q), None
        if self.unloaded is not None:
            relative = self.unloaded.x_by_z * reciprocal(profile.x)[None, :]
            size, total = profile.size[0], every.summed(profile.size[0])
            by_x = every.summed(as_complex(size)[None, :] * relative)
            by_x = by_x * as_complex(1 / jnp.where(total > 0, total, 1.0))[None, :]
        return Near(q, [profile], condensed, slopes, by_x)

    def by_x(self, near: Near) -> Float[Array, "z harmonic"]:
        """Derivatives of the objective by the z that X depends on, at each harmonic."""
        assert self.unloaded is not None
        return near.profile.by_x(self.known(near.q), *self.unloaded[2:])


@array_function
def changes(load: Load, near: Near) -> dict[str, Complex[Array, "change output knot"]]:
    """Derivatives of the gains with respect to each of the changes that a fit tests for."""
    slopes, at = near.slopes, load.gains.at(load.knots)
    turn = at.turned(near.q, jnp.ones_like(slopes.gains), at.frequency)
    current = slopes.gains[0] * jnp.conj(turn[0]) * reciprocal(slopes.z)
    by_source = -current * slopes.gains * (0.0 if load.gains.driver.by_current else 1.0)
    circuit = load.gains.circuit.with_log_values(load.gains.split(near.q)[0])
    each = slopes.gains, slopes.by_z, by_source, turn, circuit.response
    place = At(at.frequency, slopes.z, *each, bool(circuit.exponents()))
    return {name: DIRECTIONS[name].change(place) for name in scored()}


def by_falling(load: Load, near: Near) -> Complex[Array, "output harmonic"]:
    """What a resistance that falls with its current adds to the outputs [V²]."""
    slopes, every = near.slopes, load.knots
    sensitivity = slopes.by_z * (slopes.z * reciprocal(slopes.gains[0]))[None, :]
    v_out = every.between(slopes.gains[0]) * near.profile.x
    return falling_resistance.added_voltage(v_out, slopes.z, sensitivity, every)
