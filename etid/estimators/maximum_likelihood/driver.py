"""Maximum likelihood on the harmonics of the pulse rate: the driver, from its calibrations.

The likelihood is that of `etid.estimators.maximum_likelihood.profile`. Calibrations that share an
unloaded record are outputs of one input, so that all of them tell of the same X; the others have
inputs of their own. As in a fit of a load, the objective and its gradient are those of all
harmonics, and curvature, covariance and score tests are condensed.
"""

import dataclasses
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
from etid.estimators.maximum_likelihood.condensed import Condensed, apart, means
from etid.estimators.maximum_likelihood.profile import Profile, Records, excess
from etid.estimators.sandwich import Linear
from etid.estimators.unknowns import DriverUnknowns
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.signals.harmonics import Spectrum, as_list, same_unloaded, signal_share
from etid.signals.knots import Knots, knots
from etid.signals.transfer import as_complex, delayed, frequency_variable, reciprocal
from etid.solvers.levenberg_marquardt import (
    DIFFERENCE,
    LevenbergMarquardt,
    NormalEquations,
)
from etid.solvers.matrices import inverse


def equations(_: Any, q: Float[Array, " common"], model: "Calibrations") -> NormalEquations:
    """Normal equations of the calibrations."""
    return model.equations(q)


def _rough_equations(_: Any, q: Float[Array, " common"], model: "Calibrations") -> NormalEquations:
    """The same with the derivatives of the terms themselves, which contain their noise."""
    terms, jacobian = model.terms_and_slopes(q)
    return NormalEquations(
        0.5 * jnp.dot(terms, terms), jacobian @ terms, jacobian @ jacobian.T
    ).finite()


def second_order(
    _: Any, q: Float[Array, " common"], step: Float[Array, " common"], model: "Calibrations"
) -> Float[Array, " common"]:
    """Jᵀ r″ of the calibrations; r″ as in `levenberg_marquardt.second_order`."""
    condensed, small = model.likelihood(q).condensed, model.at_knots()
    ends = [small.gains(q + h * step) for h in (DIFFERENCE, -DIFFERENCE)]
    [bent] = condensed.rows((ends[0] + ends[1] - 2 * condensed.gains)[None])
    priors = [model.weak(q + h * step)[0] for h in (DIFFERENCE, -DIFFERENCE)]
    weak, by_common = model.weak(q)
    found = condensed.rows(small.gain_slopes(q)) @ bent
    return (found + by_common @ (priors[0] + priors[1] - 2 * weak)) / DIFFERENCE**2


DENSE = 32  # density of the knots: the floor of the driver's valley is flat
# A first fit with bands, whose steps take a fifth of the time, and a fit with all harmonics from
# its minimum. From a distant start, the derivatives of the terms themselves find deeper minima than
# those with X̂. Z_th and a delay form a curved valley. Near its floor, steps with the usual damping
# are so short that they seem to make no progress.
ROUGHLY = LevenbergMarquardt(rtol=1e-3, ftol=1e-6, equations=_rough_equations)
WELL = LevenbergMarquardt(rtol=SOLVER.rtol, ftol=3e-7, damping=1e-6, equations=equations)


def refined(
    model: "Calibrations", start: Float[Array, " common"], solver: LevenbergMarquardt
) -> optx.Solution:
    """The minimum of the likelihood."""
    return optx.least_squares(
        lambda q, model: model.residual(q),
        solver,
        start,
        model,
        max_steps=MAX_STEPS,
        throw=False,
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
        jnp.sum(jnp.where(one.selected, jnp.log(Profile.of_output(one, g).expected[0]), 0.0))
        for one, g in zip(as_list(spectra), every.gains(q), strict=True)
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
    seen = [
        (Records.of(s), Profile.of_output(s, g))
        for s, g in zip(as_list(spectra), model.gains(q), strict=True)
    ]
    errors = jnp.stack([profile.rrse(records, records.x) for records, profile in seen])
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
        hum=jnp.stack([profile.shows_hum(records) for records, profile in seen]).any(),
    )
    calibration = dataclasses.replace(calibration, delay_samples=found.delay_samples)
    return model.z_th(q), estimate, calibration, linear


