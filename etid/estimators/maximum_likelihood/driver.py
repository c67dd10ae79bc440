"""Maximum likelihood on the harmonics of the pulse rate: the driver, and a skin.

The terms are those of `etid.estimators.maximum_likelihood.terms`. A skin is identified *jointly*
with the calibrations of its driver: what a skin's record says about Z_th, and about the delay of a
calibration that one known resistor leaves open, is used. `etid.estimators.joint.fit` does the same
for many skins at once.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.circuit import AbstractCircuit
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
    informed,
    residual,
    residuals,
    shows_hum,
    weights,
)
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.fits import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, best_start
from etid.solvers.matrices import inverse

# Z_th and a delay bend each other's valley; a load alone has none.
CURVED = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=SOLVER.ftol, geodesic=True)


def _gains(
    spectra: Spectrum,
    source: SourceImpedance,
    r_load: Float[Array, " record"],
    delay: Float[Array, " record"],
    sample_rate: Float[Array, ""],
) -> list[Complex[Array, " harmonic"]]:
    """Delayed gains of all calibrations, for delays in samples."""
    gains = jax.vmap(lambda f, r, d: delayed_gain(source, resistor(r), f, d))(
        spectra.frequency, r_load, delay / sample_rate
    )
    return list(gains)


def fit_source(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    start: SourceImpedance,
) -> tuple[SourceImpedance, Estimate, Calibration]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        spectra: Stacked along a leading axis.
        r_load: The resistors [Ω].
        sample_rate: Sampling rate [Hz].
        start: Initial Z_th; its structure is the order.

    Returns:
        Z_th, the estimate, whose parameters are `start` flattened, and what its skins need.
    """
    start_vector, unflatten = ravel_pytree(start)
    kept, count = start_vector.shape[0], r_load.shape[0]
    regularise = prior(start, sample_rate, r_load.mean())

    def gains(q):
        return _gains(spectra, unflatten(q[:kept]), r_load, q[kept:], sample_rate)

    def of_all(q, records):
        weak = [regularise(q[:kept]), q[kept:] / DELAY_WIDTH]
        return jnp.concatenate(residuals(records, gains(q)) + weak)

    records = as_list(spectra)
    q0 = jnp.concatenate([start_vector, jnp.zeros(count)])
    solution = optx.least_squares(
        of_all, CURVED, q0, args=records, max_steps=MAX_STEPS, throw=False
    )
    q = solution.value
    clean, shares = denoised(records, gains(q))
    jacobian = jax.jacfwd(of_all)(q, clean)
    weight = weights(shares, jacobian.shape[0])
    by_term = inverse((jacobian.T * weight[None, :]) @ jacobian) @ jacobian.T
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.shape[0]
    chi2 = 2 * solution.stats["normal_equations"].objective / freedom
    parts = residuals(records, gains(q))
    of_noise = [excess(r, s.selected) for r, s in zip(parts, records, strict=True)]
    noise = weights(of_noise, by_term.shape[1])
    cov = ((by_term * noise[None, :]) @ by_term.T)[:kept, :kept]
    found = list(zip(records, gains(q), strict=True))
    errors = jnp.stack([complex_rrse(g * s.x, s.y, s.selected) for s, g in found])
    estimate = Estimate(
        parameters=q[:kept],
        delay_samples=q[kept:],
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=chi2,
        rrse=errors.max(),
        result=solution.result,
        steps=solution.stats["num_steps"],
        hum=jnp.stack([shows_hum(s, g) for s, g in found]).any(),
    )
    calibration = Calibration(r_load, q[kept:], delay_std(r_load))
    return unflatten(q[:kept]), estimate, calibration


