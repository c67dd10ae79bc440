"""The likelihood of the calibrations of a driver.

It is that of `etid.estimators.maximum_likelihood.profile`. Calibrations that share an unloaded
record are outputs of one input, so that all of them tell of the same X; the others have inputs of
their own. The objective is that of all harmonics; gradient, curvature, covariance and score tests
are condensed (`etid.estimators.maximum_likelihood.condensed`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.estimators.estimate import DELAY_WIDTH, Prior, prior
from etid.estimators.maximum_likelihood.condensed import Condensed, Near, Slopes, apart, means
from etid.estimators.maximum_likelihood.profile import Profile, Records, excess, total
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.signals.harmonics import Spectrum, same_unloaded
from etid.signals.knots import Knots, knots
from etid.signals.transfer import as_complex, delayed, frequency_variable, reciprocal

DENSE = 32  # density of the knots: the floor of the driver's valley is flat


class Calibrations(eqx.Module):
    """The likelihood of the calibrations of a driver.

    In all methods `common` is the vector of the `DriverUnknowns`.

    Attributes:
        source: Z_th identified from the calibrations.
        calibration: Resistors and delays of the calibrations.
        spectra: Harmonics of the calibrations.
        rate: Sampling rate of the calibrations [Hz].
        delay_width: Prior standard deviation of every trigger delay, of loads too [samples].
    """

    source: SourceImpedance
    calibration: Calibration
    spectra: Spectrum
    rate: Float[Array, ""]
    delay_width: Float[Array, ""] = eqx.field(default_factory=lambda: jax.device_put(DELAY_WIDTH))

    @classmethod
    def of(cls, driver: HarmonicDriver) -> "Calibrations":
        """The calibrations of an identified driver."""
        rate = jnp.asarray(driver.sample_rate)
        return cls(driver.source, driver.calibration, driver.spectra, rate)

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
        return DriverUnknowns(vector, self.calibration.delay_samples).vector()

    def named(self, common: Float[Array, " common"]) -> DriverUnknowns:
        """The common parameters by name."""
        return DriverUnknowns.of(common, self.calibration.r_load.size)

    def source_of(self, common: Float[Array, " common"]) -> SourceImpedance:
        """Z_th with these common parameters."""
        return ravel_pytree(self.source)[1](self.named(common).source)

    def gains(
        self, common: Float[Array, " common"], every: Knots | None = None
    ) -> Complex[Array, "record frequency"]:
        """Gains R e^(−jωτ) / (R + Z_th) with the known resistors, at all harmonics or at knots."""
        return self._gains(common, every)[1]

    def _gains(
        self, common: Float[Array, " common"], every: Knots | None
    ) -> tuple[Complex[Array, "record frequency"], ...]:
        """Z_th, the gains, and their derivatives with respect to Z_th."""
        f = self.spectra.frequency if every is None else every.at(self.spectra.frequency)
        z_th = jax.vmap(self.source_of(common).response)(f)
        resistance = as_complex(self.calibration.r_load)[:, None]
        loop, late = reciprocal(resistance + z_th), self.named(common).delay_samples
        gains = jax.vmap(delayed, (0, 0, 0, None))(resistance * loop, f, late, self.rate)
        return z_th, gains, -gains * loop

    def slopes(self, common: Float[Array, " common"], every: Knots | None = None) -> Slopes:
        """The gains and their derivatives, at all harmonics or at knots."""
        f = self.spectra.frequency if every is None else every.at(self.spectra.frequency)
        z_th, gains, by_z = self._gains(common, every)
        by_source = jnp.moveaxis(jax.vmap(self.source_of(common).slopes)(f), 0, 1)
        by_delay = -gains * frequency_variable(f / self.rate)
        alone = as_complex(jnp.eye(f.shape[0]))[:, :, None]
        rows = [by_source * by_z[None], alone * by_delay[None]]
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
        late = jnp.eye(of.delay_samples.size) / self.delay_width
        terms = [self._prior()(of.source), of.delay_samples / self.delay_width]
        rows = jax.scipy.linalg.block_diag(self._prior().slopes(of.source), late)
        return jnp.concatenate(terms), rows

    def _prior(self) -> Prior:
        return prior(self.source, self.rate, self.calibration.r_load.mean())

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
