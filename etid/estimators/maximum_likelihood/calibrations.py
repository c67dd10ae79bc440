"""The likelihood of the calibrations of a driver.

It is that of `etid.estimators.maximum_likelihood.profile`. Calibrations that share an unloaded
record are outputs of one input, so that all of them tell of the same X; the others have inputs of
their own. The objective is that of all harmonics; gradient, curvature, covariance and score tests
are condensed (`etid.estimators.maximum_likelihood.condensed`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.estimators.estimate import DELAY_WIDTH, delay_width, prior
from etid.estimators.maximum_likelihood.condensed import Condensed, Near, Slopes, apart, means
from etid.estimators.maximum_likelihood.profile import Profile, Records, excess, total
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.likelihood.fit import FAULTS
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.instrument import Instrument
from etid.signals.harmonics import Spectrum, same_unloaded
from etid.signals.knots import Knots, knots
from etid.signals.transfer import as_complex, delayed, frequency_variable, reciprocal
from etid.solvers.matrices import inverse_root

DENSE = 32  # density of the knots: the floor of the driver's valley is flat


class Calibrations(eqx.Module):
    """The likelihood of the calibrations of a driver.

    In all methods `common` is the vector of the `DriverUnknowns`, followed by the errors of the
    instrument in their standard deviations: gain, crosstalk, capacitance, then the known resistor
    of each calibration and the capacitance across it, which those of equal value share.
    A gain g, a crosstalk κ, an error θ of the resistor R and a capacitance C across it change the
    gains to

        V_out / V_th = (1 + g) R' / (R' + Z_th) + κ,      R' = R (1 + θ) ‖ C.

    Attributes:
        source: Z_th identified from the calibrations.
        calibration: Resistors and delays of the calibrations.
        spectra: Harmonics of the calibrations.
        rate: Sampling rate of the calibrations [Hz].
        delay_width: Prior standard deviation of every trigger delay, of loads too [samples].
        instrument: Tolerances of the instrument; None if it has none.
    """

    source: SourceImpedance
    calibration: Calibration
    spectra: Spectrum
    rate: Float[Array, ""]
    delay_width: Float[Array, ""] = eqx.field(default_factory=lambda: jax.device_put(DELAY_WIDTH))
    instrument: Instrument | None = None

    @classmethod
    def of(cls, driver: HarmonicDriver) -> "Calibrations":
        """The calibrations of an identified driver."""
        rate = jnp.asarray(driver.sample_rate)
        width = delay_width(driver.instrument, rate)
        of = driver.source, driver.calibration, driver.spectra, rate, width
        return cls(*of, instrument=driver.instrument)

    @property
    def tolerances(self) -> Float[Array, " error"]:
        """Standard deviation of each error of the instrument."""
        of, count = self.instrument, self.calibration.r_load.size
        return jnp.zeros(0) if of is None else of.deviations(count)

    @property
    def unknowns(self) -> int:
        """Number of the `DriverUnknowns`, which the errors of the instrument follow."""
        return ravel_pytree(self.source)[0].size + self.calibration.r_load.size

    def errors(self, common: Float[Array, "*row common"]) -> Float[Array, "*row error"]:
        """The errors of the instrument among the common parameters."""
        return common[..., common.shape[-1] - self.tolerances.size :]

    @property
    def knots(self) -> Knots:
        """Knots of the harmonics."""
        return knots(self.spectra.x.shape[-1], DENSE)

    def records(self) -> list[Records]:
        """Each unloaded record with the outputs of all calibrations.

        An output is used with the first input that is its own unloaded record.
        """
        s, found = self.spectra, []
        free = jnp.ones(s.x.shape[0], bool)
        for number, x in enumerate(s.x):
            mine = jnp.stack([jnp.asarray(same_unloaded(x, other)) for other in s.x]) & free
            free, used = free & ~mine, s.selected & mine[:, None]
            of_x = s.frequency[number], x, s.variance_x[number]
            found.append(Records(*of_x, s.y, s.variance_y, used))
        return found

    def profiles(self, gains: Complex[Array, "record harmonic"]) -> list[Profile]:
        """The likelihood of each unloaded record and its outputs."""
        return [Profile.of(of, gains) for of in self.records()]

    def terms(self, gains: Complex[Array, "record harmonic"]) -> Float[Array, "record part"]:
        """Innovations of the records, scaled to unit variance."""
        return total([of.terms for of in self.profiles(gains)])

    def noise(self, part: Float[Array, "record part"]) -> Float[Array, "record harmonic"]:
        """`excess` of the innovations of each calibration."""
        return jax.vmap(excess)(part, self.spectra.selected)[:, : self.spectra.x.shape[-1]]

    def start(self) -> Float[Array, " common"]:
        """The common parameters identified from the calibrations alone."""
        vector, _ = ravel_pytree(self.source)
        known = DriverUnknowns(vector, self.calibration.delay_samples).vector()
        errors = self.calibration.errors
        if self.instrument is None or errors is None:
            errors = jnp.zeros_like(self.tolerances)
        return jnp.concatenate([known, errors])

    def named(self, common: Float[Array, " common"]) -> DriverUnknowns:
        """The common parameters by name."""
        known = common[: common.size - self.tolerances.size]
        return DriverUnknowns.of(known, self.calibration.r_load.size)

    def source_of(self, common: Float[Array, " common"]) -> SourceImpedance:
        """Z_th with these common parameters."""
        return ravel_pytree(self.source)[1](self.named(common).source)

    def gains(
        self, common: Float[Array, " common"], every: Knots | None = None
    ) -> Complex[Array, "record frequency"]:
        """Gains R e^(−jωτ) / (R + Z_th) with the known resistors, at all harmonics or at knots."""
        f = self._frequency(every)
        return self._gains(common, f, jax.vmap(self.source_of(common).response)(f))[0]

    def _frequency(self, every: Knots | None) -> Float[Array, "record frequency"]:
        of = self.spectra.frequency
        return of if every is None else every.at(of)

    def _gains(
        self,
        common: Float[Array, " common"],
        f: Float[Array, "record frequency"],
        z_th: Complex[Array, "record frequency"],
    ) -> tuple[Complex[Array, "... frequency"], ...]:
        """The gains, and their derivatives with respect to Z_th and to the errors."""
        r_load = self.calibration.r_load
        known = resistance = as_complex(r_load)[:, None]
        # Records with equal values are of one resistor: they have the errors of the first of them.
        first = jnp.argmax(r_load[:, None] == r_load[None], axis=1)
        off, s = as_complex(self.tolerances * self.errors(common)), frequency_variable(f)
        right = known  # R (1 + θ)
        if self.instrument is not None:
            of_r, across = off[FAULTS:].reshape(2, -1)[:, first, None]
            right = known * (1 + of_r)
            resistance = right * reciprocal(1 + s * across * right)
        loop, late = reciprocal(resistance + z_th), self.named(common).delay_samples
        gains = jax.vmap(delayed, (0, 0, 0, None))(resistance * loop, f, late, self.rate)
        by_z = -gains * loop
        if self.instrument is None:
            return gains, by_z, gains[None][:0]
        gain, crosstalk, *_ = off
        inverse = reciprocal(resistance)
        turned = gains * (resistance + z_th) * inverse
        of_loads = jnp.stack([gains, turned, jnp.zeros_like(gains)])  # nothing is across a skin
        # ∂R'/∂θ = R R'² / (R (1 + θ))²,      ∂R'/∂C = −s R'²
        by_r = -(1 + gain) * by_z * z_th * resistance
        of_each = jnp.stack([by_r * known * reciprocal(right * right), -s * by_r])
        alone = as_complex(jnp.eye(known.size)[first].T)[None, :, :, None]
        of_each = (alone * of_each[:, None]).reshape(-1, *gains.shape)
        by_error = jnp.concatenate([of_loads, of_each])
        by_error = by_error * as_complex(self.tolerances)[:, None, None]
        return (1 + gain) * gains + crosstalk * turned, (1 + gain) * by_z, by_error

    def slopes(self, common: Float[Array, " common"], every: Knots | None = None) -> Slopes:
        """The gains and their derivatives, at all harmonics or at knots."""
        f = self._frequency(every)
        z_th, by_source = jax.vmap(self.source_of(common).with_slopes, out_axes=(0, 1))(f)
        gains, by_z, by_error = self._gains(common, f, z_th)
        by_delay = -gains * frequency_variable(f / self.rate)
        alone = np.eye(f.shape[0], dtype=complex)[:, :, None]
        rows = [by_source * by_z[None], alone * by_delay[None], by_error]
        return Slopes(z_th, gains, by_z, jnp.concatenate(rows))

    @jax.jit  # JAX remembers its trace
    def near(self, common: Float[Array, " common"]) -> Near:
        """The calibrations near these common parameters."""
        profiles = apart(lambda c: self.profiles(self.gains(c)), common)
        condensed = apart(lambda _: Condensed.of(profiles, self.knots), common)
        return Near(
            common, profiles, condensed, apart(lambda c: self.slopes(c, self.knots), common)
        )

    def linear(self, near: Near) -> Linear:
        """The condensed terms, linear in the common parameters."""
        share = total([jnp.where(of.weight > 0, of.share[None, :], 0.0) for of in near.profiles])
        noise = self.noise(total([of.terms for of in near.profiles]))
        found = means(near.profiles, self.knots, jnp.stack([share, noise]))
        return Linear(near.jacobian, *found, priors=self.weak(near.q)[1])

    def following(self, linear: Linear) -> Float[Array, "known error"]:
        """Changes of Z_th and of the delays at their minimum by the errors of the instrument."""
        curvature = linear.curvature().expected
        known = len(curvature) - self.tolerances.size
        root = inverse_root(curvature[:known, :known])
        return -root @ (root.T @ curvature[:known, known:])

    def gradient(self, near: Near, linear: Linear) -> Float[Array, " common"]:
        """Gradient of the condensed terms and of the weak priors."""
        return linear.jacobian @ near.condensed.part + self.rest(near.q)

    def rest(self, common: Float[Array, " common"]) -> Float[Array, " common"]:
        """Gradient of the weak priors."""
        terms, rows = self.weak(common)
        return rows @ terms

    @jax.jit  # JAX remembers its trace
    def weak(
        self, common: Float[Array, " common"]
    ) -> tuple[Float[Array, " term"], Float[Array, "common term"]]:
        """The terms of the weak priors and their derivatives."""
        of = self.named(common)
        late = np.eye(of.delay_samples.size) / self.delay_width
        errors = self.errors(common)
        regular = prior(self.source, self.rate, self.calibration.r_load.mean())
        weak, by_source = regular.with_slopes(of.source)
        terms = [weak, of.delay_samples / self.delay_width, errors]
        rows = jax.scipy.linalg.block_diag(by_source, late, np.eye(errors.size))
        return jnp.concatenate(terms), rows

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """Increase of the Σ r² of the calibrations over its value at their own minimum.

        r is in standard deviations of the noise of the calibrations. If loads and calibrations
        agree, the increase is about the number of common parameters.
        """
        start, increase = self.start(), []
        for of in (lambda c: self.terms(self.gains(c)), lambda c: self.weak(c)[0]):
            increase.append(of(common) ** 2 - of(start) ** 2)
        noise = jnp.tile(self.noise(self.terms(self.gains(start))), (1, 2))
        return jnp.sum(increase[0] / noise) + jnp.sum(increase[1])
