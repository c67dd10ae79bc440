"""Steiglitz-McBride on the harmonics, judged by the likelihood with a fixed Z_th."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.estimator import (
    BY_RESIDUALS,
    CHECKED,
    DETERMINED,
    HARMONICS,
    NEAR_MINIMUM,
    Description,
)
from etid.estimators.harmonic_steiglitz_mcbride import iteration
from etid.estimators.judgement import (
    BIASED,
    MAX_STEPS_REACHED,
    SUCCESSFUL,
    distance_to_minimum,
    misses,
    remarks,
)
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.estimator import AbstractByMaximumLikelihood
from etid.estimators.maximum_likelihood.profile import Profile, excess, stands_out
from etid.estimators.score_tests import other_circuit, other_on_harmonics
from etid.estimators.score_tests.unloaded import UnloadedShape
from etid.estimators.steiglitz_mcbride.iteration import check_iterations
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import ContinuousDriver
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import delayed
from etid.solvers.levenberg_marquardt import normal_equations


@dataclasses.dataclass(frozen=True)
class HarmonicSteiglitzMcBride(AbstractByMaximumLikelihood):
    """SkinRC by Steiglitz-McBride on the harmonics, without bias by noise.

    Attributes:
        iterations: Number of iterations, at least one.
    """

    name = "harmonic_steiglitz_mcbride"
    lane = Harmonics
    driver = ContinuousDriver
    any_circuit = False
    brief = True

    iterations: int = iteration.ITERATIONS

    def __post_init__(self) -> None:
        check_iterations(self.iterations)

    def fit_load(
        self,
        lane: Harmonics,
        driver: ContinuousDriver,
        known: UnloadedShape | None,
        circuit: AbstractCircuit,
    ) -> Fit:
        """Identify a skin."""
        del circuit
        spectrum, sample_rate = lane.spectrum, jnp.asarray(lane.sample_rate)
        source, source_cov = driver.source, driver.later_cov()
        z_th = source.response(spectrum.frequency)
        best = iteration.fit_skin(spectrum, z_th, sample_rate, self.iterations)
        values, late = best.circuit.values(), best.delay_samples
        physical = jnp.isfinite(best.rrse)  # if not, the elements do not matter
        elements = jnp.where(physical, values, SkinRC().values())

        def terms(q: Float[Array, " q"], spectrum: Spectrum) -> Float[Array, " part"]:
            of, f = LoadUnknowns.of(q), spectrum.frequency
            load = best.circuit.with_log_values(of.log_elements).impedance()
            gain = delayed(source.voltage_ratio(load, f), f, of.delay_samples, sample_rate)
            return Profile.of_output(spectrum, gain).terms[0]

        own = LoadUnknowns(jnp.log(elements), late)
        at = own.vector()
        equations = normal_equations(terms, at, spectrum)
        freedom = 2 * jnp.sum(spectrum.selected, dtype=values.dtype) - values.size
        chi2 = 2 * equations.objective / freedom
        noise = excess(terms(at, spectrum), spectrum.selected)[: spectrum.x.size]
        everywhere = eqx.tree_at(lambda s: s.selected, spectrum, jnp.ones_like(spectrum.selected))
        square = jnp.sum(terms(at, everywhere).reshape(2, -1) ** 2, 0) / 2
        private, shared = iteration.covariance(
            spectrum, noise, source, source_cov, sample_rate, best
        )
        errors = jnp.diagonal(private + shared)  # squared errors of the logarithms
        fitted = best.circuit.with_log_values(own.log_elements)
        other = other_on_harmonics.scores(spectrum, own, sample_rate, fitted, driver).seen()
        changed = jnp.array(False) if known is None else known.differs(spectrum)
        return Fit(
            circuit=best.circuit,
            cov=(private + shared) * jnp.outer(values, values),
            shared_cov=shared * jnp.outer(values, values),
            rrse=best.rrse,
            chi2=jnp.where(physical, chi2, jnp.inf),
            result=first_verdict(
                (~best.stable, RESULTS.unstable),
                (~physical, RESULTS.nonphysical),
                (~best.converged, MAX_STEPS_REACHED),
                (misses(chi2, best.rrse) | (jnp.abs(late) > 1), RESULTS.misfit),
                (~(distance_to_minimum(equations) <= BIASED), RESULTS.biased),
                (~jnp.all((errors > 0) & (errors < 1)), RESULTS.insensitive),
                (changed, RESULTS.inconsistent),
                (other, RESULTS.misfit),
                (driver.result != SUCCESSFUL, RESULTS.driver_failed),
            ),
            steps=best.iteration,
            method=str(self),
            remarks=remarks(stands_out(square, spectrum.frequency, spectrum.selected)),
        )

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="Steiglitz-McBride on harmonics",
            text=HARMONICS + "the load was estimated by Steiglitz-McBride iteration (Steiglitz and "
            "McBride, 1965) with the variance of the noise taken out of its sums (Söderström, "
            "2007) and the trigger delay as one more linear unknown.",
            conditions=(*CHECKED, DETERMINED, NEAR_MINIMUM, other_circuit.NO_OTHER_CIRCUIT),
            errors=BY_RESIDUALS,
            cited=("soderstrom2007", "white1980"),
        )
