"""Steiglitz-McBride, in time as the paper has it and on harmonics, with verdicts.

Those in time have no covariance. Where they would be believed wrongly all are judged by the minimum
of the model that they stop short of: they are `biased` if it is far.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import SkinRC
from etid.estimators import harmonic_steiglitz_mcbride, steiglitz_mcbride
from etid.estimators.judgement import MAX_STEPS_REACHED, SUCCESSFUL, misses, remarks
from etid.estimators.maximum_likelihood.terms import (
    apart,
    delayed_gain,
    denoised,
    excess,
    residual,
    stands_out,
    variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import other_circuit
from etid.estimators.score_tests.unloaded import UnloadedShape
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import ContinuousDriver, DiscreteDriver, Driver
from etid.results.fits import Fit
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import Spectrum
from etid.signals.measurement import Measurement
from etid.signals.transfer import Rational, as_complex, frequency_variable, reciprocal, turns
from etid.solvers.levenberg_marquardt import NormalEquations, normal_equations
from etid.solvers.matrices import inverse, root

BIASED = 16.0  # squared standard errors between an estimate and the minimum of its own model
IMPULSE = 512  # samples of a discrete model's impulse response


def _score(
    m: Measurement,
    coefficients: Float[Array, " n"],
    predict: Callable[[Float[Array, " n"], Float[Array, " time"]], Float[Array, " time"]],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² of a discrete model, and its squared distance to the minimum in standard errors."""
    impulse = jnp.zeros(IMPULSE).at[0].set(1.0)

    def scaled(c, _):
        h = predict(c, impulse)
        s = m.sigma_out**2 + m.sigma_th**2 * jnp.sum(h**2)
        return (predict(c, m.v_th) - m.v_out) / jnp.sqrt(s)

    equations = normal_equations(scaled, coefficients)
    return 2 * equations.objective / m.v_th.size, _distance(equations)


def _distance(equations: NormalEquations) -> Float[Array, ""]:
    """Squared distance to the minimum in standard errors."""
    return equations.gradient @ inverse(equations.matrix) @ equations.gradient


def skin_by_steiglitz_mcbride(m: Measurement, driver: Driver, iterations: int) -> Fit:
    """The paper's estimate of SkinRC (eqs. 8-12); `iterations` 1 is equation error."""
    z_th = Rational(driver.b, driver.a)
    best = steiglitz_mcbride.skin_filter(m.v_th, m.v_out, z_th, iterations)
    circuit = steiglitz_mcbride.skin_elements(best.filter, m.sample_rate)
    free = best.filter.num.size

    def predict(c, v):
        load = Rational(c[:free], jnp.concatenate([jnp.ones(1), c[free:]]))
        return steiglitz_mcbride.terminal_voltage(z_th, load, v)[0]

    chi2, distance = _score(m, jnp.concatenate([best.filter.num, best.filter.den[1:]]), predict)
    values = circuit.values()
    unstable = ~jnp.isfinite(best.rrse)
    nothing = jnp.full((values.size, values.size), jnp.nan)
    return Fit(
        circuit=circuit,
        cov=nothing,
        shared_cov=nothing,
        rrse=best.rrse,
        chi2=jnp.where(unstable, jnp.inf, chi2),
        result=first_verdict(
            (unstable, RESULTS.unstable),
            (~jnp.all(values > 0), RESULTS.nonphysical),
            ((iterations > 1) & ~best.converged, MAX_STEPS_REACHED),
            (misses(chi2, best.rrse), RESULTS.misfit),
            (distance > BIASED, RESULTS.biased),
        ),
        steps=best.iteration,
        method="steiglitz_mcbride" if iterations > 1 else "equation_error",
    )


def skin_by_harmonic_steiglitz_mcbride(
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    driver: ContinuousDriver,
    known: UnloadedShape | None,
) -> Fit:
    """SkinRC by Steiglitz-McBride on the harmonics, judged by the likelihood with Z_th as it is.

    Args:
        spectrum: One recording.
        sample_rate: Its sampling rate [Hz].
        driver: Its driver.
        known: The unloaded voltage of its calibration, if it can be compared.
    """
    source, source_cov = driver.source, driver.later_cov()
    z_th = source.response(spectrum.frequency)
    best = harmonic_steiglitz_mcbride.fit_skin(spectrum, z_th, sample_rate)
    values, late = best.circuit.values(), best.delay_samples
    physical = jnp.isfinite(best.rrse)  # or else any likelihood will do
    elements = jnp.where(physical, values, SkinRC().values())

    def terms(q, spectrum):
        of, f = LoadUnknowns.of(q), spectrum.frequency
        load = best.circuit.with_log_values(of.log_elements).impedance()
        return residual(spectrum, delayed_gain(source, load, f, of.delay_samples, sample_rate))

    own = LoadUnknowns(jnp.log(elements), late)
    at = own.vector()
    equations = normal_equations(terms, at, spectrum)
    freedom = 2 * jnp.sum(spectrum.selected, dtype=values.dtype) - values.size
    chi2 = 2 * equations.objective / freedom
    noise = excess(terms(at, spectrum), spectrum.selected)[: spectrum.x.size]
    everywhere = eqx.tree_at(lambda s: s.selected, spectrum, jnp.ones_like(spectrum.selected))
    square = jnp.sum(terms(at, everywhere).reshape(2, -1) ** 2, 0) / 2
    private, shared = harmonic_steiglitz_mcbride.covariance(
        spectrum, noise, source, source_cov, sample_rate, best
    )
    errors = jnp.diagonal(private + shared)  # of the logarithms, squared
    fitted = best.circuit.with_log_values(own.log_elements)
    other = _is_another(spectrum, noise, own, sample_rate, fitted, driver)
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
            (~(_distance(equations) <= BIASED), RESULTS.biased),
            (~jnp.all((errors > 0) & (errors < 1)), RESULTS.insensitive),
            (changed, RESULTS.inconsistent),
            (other, RESULTS.misfit),
            (driver.result != SUCCESSFUL, RESULTS.driver_failed),
        ),
        steps=best.iteration,
        method="harmonic_steiglitz_mcbride",
        remarks=remarks(stands_out(square, spectrum)),
    )


