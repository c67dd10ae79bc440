"""Terms of the non-parametric likelihood: the equation error of a load at each harmonic.

The equations are those of `etid.estimators.non_parametric.fit`.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import DELAY_WIDTH
from etid.estimators.maximum_likelihood.profile import Profile, total
from etid.estimators.score_tests import other_circuit
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import HarmonicDriver, SourceImpedance
from etid.signals.harmonics import Spectrum, real_parts, same_unloaded, signal_share
from etid.signals.transfer import as_complex, delayed, frequency_variable, power, reciprocal

CLEAR = 0.97  # smallest share of signal in the power of a calibration's Y, 15 dB


def clearly_shown(calibrations: list[Spectrum]) -> Bool[Array, "calibration harmonic"]:
    """Harmonics that each calibration shows clearly."""
    shown = [s.selected & (signal_share(s.y, s.variance_y) > CLEAR) for s in calibrations]
    return jnp.stack(shown)


def _root(x: Float[Array, " harmonic"]) -> Float[Array, " harmonic"]:
    """√x with the derivative 0 at 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


class Measured(eqx.Module):
    """Z_th at the harmonics, and the sources of its errors.

    Attributes:
        z: Z_th [Ω].
        by_x: Derivative of Z_th with respect to the X of each calibration.
        by_y: Variance of Z_th by the noise of the Y of all calibrations.
        apart: Difference of each calibration from the mean [standard deviations].
    """

    z: Complex[Array, " harmonic"]
    by_x: list[Complex[Array, " harmonic"]]
    by_y: Float[Array, " harmonic"]
    apart: list[Complex[Array, " harmonic"]]


class Equation(NamedTuple):
    """The equation error of a load.

    Attributes:
        y: Y without the delay of the load.
        load: Z_L.
        z_th: Z_th and the sources of its errors.
        error: e.
        variance: Its variance.
        own: The part of the variance that only the load has.
        weight: 1/σ of both parts of e; 0 where a harmonic is not used.
    """

    y: Complex[Array, " harmonic"]
    load: Complex[Array, " harmonic"]
    z_th: Measured
    error: Complex[Array, " harmonic"]
    variance: Float[Array, " harmonic"]
    own: Float[Array, " harmonic"]
    weight: Float[Array, " harmonic"]