class Likelihood(eqx.Module):
    """The likelihood of calibrations at some gains.

    Attributes:
        objective: ½ D.
        terms: Innovations, scaled to unit variance; Σ of their squares is D.
        score: ρ of each gain.
        condensed: The likelihood near the gains.
        size: Information of each innovation about its gain.
        share: Share of signal in the power of X̂, for each calibration.
    """

    objective: Float[Array, ""]
    terms: Float[Array, "record part"]
    score: Complex[Array, "record harmonic"]
    condensed: Condensed
    size: Float[Array, "record harmonic"]
    share: Float[Array, "record harmonic"]


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

    def at_knots(self) -> "Calibrations":
        """The same with the harmonics at the knots alone, for gains and their derivatives."""
        spectra = jax.tree.map(lambda leaf: leaf[..., self.knots.index], self.spectra)
        return dataclasses.replace(self, spectra=spectra)

    @property
    def records(self) -> Records:
        """The unloaded records as inputs, stacked, each with the outputs of all calibrations.

        An output is used with the first input that is its own unloaded record.
        """
        s, each = self.spectra, as_list(self.spectra)
        same = jnp.stack(
            [jnp.stack([jnp.asarray(same_unloaded(a, b)) for b in each]) for a in each]
        )
        used = jnp.argmax(same, axis=0)[None, :] == jnp.arange(len(each))[:, None]
        y, variance_y = (jnp.tile(of, (len(each), 1, 1)) for of in (s.y, s.variance_y))
        selected = used[:, :, None] & s.selected[None]
        return Records(s.frequency, s.x, s.variance_x, y, variance_y, selected)

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

    def gains(self, common: Float[Array, " common"]) -> Complex[Array, "record harmonic"]:
        """Gains with the known resistors."""
        source = self.z_th(common)

        def one(
            frequency: Float[Array, " harmonic"],
            r_load: Float[Array, ""],
            delay_samples: Float[Array, ""],
        ) -> Complex[Array, " harmonic"]:
            ratio = source.voltage_ratio(resistor(r_load), frequency)
            return delayed(ratio, frequency, delay_samples, self.rate)

        late = self.named(common).delay_samples
        return jax.vmap(one)(self.spectra.frequency, self.calibration.r_load, late)

    def likelihood(
        self,
        common: Float[Array, " common"],
        change: Complex[Array, "record harmonic"] | None = None,
    ) -> Likelihood:
        """The likelihood of all calibrations, with a change of their gains if there is one."""
        records = self.records

        def of_gains(common: Float[Array, " common"]) -> tuple[Array, ...]:
            gains = self.gains(common) if change is None else self.gains(common) + change

            def one(of: Profile) -> tuple[Array, ...]:
                share = signal_share(of.x, of.variance_x)
                share = jnp.where(of.weight > 0, share[None, :], 0.0)
                return of.objective, of.terms, of.score, of.information, of.size, share

            sums = jax.vmap(lambda of: one(Profile.of(of, gains)))(records)
            return *(of.sum(0) for of in sums), gains

        objective, terms, score, information, size, share, gains = apart(of_gains, common)
        condensed = apart(lambda _: Condensed.of(gains, information, score, self.knots), common)
        return Likelihood(objective, terms, score, condensed, size, share)

    def equations(self, common: Float[Array, " common"]) -> NormalEquations:
        """Normal equations of the calibrations and of the weak priors."""
        found = self.likelihood(common)
        towards = -jnp.conj(found.score)
        (gradient,) = apart(lambda c: jax.vjp(self.gains, c)[1](towards), common)
        rows = found.condensed.rows(apart(self.at_knots().gain_slopes, common))
        weak, by_common = self.weak(common)
        rows = jnp.concatenate([rows, by_common], axis=1)
        return NormalEquations(
            found.objective + 0.5 * jnp.dot(weak, weak),
            gradient + by_common @ weak,
            rows @ rows.T,
        ).finite()

    def residual(self, common: Float[Array, " common"]) -> Float[Array, " term"]:
        """Terms of the calibrations and of the weak priors."""
        return jnp.concatenate([self._of_records(self.gains(common)), self.weak(common)[0]])

    def _of_records(self, gains: Complex[Array, "record harmonic"]) -> Float[Array, " part"]:
        return jax.vmap(lambda of: Profile.of(of, gains).terms)(self.records).sum(0).ravel()

    def terms_and_slopes(
        self, common: Float[Array, " common"]
    ) -> tuple[Float[Array, " term"], Float[Array, "common term"]]:
        """`residual` and its derivatives."""

        def of_gains(common: Float[Array, " common"]) -> tuple[Array, Array]:
            gains, unit = self.gains(common), jnp.array([[1.0], [1.0j]])
            ways = as_complex(jnp.eye(gains.shape[0]))[:, None, :, None] * unit[None, :, None]

            def along(way: Complex[Array, "record 1"]) -> Float[Array, " part"]:
                return jax.jvp(self._of_records, (gains,), (jnp.broadcast_to(way, gains.shape),))[1]

            return self._of_records(gains), jax.vmap(jax.vmap(along))(ways)

        # A term depends on the gains at its own harmonic only.
        terms, by_gain = apart(of_gains, common)
        slopes, rows = apart(self.gain_slopes, common), jnp.zeros(())
        by_gain = by_gain.reshape(*by_gain.shape[:2], -1, slopes.shape[-1])
        for number, (real, imaginary) in enumerate(by_gain):
            of = slopes[:, number, None]
            rows = rows + of.real * real[None] + of.imag * imaginary[None]
        weak, by_common = self.weak(common)
        rows = rows.reshape(common.size, -1)
        return jnp.concatenate([terms, weak]), jnp.concatenate([rows, by_common], axis=1)

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

    def noise(self, found: Likelihood) -> Float[Array, "record harmonic"]:
        """`excess` of the terms of each calibration."""
        each = jax.vmap(excess)(found.terms, self.spectra.selected)
        return each[:, : self.spectra.x.shape[-1]]

    def linear(self, common: Float[Array, " common"]) -> Linear:
        """The condensed terms, linear around their minimum."""
        found = self.likelihood(common)
        jacobian = found.condensed.rows(self.at_knots().gain_slopes(common))
        values = jnp.stack([found.share, self.noise(found)])
        share, noise = means(found.size, self.knots, values)
        _, by_common = self.weak(common)
        ones = jnp.ones(by_common.shape[1])
        return Linear(
            jnp.concatenate([jacobian, by_common], axis=1),
            jnp.concatenate([share, ones]),
            jnp.concatenate([noise, ones]),
        )

    def terms(self, common: Float[Array, " common"]) -> Float[Array, " term"]:
        """The condensed terms and those of the weak priors, as `linear` has them."""
        return jnp.concatenate([self.likelihood(common).condensed.part, self.weak(common)[0]])

    def by_z(self, common: Float[Array, " common"]) -> Complex[Array, "record harmonic"]:
        """∂G/∂Z_th = −G/(R + Z_th)."""
        z_th = jax.vmap(self.z_th(common).response)(self.spectra.frequency)
        total = as_complex(self.calibration.r_load)[:, None] + z_th
        return -self.gains(common) * reciprocal(total)

    def gain_slopes(
        self, common: Float[Array, " common"]
    ) -> Complex[Array, "common record harmonic"]:
        """Derivatives of the gains."""
        frequency = self.spectra.frequency
        by_source = jnp.moveaxis(jax.vmap(self.z_th(common).slopes)(frequency), 0, 1)
        by_delay = -self.gains(common) * frequency_variable(frequency / self.rate)
        alone = as_complex(jnp.eye(frequency.shape[0]))[:, :, None]
        return jnp.concatenate([by_source * self.by_z(common)[None], alone * by_delay[None]])

    def strain(self, common: Float[Array, " common"]) -> Float[Array, ""]:
        """Increase of the Σ r² of the calibrations over its value at their own minimum.

        r is in standard deviations of the noise of the calibrations. If loads and calibrations
        agree, the increase is about the number of common parameters.
        """
        start = self.start()
        noise = jnp.tile(self.noise(self.likelihood(start)), (1, 2)).ravel()
        alone, now = (self.residual(c) for c in (start, common))
        ones = jnp.ones(now.size - noise.size)
        return jnp.sum((now**2 - alone**2) / jnp.concatenate([noise, ones]))
