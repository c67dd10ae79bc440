"""Maximum likelihood on the harmonics of the pulse rate: the driver, from its calibrations.

`etid.estimators.maximum_likelihood.terms` gives the terms.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.elements import resistor
from etid.estimators.estimate import (
    DELAY_WIDTH,
    MAX_STEPS,
    SOLVER,
    Estimate,
    Prior,
    delay_std,
    prior,
)
from etid.estimators.maximum_likelihood.terms import (
    apart,
    as_list,
    by_gains,
    chained,
    delayed_gain,
    denoised,
    excess,
    residuals,
    shows_hum,
    variance,
    weights,
)
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import as_complex, frequency_variable, reciprocal
from etid.solvers.least_squares import least_squares
from etid.solvers.levenberg_marquardt import (
    DIFFERENCE,
    LevenbergMarquardt,
    NormalEquations,
)
from etid.solvers.matrices import inverse


def equations(_: Any, q: Float[Array, " common"], model: "Calibrations") -> NormalEquations:
    """Normal equations of the calibrations."""
    terms, jacobian = model.terms_and_slopes(q, model.records)
    return NormalEquations(
        0.5 * jnp.dot(terms, terms), jacobian @ terms, jacobian @ jacobian.T
    ).finite()


def second_order(
    _: Any, q: Float[Array, " common"], step: Float[Array, " common"], model: "Calibrations"
) -> Float[Array, " common"]:
    """Jᵀ r″ of the calibrations; r″ as in `levenberg_marquardt.second_order`."""
    ends = [model.terms(q + h * step, model.records) for h in (DIFFERENCE, -DIFFERENCE)]
    terms, jacobian = model.terms_and_slopes(q, model.records)
    return jacobian @ (ends[0] + ends[1] - 2 * terms) / DIFFERENCE**2


# A first fit with bands, whose steps take a fifth of the time, and a fit with all harmonics from
# its minimum. Z_th and a delay form a curved valley. Near its floor, steps with the usual damping
# are so short that they seem to make no progress.
ROUGHLY = LevenbergMarquardt(rtol=1e-3, ftol=1e-6, equations=equations)
WELL = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=3e-7, damping=1e-6, equations=equations)


def refined(
    model: "Calibrations", start: Float[Array, " common"], solver: LevenbergMarquardt
) -> optx.Solution:
    """The minimum of the likelihood."""
    return least_squares(
        lambda q, model: model.terms(q, model.records), solver, start, model, MAX_STEPS
    )


class Rough(NamedTuple):
    """The minimum with bands of harmonics (`etid.signals.bands`), near that with all harmonics.

    Attributes:
        source: Z_th.
        delay_samples: Trigger delay of each record [samples].
        cov: Covariance of the parameters of `source`.
        cost: −2 ln likelihood per degree of freedom, but for a constant.
        steps: Trial steps of the solver.
    """

    source: SourceImpedance
    delay_samples: Float[Array, " record"]
    cov: Float[Array, "parameter parameter"]
    cost: Float[Array, ""]
    steps: Int[Array, ""]


def rough_source(
    spectra: Spectrum,
    bands: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    start: SourceImpedance,
) -> Rough:
    """Identify Z_th from bands of harmonics.

    Args:
        spectra: Harmonics of the records, stacked along a leading axis.
        bands: Their bands.
        r_load: Resistor of each record [Ω].
        sample_rate: Sampling rate [Hz].
        start: Initial Z_th; its structure is the order.
    """
    calibration = Calibration(r_load, jnp.zeros(r_load.shape), delay_std(r_load))
    model = Calibrations(start, calibration, bands, sample_rate)
    solution = refined(model, model.start(), ROUGHLY)
    q, equations = solution.value, solution.stats["normal_equations"]
    kept = model.named(q).source.size
    # A spurious resonance fits noise, so that it lowers Σ r²; but it raises the variances.
    every = dataclasses.replace(model, spectra=spectra)
    logs = [
        jnp.sum(jnp.where(one.selected, jnp.log(variance(one, g)), 0.0))
        for one, g in zip(every.records, every.gains(q), strict=True)
    ]
    terms = jnp.sum(spectra.selected, dtype=q.dtype)
    return Rough(
        source=model.z_th(q),
        delay_samples=model.named(q).delay_samples,
        cov=inverse(equations.matrix)[:kept, :kept],
        cost=(equations.objective + sum(logs, jnp.zeros(()))) / terms,
        steps=solution.stats["num_steps"],
    )


class _Tried(eqx.Module):
    """How many fits with all harmonics were tried, and the result of the first that converged.

    If none has converged, the result is that of the best start.
    """

    count: Int[Array, ""]
    common: Float[Array, " common"]
    squares: Float[Array, ""]
    steps: Int[Array, ""]
    settled: Bool[Array, ""]


def fit_source(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    near: Rough,
) -> tuple[SourceImpedance, Estimate, Calibration, Linear]:
    """Identify Z_th from one or several records with known resistors.

    Args:
        spectra: Harmonics of the records, stacked along a leading axis.
        r_load: Resistor of each record [Ω].
        sample_rate: Sampling rate [Hz].
        near: Starts, stacked, the best first. The others are tried only if it does not converge.

    Returns:
        Z_th; the estimate, with parameters in the order of the flattened source; the data of the
        calibrations that a skin's fit needs; and the terms, linear around their minimum.
    """
    best = jax.tree.map(lambda leaf: leaf[0], near)
    calibration = Calibration(r_load, best.delay_samples, delay_std(r_load))
    model = Calibrations(best.source, calibration, spectra, sample_rate)

    def fit(tried: _Tried) -> _Tried:
        start = jax.tree.map(lambda leaf: leaf[tried.count], near)
        q = DriverUnknowns(ravel_pytree(start.source)[0], start.delay_samples).vector()
        solution = refined(model, q, WELL)
        new = _Tried(
            count=tried.count + 1,
            common=solution.value,
            squares=2 * solution.stats["normal_equations"].objective,
            steps=start.steps + solution.stats["num_steps"],
            settled=solution.result == optx.RESULTS.successful,
        )
        kept = new.settled | (tried.count == 0)
        old = dataclasses.replace(tried, count=new.count)
        return jax.tree.map(lambda one, other: jnp.where(kept, one, other), new, old)

    nothing = jnp.zeros(())
    tried = _Tried(
        jnp.array(0), model.start(), nothing, jnp.zeros_like(best.steps), jnp.array(False)
    )
    tried = jax.lax.while_loop(
        lambda tried: ~tried.settled & (tried.count < near.cost.size), fit, tried
    )
    q, found = tried.common, model.named(tried.common)
    kept = found.source.size
    linear = model.linear(q)
    cov = linear.covariance()[:kept, :kept]
    freedom = 2 * jnp.sum(spectra.selected, dtype=q.dtype) - q.size
    seen = list(zip(model.records, model.gains(q), strict=True))
    errors = jnp.stack([complex_rrse(g * s.x, s.y, s.selected) for s, g in seen])
    estimate = Estimate(
        parameters=found.source,
        delay_samples=found.delay_samples,
        cov=cov,
        shared_cov=jnp.zeros_like(cov),
        chi2=tried.squares / freedom,
        rrse=errors.max(),
        result=optx.RESULTS.where(
            tried.settled, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
        ),
        steps=tried.steps,
        hum=jnp.stack([shows_hum(s, g) for s, g in seen]).any(),
    )
    calibration = dataclasses.replace(calibration, delay_samples=found.delay_samples)
    return model.z_th(q), estimate, calibration, linear


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

        def one(
            frequency: Float[Array, " harmonic"],
            r_load: Float[Array, ""],
            delay_samples: Float[Array, ""],
        ) -> Complex[Array, " harmonic"]:
            return delayed_gain(source, resistor(r_load), frequency, delay_samples, self.rate)

        late = self.named(common).delay_samples
        return list(jax.vmap(one)(self.spectra.frequency, self.calibration.r_load, late))

    def terms(
        self, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> Float[Array, " term"]:
        """Terms of the calibrations and of the weak priors."""
        parts = residuals(records, self.gains(common))
        of = self.named(common)
        weak = [self._prior()(of.source), of.delay_samples / self.delay_width]
        return jnp.concatenate(parts + weak)

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

    def linear(self, common: Float[Array, " common"]) -> Linear:
        """The terms, linear around their minimum."""
        records, gains = self.records, self.gains(common)
        clean, shares = denoised(records, gains)
        _, jacobian = self.terms_and_slopes(common, clean)
        parts = residuals(records, gains)
        noise = [excess(r, s.selected) for r, s in zip(parts, records, strict=True)]
        count = jacobian.shape[1]
        return Linear(jacobian, weights(shares, count), weights(noise, count))

    def by_z(
        self, common: Float[Array, " common"], gains: Sequence[Complex[Array, " harmonic"]]
    ) -> list[Complex[Array, " harmonic"]]:
        """∂G/∂Z_th = −G/(R + Z_th)."""
        source = self.z_th(common)
        each = zip(gains, self.calibration.r_load, self.spectra.frequency, strict=True)
        return [-g * reciprocal(as_complex(r) + source.response(f)) for g, r, f in each]

    def gain_slopes(
        self,
        common: Float[Array, " common"],
        gains: Sequence[Complex[Array, " harmonic"]],
        by_z: Sequence[Complex[Array, " harmonic"]],
    ) -> list[Complex[Array, "common harmonic"]]:
        """Derivatives of the gains."""
        source, alone = self.z_th(common), jnp.eye(len(gains))
        found = []
        for number, (g, of_z) in enumerate(zip(gains, by_z, strict=True)):
            frequency = self.spectra.frequency[number]
            of_delay = -g * frequency_variable(frequency / self.rate)
            by_source = source.slopes(frequency) * of_z[None, :]
            by_delay = as_complex(alone[number])[:, None] * of_delay[None, :]
            found.append(jnp.concatenate([by_source, by_delay]))
        return found

    def terms_and_slopes(
        self, common: Float[Array, " common"], records: Sequence[Spectrum]
    ) -> tuple[Float[Array, " term"], Float[Array, "common term"]]:
        """The terms and their derivatives."""

        def of_gains(_: Float[Array, " common"]) -> tuple[Array, Array, list[Array]]:
            parts = jnp.concatenate(residuals(records, gains))
            return parts, by_gains(records, gains), self.by_z(common, gains)

        gains = apart(self.gains, common)
        terms, by_gain, by_z = apart(of_gains, common)
        by_common = apart(lambda c: self.gain_slopes(c, gains, by_z), common)
        rows = chained(by_common, by_gain)
        weak, by_common = self.weak(common)
        return jnp.concatenate([terms, weak]), jnp.concatenate([rows, by_common], axis=1)

    def by_gains(
        self, common: Float[Array, " common"], slopes: Sequence[Complex[Array, "row harmonic"]]
    ) -> Float[Array, "row term"]:
        """Derivatives of the denoised terms; `slopes` are those of the gain of each record."""
        gains = self.gains(common)
        clean, _ = denoised(self.records, gains)
        rows = chained(slopes, by_gains(clean, gains))
        priors = self.terms(common, self.records).size - rows.shape[1]
        return jnp.pad(rows, ((0, 0), (0, priors)))

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """Increase of the Σ r² of the calibrations over its value at their own minimum.

        r is in standard deviations of the noise of the calibrations. If loads and calibrations
        agree, the increase is about the number of common parameters.
        """
        start = self.start()
        alone, now = (self.terms(c, self.records) for c in (start, common))
        return jnp.sum((now**2 - alone**2) / self.linear(start).noise)
