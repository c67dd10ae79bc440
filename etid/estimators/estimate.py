"""Parts that all fits share: the solver, the weak priors, and the estimate that a fit returns."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.numpy_tier.tiers import program
from etid.precision import Module
from etid.results.driver import SourceImpedance
from etid.results.fit import Support
from etid.results.instrument import Effects, Instrument
from etid.solvers.levenberg_marquardt import LevenbergMarquardt

MAX_STEPS = 500
PASSIVE_BAND = np.geomspace(1e-4, 10.0, 128)  # of the sample rate
# [samples] Standard deviation of the weak prior of a delay. A delay above one sample is a misfit.
DELAY_WIDTH = 0.5
# [samples] Approximate standard deviation of the delay if the resistors differ.
KNOWN_DELAY = 1e-9
# Relative difference of resistors; with a smaller one, the delays of their records are unknown.
SAME_LOAD = 0.01
SOLVER = LevenbergMarquardt(rtol=1e-5, ftol=1e-6)  # 1e-3 standard errors at 10 000 samples


class Estimate(Module):
    """The result of a fit, without a verdict.

    Attributes:
        parameters: Estimated parameters.
        delay_samples: Trigger delay of each record [samples].
        cov: Covariance of `parameters`.
        chi2: Σ r²/s per degree of freedom.
        rrse: Root relative squared error of V_out; the largest of all records.
        result: Verdict of the solver.
        steps: Trial steps of the solver.
        start: Number of the start that led here, from 0 on; only fits of drivers tell it.
        shared_cov: Part of `cov` that comes from the driver; all skins identified with this driver
            share it.
        strain: Increase of the Σ r² of the calibrations in a joint fit; 0 for other fits.
        hum: Whether the residual shows mains hum; a fit in time does not test for it.
        falls: Whether a resistance that falls with its current explains most of the misfit.
        late: Whether a resistance that follows its current late explains the residual; only
            a fit of several amplitudes tests for it.
        doubtful: Whether another gain is likely; `cov` contains its effect.
        support: How well the data support this circuit; None if the estimator does not compute it.
        by_tolerance: What errors of the instrument do to the parameters; None in the same case.
    """

    _: dataclasses.KW_ONLY
    parameters: Float[Array, " parameter"]
    delay_samples: Float[Array, " record"]
    cov: Float[Array, "parameter parameter"]
    chi2: Float[Array, ""]
    rrse: Float[Array, ""]
    result: optx.RESULTS
    steps: Int[Array, ""]
    shared_cov: Float[Array, "parameter parameter"]
    start: Int[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), int))
    strain: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))
    hum: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    falls: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    late: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    doubtful: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    support: Support | None = None
    by_tolerance: Effects | None = None


class Prior(Module):
    """The weak prior that `prior` makes.

    Attributes:
        structure: A source with the same numbers of sections and poles.
        centre: Centres of the parameters.
        width: Standard deviations of the parameters.
        frequency: Frequencies at which Re Z_th should not be negative [Hz].
        unit: Standard deviation of a negative Re Z_th [Ω].
    """

    structure: SourceImpedance
    centre: Float[Array, " parameter"]
    width: Float[Array, " parameter"]
    frequency: Float[Array, " frequency"]
    unit: Float[Array, ""]

    def __call__(self, parameters: Float[Array, " parameter"]) -> Float[Array, " term"]:
        """The residuals."""
        return self._terms(parameters, self._source(parameters).response(self.frequency))

    def with_slopes(
        self, parameters: Float[Array, " parameter"]
    ) -> tuple[Float[Array, " term"], Float[Array, "parameter term"]]:
        """The residuals and their derivatives."""
        z_th, slopes = self._source(parameters).with_slopes(self.frequency)
        by_resistance = jnp.where(z_th.real[None, :] < 0, slopes.real, 0.0)
        rows = [np.eye(self.width.size) / self.width[None], by_resistance / self.unit]
        return self._terms(parameters, z_th), jnp.concatenate(rows, axis=1)

    def _terms(
        self, parameters: Float[Array, " parameter"], z_th: Complex[Array, " frequency"]
    ) -> Float[Array, " term"]:
        active = jnp.minimum(z_th.real, 0.0)
        return jnp.concatenate([(parameters - self.centre) / self.width, active / self.unit])

    def _source(self, parameters: Float[Array, " parameter"]) -> SourceImpedance:
        return ravel_pytree(self.structure)[1](parameters)


def prior(start: SourceImpedance, sample_rate: Float[Array, ""], r_load: Float[Array, ""]) -> Prior:
    """Weak prior of the modal parameters, as additional residuals.

    Without a prior, a pole that a noisy recording does not determine would diverge, for example to
    Q = ∞, and the solver with it. At 60 dB a recording has at least 1e4 times the information of
    this prior. Its centres, with one standard deviation as a factor, are:

    - First section, the resonance: half the Nyquist frequency (e^3), a damping ratio of 0.7
      (e^1.5).
    - Further sections, an overdamped tail above the band: 1.5 times the Nyquist frequency (e^1.5),
      a damping ratio of 1.5 (e^0.5). If the trigger delay is fitted too, noise produces a second
      sharp resonance beside the first; this prior prevents it.
    - Slow real pole: 1/500 of half the Nyquist frequency (e^3).
    - Impedances: 0, with a standard deviation of 10 times the known resistor.

    A transformer is passive, so Re Z_th ≥ 0 at all frequencies, inside the recorded band and above
    it. Otherwise the loaded driver would oscillate with some skins. Each frequency with Re Z_th < 0
    adds the residual Re Z_th / (10⁻³ R_L).
    """
    pairs, reals = start.log_omega.shape[0], start.log_omega_real.shape[0]
    first, slow = np.arange(pairs) == 0, np.arange(reals) == 0

    def flat(
        resistance: float = 0.0,
        omega: Any = 0.0,
        zeta: Any = 0.0,
        gain: float = 0.0,
        real: Any = 0.0,
    ) -> Float[np.ndarray, " parameter"]:
        """Numbers in field order; as constants of NumPy, no program computes them."""
        of_pairs = [np.broadcast_to(one, pairs) for one in (omega, zeta, gain, gain)]
        of_reals = [np.broadcast_to(one, reals) for one in (real, gain)]
        return np.concatenate([[resistance], *of_pairs, *of_reals])

    centre = jnp.log(0.01 * r_load) * flat(resistance=1.0)
    centre = centre + jnp.log(0.5 * jnp.pi * sample_rate) * flat(omega=1.0, real=1.0)
    centre = centre + flat(
        omega=np.where(first, 0.0, math.log(3.0)),
        zeta=np.log(np.where(first, 0.7, 1.5)),
        real=np.where(slow, -math.log(500.0), 0.0),
    )
    width = flat(3.0, np.where(first, 3.0, 1.5), np.where(first, 1.5, 0.5), real=3.0)
    width = r_load * flat(gain=10.0) + width
    frequency = jnp.asarray(PASSIVE_BAND) * sample_rate
    return Prior(start, centre, width, frequency, 1e-3 * r_load)


@program
def delay_width(instrument: Instrument | None, sample_rate: Float[Array, ""]) -> Float[Array, ""]:
    """Standard deviation of the prior of a delay behind this instrument [samples]."""
    if instrument is None or instrument.delay is None:
        return jnp.asarray(DELAY_WIDTH)
    return jnp.minimum(instrument.delay * sample_rate, DELAY_WIDTH)


def delay_std(r_load: Float[Array, " record"]) -> Float[Array, ""]:
    """Standard deviation of the delay of calibrations with these resistors [samples].

    Records with the same resistor do not determine their delay. Different resistors determine it.
    """
    same = jnp.ptp(r_load) < SAME_LOAD * r_load.mean()
    return jnp.where(same, DELAY_WIDTH, KNOWN_DELAY)