def _is_another(
    spectrum: Spectrum,
    noise: Float[Array, " harmonic"],
    own: LoadUnknowns,
    sample_rate: Float[Array, ""],
    circuit: SkinRC,
    driver: ContinuousDriver,
) -> Bool[Array, ""]:
    """Whether the load is seen to be another circuit, whatever Z_th is within its covariance.

    Args:
        spectrum: The recording.
        noise: Variance of its noise in units of what it says.
        own: What was unknown.
        sample_rate: Its sampling rate [Hz].
        circuit: The circuit.
        driver: Its driver.
    """
    f, elements = spectrum.frequency, own.log_elements.size
    s = frequency_variable(f)
    vector, unflatten = ravel_pytree(driver.source)
    deviations = root(driver.cov).T

    def along(function, at, directions):
        return jax.vmap(lambda of: jax.jvp(function, (at,), (of,))[1])(directions)

    def load(log_values):
        return circuit.with_log_values(log_values).impedance()(s)

    def of_gain(_):
        """Derivatives of the gain by all parameters and changes."""
        z_th = unflatten(vector).response(f)
        z, changes = other_circuit.changes(circuit.impedance(), f)
        total = reciprocal(z + z_th)
        g = z * total * turns(-f[0] * own.delay_samples / sample_rate, f.size)
        by_load = g * z_th * total * reciprocal(z)
        by_source = along(lambda p: unflatten(p).response(f), vector, deviations)
        by_own = [
            by_load[None, :] * along(load, own.log_elements, jnp.eye(elements)),
            (-g * s * as_complex(1 / sample_rate))[None, :],
        ]
        slopes = [*by_own, (-g * total)[None, :] * by_source, by_load[None, :] * changes]
        return g, jnp.concatenate(slopes)

    g, slopes = apart(of_gain, own.vector())

    def of_residual(_):
        # At the X that both records tell: the noise of that of one is in the residual as well.
        [clean], [share] = denoised([spectrum], [g])
        weight = jnp.where(spectrum.selected, jnp.sqrt(2 / variance(spectrum, g)), 0.0)
        rows = slopes * (-clean.x * as_complex(weight))[None, :]
        return jnp.concatenate([rows.real, rows.imag], axis=1), share

    rows, share = apart(of_residual, own.vector())
    count = elements + 1 + vector.size
    prior = jnp.diag(jnp.pad(jnp.ones(vector.size), (elements + 1, 0)))
    linear = Linear(rows[:count], share, jnp.tile(noise, 2), prior)
    return other_circuit.scores(
        rows[count:],
        linear,
        residual(spectrum, g),
        jnp.zeros(count),
        prior,
        linear.bread(),
        slice(elements),
    ).seen()


def driver_by_steiglitz_mcbride(
    m: Measurement, r_load: Float[Array, " record"], order: int, iterations: int
) -> DiscreteDriver:
    """The paper's estimate of Z_th (eqs. 4-6); `iterations` 1 is equation error."""
    best = steiglitz_mcbride.driver_filter(m.v_th, m.v_out, r_load, order, iterations)
    free = best.filter.num.size

    def score(m, r):
        def predict(c, v):
            z_th = Rational(c[:free], jnp.concatenate([jnp.ones(1), c[free:]]))
            return steiglitz_mcbride.terminal_voltage(z_th, Rational(r[None], jnp.ones(1)), v)[0]

        return _score(m, jnp.concatenate([best.filter.num, best.filter.den[1:]]), predict)

    chi2, distance = jax.vmap(score)(m, r_load)
    chi2 = chi2.max()
    unstable = ~jnp.isfinite(best.rrse) | ~best.stable
    return DiscreteDriver(
        b=best.filter.num,
        a=best.filter.den,
        sample_rate=m.sample_rate[0],
        rrse=best.rrse,
        chi2=jnp.where(jnp.isfinite(best.rrse), chi2, jnp.inf),
        result=first_verdict(
            (unstable, RESULTS.unstable),
            ((iterations > 1) & ~best.converged, MAX_STEPS_REACHED),
            (misses(chi2, best.rrse), RESULTS.misfit),
            (distance.max() > BIASED, RESULTS.biased),
        ),
        steps=best.iteration,
        method="steiglitz_mcbride" if iterations > 1 else "equation_error",
    )