class Calibrations(eqx.Module):
    """The likelihood of the calibrations of a driver.

    Everywhere `common` are the parameters of Z_th and the delays of the calibrations in samples.

    Attributes:
        source: Z_th as identified from the calibrations.
        calibration: Their resistors and delays.
        spectra: Their harmonics.
        rate: Their sampling rate [Hz].
    """

    source: SourceImpedance
    calibration: Calibration
    spectra: Spectrum
    rate: Float[Array, ""]

    @classmethod
    def of(cls, driver: HarmonicDriver) -> "Calibrations":
        """Those of an identified driver."""
        rate = jnp.asarray(driver.sample_rate)
        return cls(driver.source, driver.calibration, driver.spectra, rate)

    @property
    def sources(self) -> int:
        """Number of parameters of Z_th."""
        return ravel_pytree(self.source)[0].shape[0]

    @property
    def records(self) -> list[Spectrum]:
        """The calibrations one by one."""
        return as_list(self.spectra)

    def start(self) -> Float[Array, " common"]:
        """The common parameters as the calibrations alone have them."""
        return jnp.concatenate([ravel_pytree(self.source)[0], self.calibration.delay_samples])

    def z_th(self, common: Float[Array, " common"]) -> SourceImpedance:
        """Z_th of the common parameters."""
        return ravel_pytree(self.source)[1](common[: self.sources])

    def gains(self, common: Float[Array, " common"]) -> list[Complex[Array, " harmonic"]]:
        """Gains with the known resistors."""
        delay = common[self.sources :]
        return _gains(self.spectra, self.z_th(common), self.calibration.r_load, delay, self.rate)

    def terms(
        self, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> Float[Array, " term"]:
        """Terms of the calibrations and of the weak prior."""
        regularise = prior(self.source, self.rate, self.calibration.r_load.mean())
        parts = residuals(records, self.gains(common))
        weak = [regularise(common[: self.sources]), common[self.sources :] / DELAY_WIDTH]
        return jnp.concatenate(parts + weak)

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """By how much Σ r² of the calibrations has grown from what they alone have.

        About as much as there are common parameters, if loads and calibrations agree on them; r in
        standard deviations that the noise of the calibrations has.
        """
        records, start = self.records, self.start()
        parts = residuals(records, self.gains(start))
        alone, now = (self.terms(c, records) for c in (start, common))
        noise = [excess(r, s.selected) for r, s in zip(parts, records, strict=True)]
        return jnp.sum((now**2 - alone**2) / weights(noise, now.size))


class Joint(eqx.Module):
    """The likelihood of loads and of the calibrations of their driver, term by term.

    `own` are the logarithms of a load's elements and its delay in samples.

    Attributes:
        circuit: Structure of the loads.
        calibrations: Those of their driver.
        shared: Whether a load's unloaded record may be that of a calibration.
    """

    circuit: AbstractCircuit
    calibrations: Calibrations
    shared: bool = eqx.field(static=True)

    def gain(
        self,
        own: Float[Array, " own"],
        common: Float[Array, " common"],
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
    ) -> Complex[Array, " harmonic"]:
        """Gain with a load."""
        load = self.circuit.with_log_values(own[:-1]).impedance()
        return delayed_gain(
            self.calibrations.z_th(common), load, spectrum.frequency, own[-1] / sample_rate
        )

    def of_load(
        self,
        own: Float[Array, " own"],
        common: Float[Array, " common"],
        spectrum: Spectrum,
        sample_rate: Float[Array, ""],
        records: Sequence[Spectrum],
    ) -> Float[Array, " term"]:
        """Terms of one recording, given the calibrations; the last is the prior of its delay."""
        known = self.informed(spectrum, common, records)
        part = residual(known, self.gain(own, common, spectrum, sample_rate))
        return jnp.append(part, own[-1] / DELAY_WIDTH)

    def informed(
        self, spectrum: Spectrum, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> Spectrum:
        """A recording with what the calibrations tell of its X."""
        return (
            informed(spectrum, records, self.calibrations.gains(common))
            if self.shared
            else spectrum
        )


def fit_load(
    model: Joint,
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    candidates: Float[Array, "start own"],
) -> tuple[Float[Array, " own"], optx.RESULTS, Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Identify the load of one recording with Z_th as the calibrations have it.

    Args:
        model: Calibrations and kind of circuit.
        spectrum: The recording.
        sample_rate: Its sampling rate [Hz].
        candidates: Logarithms of elements, and delays in samples, to start from; the start that
            predicts best is refined.

    Returns:
        Elements and delay, how the solver ended, χ² per degree of freedom, RRSE, and whether mains
        hum is seen.
    """
    records, common = model.calibrations.records, model.calibrations.start()

    def terms(own, spectrum):
        return model.of_load(own, common, spectrum, sample_rate, records)

    best = best_start(lambda own: terms(own, spectrum), candidates)
    solution = optx.least_squares(
        terms, SOLVER, best, args=spectrum, max_steps=MAX_STEPS, throw=False
    )
    own = solution.value
    squares = 2 * solution.stats["normal_equations"].objective
    chi2 = squares / (2 * jnp.sum(spectrum.selected, dtype=own.dtype) - own.shape[0])
    g = model.gain(own, common, spectrum, sample_rate)
    error = complex_rrse(g * spectrum.x, spectrum.y, spectrum.selected)
    hum = shows_hum(model.informed(spectrum, common, records), g)
    return own, solution.result, chi2, error, hum
