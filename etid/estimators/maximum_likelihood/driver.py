"""Maximum likelihood on the harmonics of the pulse rate: the driver, from its calibrations.

`etid.estimators.maximum_likelihood.terms` gives the terms.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.circuits.elements import resistor
from etid.estimators.estimate import (
    DELAY_WIDTH,
    MAX_STEPS,
    SOLVER,
    Estimate,
    delay_std,
    prior,
)
from etid.estimators.maximum_likelihood.terms import (
    as_list,
    delayed_gain,
    denoised,
    excess,
    residuals,
    shows_hum,
    weights,
)
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.fits import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.solvers.levenberg_marquardt import LevenbergMarquardt

# Z_th and a delay form a curved valley; a load alone has no such valley.
CURVED = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=SOLVER.ftol, geodesic=True)


def fit_source(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    start: SourceImpedance,
) -> tuple[SourceImpedance, Estimate, Calibration]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        spectra: Harmonics of the records, stacked along a leading axis.
        r_load: Resistor of each record [Ω].
        sample_rate: Sampling rate [Hz].
        start: Initial Z_th; its structure is the order.

    Returns:
        Z_th; the estimate, with parameters in the order of the flattened `start`; and the data of
        the calibrations that a skin's fit needs.
    """
    calibration = Calibration(r_load, jnp.zeros(r_load.shape), delay_std(r_load))
    model = Calibrations(start, calibration, spectra, sample_rate)
    solution = optx.least_squares(
        model.terms, CURVED, model.start(), model.records, max_steps=MAX_STEPS, throw=False
    )
    q, found = solution.value, model.named(solution.value)
    kept = found.source.size
    cov = model.linear(q).covariance()[:kept, :kept]
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.size
    seen = list(zip(model.records, model.gains(q), strict=True))
    errors = jnp.stack([complex_rrse(g * s.x, s.y, s.selected) for s, g in seen])
    estimate = Estimate(
        parameters=found.source,
        delay_samples=found.delay_samples,
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=2 * solution.stats["normal_equations"].objective / freedom,
        rrse=errors.max(),
        result=solution.result,
        steps=solution.stats["num_steps"],
        hum=jnp.stack([shows_hum(s, g) for s, g in seen]).any(),
    )
    calibration = dataclasses.replace(calibration, delay_samples=found.delay_samples)
    return model.z_th(q), estimate, calibration


class Calibrations(eqx.Module):
    """The likelihood of the calibrations of a driver.

    In all methods `common` is the vector of the `DriverUnknowns`.

    Attributes:
        source: Z_th identified from the calibrations.
        calibration: Resistors and delays of the calibrations.
        spectra: Harmonics of the calibrations.
        rate: Sampling rate of the calibrations [Hz].
    """

    source: SourceImpedance
    calibration: Calibration
    spectra: Spectrum
    rate: Float[Array, ""]

    @classmethod
    def of(cls, driver: HarmonicDriver) -> "Calibrations":
        """The calibrations of an identified driver."""
        rate = jnp.asarray(driver.sample_rate)
        return cls(driver.source, driver.calibration, driver.spectra, rate)

    @property
    def records(self) -> list[Spectrum]:
        """The harmonics of each calibration."""
        return as_list(self.spectra)

    def start(self) -> Float[Array, " common"]:
        """The common parameters identified from the calibrations alone."""
        vector, _ = ravel_pytree(self.source)
        return DriverUnknowns(vector, self.calibration.delay_samples).vector()

    def named(self, common: Float[Array, " common"]) -> DriverUnknowns:
        """The common parameters by name."""
        return DriverUnknowns.of(common, self.calibration.r_load.size)

    def z_th(self, common: Float[Array, " common"]) -> SourceImpedance:
        """Z_th with these common parameters."""
        return ravel_pytree(self.source)[1](self.named(common).source)

    def gains(self, common: Float[Array, " common"]) -> list[Complex[Array, " harmonic"]]:
        """Gains with the known resistors."""
        source = self.z_th(common)

        def one(frequency, r_load, delay_samples):
            return delayed_gain(source, resistor(r_load), frequency, delay_samples, self.rate)

        late = self.named(common).delay_samples
        return list(jax.vmap(one)(self.spectra.frequency, self.calibration.r_load, late))

    def terms(
        self, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> Float[Array, " term"]:
        """Terms of the calibrations and of the weak priors."""
        regularise = prior(self.source, self.rate, self.calibration.r_load.mean())
        parts = residuals(records, self.gains(common))
        of = self.named(common)
        weak = [regularise(of.source), of.delay_samples / DELAY_WIDTH]
        return jnp.concatenate(parts + weak)

    def linear(self, common: Float[Array, " common"]) -> Linear:
        """The terms, linear around their minimum."""
        records, gains = self.records, self.gains(common)
        clean, shares = denoised(records, gains)
        jacobian = jax.jacfwd(lambda c: self.terms(c, clean))(common)
        parts = residuals(records, gains)
        noise = [excess(r, s.selected) for r, s in zip(parts, records, strict=True)]
        count = jacobian.shape[0]
        return Linear(jacobian.T, weights(shares, count), weights(noise, count))

    def by_gains(
        self, common: Float[Array, " common"], slopes: Sequence[Complex[Array, "row harmonic"]]
    ) -> Float[Array, "row term"]:
        """Derivatives of the denoised terms; `slopes` are those of the gain of each record."""
        gains = self.gains(common)
        clean, _ = denoised(self.records, gains)

        def row(number):
            at = [of[number] for of in slopes]
            part = jax.jvp(lambda g: jnp.concatenate(residuals(clean, g)), (gains,), (at,))[1]
            priors = self.terms(common, self.records).size - part.size
            return jnp.pad(part, (0, priors))

        return jax.vmap(row)(jnp.arange(slopes[0].shape[0]))

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """Increase of the Σ r² of the calibrations over its value at their own minimum.

        r is in standard deviations of the noise of the calibrations. If loads and calibrations
        agree, the increase is about the number of common parameters.
        """
        start = self.start()
        alone, now = (self.terms(c, self.records) for c in (start, common))
        return jnp.sum((now**2 - alone**2) / self.linear(start).noise)