class Model(eqx.Module):
    """The terms of the calibrations and of a load; the load is the last record."""

    circuit: AbstractCircuit
    r_load: Float[Array, " calibration"]
    calibration_rate: Float[Array, ""]
    sample_rate: Float[Array, ""]
    clear: Bool[Array, "calibration harmonic"]
    selected: Bool[Array, " harmonic"]

    def named(self, q: Float[Array, " q"]) -> tuple[LoadUnknowns, Float[Array, " calibration"]]:
        """The unknowns of the load, and the delays of the calibrations [samples]."""
        last = q.size - 1
        elements, late, delay = jnp.split(q, (last - self.r_load.size, last))
        return LoadUnknowns(elements, delay[0]), late

    def load(
        self, q: Float[Array, " q"], frequency: Float[Array, " harmonic"]
    ) -> Complex[Array, " harmonic"]:
        """Z_L."""
        load = self.circuit.with_log_values(self.named(q)[0].log_elements).impedance()
        return load(frequency_variable(frequency))

    def z_th(self, q: Float[Array, " q"], records: list[Spectrum]) -> Measured:
        """Mean of the Z_th of the calibrations, weighted by their variances."""
        z, by_x, by_y, weights = [], [], [], []
        _, late = self.named(q)
        for r, delay, s, clear in zip(self.r_load, late, records[:-1], self.clear, strict=True):
            y = delayed(s.y, s.frequency, -delay, self.calibration_rate)
            inverse_y = reciprocal(y)
            slope = as_complex(r) * inverse_y
            one = slope * s.x - as_complex(r)
            variance = power(slope * s.x * inverse_y) * s.variance_y
            z.append(one)
            by_x.append(slope)
            by_y.append(variance)
            used = clear | ~self.selected  # if not selected, use all: this avoids 0/0
            weights.append(jnp.where(used, 1 / (variance + power(slope) * s.variance_x), 0.0))
        every = total(weights)
        parts = [w / every for w in weights]
        mean = total([as_complex(p) * one for p, one in zip(parts, z, strict=True)])
        return Measured(
            mean,
            [as_complex(p) * slope for p, slope in zip(parts, by_x, strict=True)],
            total([p**2 * variance for p, variance in zip(parts, by_y, strict=True)]),
            [(one - mean) * as_complex(_root(2 * w)) for one, w in zip(z, weights, strict=True)],
        )

    def equation(self, q: Float[Array, " q"], records: list[Spectrum]) -> Equation:
        """The equation error of the load."""
        spectrum, of = records[-1], self.z_th(q, records)
        late, load = self.named(q)[0].delay_samples, self.load(q, spectrum.frequency)
        y = delayed(spectrum.y, spectrum.frequency, -late, self.sample_rate)
        own = power(load + of.z) * spectrum.variance_y
        variance = own + power(y) * of.by_y
        together, shared = -load, jnp.zeros((), dtype=bool)
        for slope, s in zip(of.by_x, records[:-1], strict=True):
            same = same_unloaded(spectrum.x, s.x)
            shared = shared | same
            variance = variance + jnp.where(same, 0.0, power(y * slope) * s.variance_x)
            together = together + jnp.where(same, y * slope, 0.0)
        of_x = power(together) * spectrum.variance_x
        variance, own = variance + of_x, own + jnp.where(shared, 0.0, of_x)
        weight = jnp.where(self.selected, jnp.sqrt(2 / variance), 0.0)
        error = (load + of.z) * y - load * spectrum.x
        return Equation(y, load, of, error, variance, own, weight)

    def terms(self, q: Float[Array, " q"], records: list[Spectrum]) -> Float[Array, " term"]:
        """Scaled e, the weak priors of the delays, and differences between calibrations."""
        at, (own, late) = self.equation(q, records), self.named(q)
        delays = jnp.append(late, own.delay_samples) / DELAY_WIDTH
        parts = [real_parts(at.error * as_complex(at.weight)), delays]
        if len(at.z_th.apart) > 1:
            apart = jnp.where(self.selected[None, :], jnp.stack(at.z_th.apart), 0.0)
            parts.append(real_parts(apart.ravel()))
        return jnp.concatenate(parts)

    def without_noise(self, q: Float[Array, " q"], records: list[Spectrum]) -> list[Spectrum]:
        """The records with the Y of the load that all other records predict."""
        spectrum, of = records[-1], self.z_th(q, records)
        load = self.load(q, spectrum.frequency)
        g = load * reciprocal(load + of.z)
        late = self.named(q)[0].delay_samples
        y = delayed(g * spectrum.x, spectrum.frequency, late, self.sample_rate)
        return [*records[:-1], eqx.tree_at(lambda s: s.y, spectrum, y)]

    def predicted(
        self, q: Float[Array, " q"], records: list[Spectrum], source: SourceImpedance
    ) -> tuple[list[Spectrum], Float[Array, " part"]]:
        """The records with the Y that a model of Z_th predicts, and the share of signal in X."""
        f, (own, late) = records[-1].frequency, self.named(q)
        z_th = source.response(f)
        loads = [*map(as_complex, self.r_load), self.load(q, f)]
        delays, count = jnp.append(late, own.delay_samples), self.r_load.size
        rates = [*[self.calibration_rate] * count, self.sample_rate]
        gains = [
            delayed(load * reciprocal(load + z_th), f, delay, rate)
            for load, delay, rate in zip(loads, delays, rates, strict=True)
        ]
        known = [
            eqx.tree_at(lambda s: s.y, s, g * s.x)
            for s, g in zip(records[:-1], gains[:-1], strict=True)
        ]
        profile = Profile.of_output(records[-1], gains[-1])
        spectrum = eqx.tree_at(
            lambda s: (s.x, s.y), records[-1], (profile.x, gains[-1] * profile.x)
        )
        return [*known, spectrum], jnp.tile(signal_share(profile.x, profile.variance_x), 2)

    def changes(
        self, q: Float[Array, " q"], records: list[Spectrum]
    ) -> Float[Array, "change term"]:
        """Derivatives of e with respect to changes of the circuit and, last, a gain of Y."""
        impedance = self.circuit.with_log_values(self.named(q)[0].log_elements).impedance()
        spectrum, at = records[-1], self.equation(q, records)
        _, by_change = other_circuit.changes(impedance, spectrum.frequency)
        e = by_change * (at.y - spectrum.x)[None, :]
        e = jnp.concatenate([e, ((at.load + at.z_th.z) * at.y)[None, :]])
        return real_parts(e * as_complex(at.weight)[None, :])

    def by_drift(
        self, q: Float[Array, " q"], records: list[Spectrum], driver: HarmonicDriver
    ) -> Float[Array, "parameter term"]:
        """Changes of e by one standard deviation of the drift of each parameter of Z_th."""
        at = self.equation(q, records)
        _, slopes = driver.source.with_slopes(records[-1].frequency)
        changed = slopes * as_complex(jnp.asarray(driver.drift_std()))[:, None]
        return real_parts(changed * (at.y * as_complex(at.weight))[None, :])
