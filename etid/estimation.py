"""One lane: samples in, judged estimate out. The same functions serve one recording and a batch.

Every estimate passes through a judge, so that none leaves without a verdict. Among several
applicable verdicts the most fundamental is reported: a loop that cannot be simulated, then elements
that are no circuit, then a solver that did not settle, then a model that misses the data, then
parameters that the data do not determine.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from etid import (
    harmonic_steiglitz_mcbride,
    maximum_likelihood,
    non_parametric,
    output_error,
    prediction,
    steiglitz_mcbride,
)
from etid.circuits import AbstractCircuit, SkinRC
from etid.driver import Driver, SourceImpedance
from etid.information import inverse
from etid.levenberg_marquardt import NormalEquations, normal_equations
from etid.likelihood import delayed_gain, residual
from etid.measurement import Measurement
from etid.results import Fit
from etid.spectra import Spectrum, spectrum
from etid.transfer import Rational, poles
from etid.verdicts import RESULTS, first_verdict, verdict

# Members inherited from lineax, of which the type checker thinks they are not ours.
SUCCESSFUL = verdict("successful")
MAX_STEPS_REACHED = verdict("max_steps_reached")
MISFIT_CHI2 = 1.5  # the noise is known from the record to about 5 %, chi2 therefore to 10 %
MISFIT_RRSE = (
    1e-3  # of the signal; what converters and transformers leave unexplained at their best
)
# Growth of the calibrations' sum of squares in a joint fit. It is chi-squared with as many degrees
# of freedom as Z_th and the delays have parameters at most: 12 exceed this once in ten thousand.
STRAINED = 39.0
BIASED = 16.0  # squared standard errors between an estimate and the minimum of its own model
CORRECTED = (
    2.0  # standard errors of bias that may be corrected; what it leaves is below half of one
)
PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.0003, 0.4, 400)  # of the sample rate, where a source must be passive
LEVELS = (1.0, 0.125, 0.5, 2.0, 8.0)  # impedance levels at which a circuit is started
START_STEPS = 8  # of Steiglitz-McBride on harmonics, which settles in three to eight
IMPULSE = 512  # samples of a discrete model's impulse response
UNWANTED = 1e3  # added to the cost of a start that did not settle; any cost is smaller


def misses(chi2: Float[Array, ""], error: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the residual exceeds the noise both in standard deviations and in volts."""
    excess = error * jnp.sqrt(jnp.maximum(1 - 1 / chi2, 0.0))
    return (chi2 > MISFIT_CHI2) & (excess > MISFIT_RRSE)


def _too_late(estimate: output_error.Estimate) -> Bool[Array, ""]:
    """Whether a trigger delay lies outside the one sample for which it is modelled."""
    return jnp.any(jnp.abs(estimate.nuisance[:, -1]) > 1)


# --- Steiglitz-McBride ---------------------------------------------------------------------------


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
    scale = jnp.sqrt(jnp.diagonal(equations.matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    ridge = 1e-12 * jnp.eye(scale.size)
    gradient = equations.gradient / scale
    newton = jnp.linalg.solve(equations.matrix / scale[:, None] / scale[None, :] + ridge, gradient)
    return jnp.dot(newton, gradient)


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


def skin_by_harmonic_steiglitz_mcbride(m: Measurement, driver: Driver, window: "Window") -> Fit:
    """SkinRC by Steiglitz-McBride on the harmonics, judged by the likelihood with Z_th as it is."""
    source = driver.source
    assert source is not None  # check_driver
    spectrum = spectrum_of(m, window)
    best = harmonic_steiglitz_mcbride.fit_skin(spectrum, source.response(spectrum.frequency))
    values = best.circuit.values()
    late = best.delay * m.sample_rate
    physical = jnp.isfinite(best.rrse)  # or else any likelihood will do
    elements = jnp.where(physical, values, SkinRC().values())

    def terms(q, spectrum):
        load = best.circuit.with_log_values(q[:-1]).impedance()
        delay = q[-1] / m.sample_rate
        return residual(spectrum, delayed_gain(source, load, spectrum.frequency, delay))

    equations = normal_equations(terms, jnp.append(jnp.log(elements), late), spectrum)
    freedom = 2 * jnp.sum(spectrum.selected, dtype=values.dtype) - values.size
    chi2 = 2 * equations.objective / freedom
    variance = jnp.diagonal(inverse(equations.matrix))[:-1]  # of the logarithms
    nothing = jnp.full((values.size, values.size), jnp.nan)
    return Fit(
        circuit=best.circuit,
        cov=nothing,
        shared_cov=nothing,
        rrse=best.rrse,
        chi2=jnp.where(physical, chi2, jnp.inf),
        result=first_verdict(
            (~best.stable, RESULTS.unstable),
            (~physical, RESULTS.nonphysical),
            (~best.converged, MAX_STEPS_REACHED),
            (misses(chi2, best.rrse) | (jnp.abs(late) > 1), RESULTS.misfit),
            (~(_distance(equations) <= BIASED), RESULTS.biased),
            (~jnp.all((variance > 0) & (variance < 1)), RESULTS.insensitive),
            (driver.result != SUCCESSFUL, RESULTS.driver_failed),
        ),
        steps=best.iteration,
        method="harmonic_steiglitz_mcbride",
    )


def driver_by_steiglitz_mcbride(
    m: Measurement, r_load: Float[Array, " record"], order: int, iterations: int
) -> Driver:
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
    return Driver(
        b=best.filter.num,
        a=best.filter.den,
        sample_rate=m.sample_rate[0],
        source=None,
        cov=None,
        calibration=None,
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


# --- Output error and maximum likelihood ---------------------------------------------------------


def skin_starts(
    m: Measurement, driver: Driver, circuit: AbstractCircuit, spectrum: Spectrum | None
) -> AbstractCircuit:
    """Several impedance levels and, for SkinRC, a Steiglitz-McBride estimate, stacked.

    Args:
        m: One recording.
        driver: Its driver.
        circuit: Structure and typical values.
        spectrum: Harmonics of the recording, for methods that use them.
    """
    typical = circuit.log_values()
    is_ohm = jnp.array([unit == "ohm" for unit in circuit.units().values()])
    sign = jnp.where(is_ohm, 1.0, -1.0)
    starts = [typical + float(np.log(level)) * sign for level in LEVELS]
    if isinstance(circuit, SkinRC):
        if spectrum is None:
            baseline = skin_by_steiglitz_mcbride(m, driver, steiglitz_mcbride.ITERATIONS).circuit
        else:
            z_th = driver.response(spectrum.frequency)
            baseline = harmonic_steiglitz_mcbride.fit_skin(spectrum, z_th, START_STEPS).circuit
        values = baseline.values()
        usable = jnp.all(values > 0) & jnp.isfinite(values).all()
        starts.append(jnp.where(usable, jnp.log(jnp.where(usable, values, 1.0)), typical))
    return circuit.with_log_values(jnp.stack(starts))


class Window(NamedTuple):
    """What a method on harmonics must know of a record before it is compiled.

    Attributes:
        periods: Whole periods (`spectra.whole_periods`).
        samples: The samples nearest to them.
        shared: Whether the unloaded record may be that of a calibration.
        parametric: Whether Z_th is what was identified, or the harmonics of the calibrations.
    """

    periods: int
    samples: int
    shared: bool
    parametric: bool = True


def spectrum_of(m: Measurement, window: Window) -> Spectrum:
    """Harmonics of one recording."""
    return spectrum(
        m.v_th, m.v_out, m.sigma_th, m.sigma_out, m.sample_rate, window.periods, window.samples
    )


def skin_by_refinement(
    m: Measurement, driver: Driver, circuit: AbstractCircuit, window: Window | None
) -> Fit:
    """Refine from the best of several starts.

    Args:
        m: One recording.
        driver: Its driver, with a continuous source impedance.
        circuit: Structure and typical values.
        window: For methods on harmonics; None for output error.
    """
    source, source_cov, calibration = driver.source, driver.cov, driver.calibration
    if source is None or source_cov is None or calibration is None:
        raise ValueError("the driver has no continuous source impedance")
    spectrum = None if window is None else spectrum_of(m, window)
    starts = skin_starts(m, driver, circuit, spectrum)
    if window is None or spectrum is None:
        _, estimate = output_error.fit_circuit(
            prediction.prepare(m), source, source_cov, calibration, starts
        )
        return judged(estimate, circuit, driver.result, "output_error")
    if not window.parametric:
        estimate, bias = non_parametric.fit_circuit(
            circuit,
            calibration,
            jnp.asarray(driver.sample_rate),
            spectrum,
            m.sample_rate,
            starts.log_values(),
        )
        # It needs the harmonics of the driver, whether or not a model of them was found.
        fit = judged(estimate, circuit, SUCCESSFUL, "non_parametric")
        far = jnp.any(jnp.abs(bias) > CORRECTED * jnp.sqrt(jnp.diagonal(estimate.cov)))
        result = RESULTS.where(far & (fit.result == SUCCESSFUL), RESULTS.biased, fit.result)
        return dataclasses.replace(fit, result=result)
    model = maximum_likelihood.Joint(
        circuit, source, calibration, jnp.asarray(driver.sample_rate), window.shared
    )
    estimate = maximum_likelihood.fit_circuit(model, spectrum, m.sample_rate, starts.log_values())
    return judged(estimate, circuit, driver.result, "maximum_likelihood")


def judged(
    estimate: output_error.Estimate, circuit: AbstractCircuit, driver_result: RESULTS, method: str
) -> Fit:
    """The fit of an estimate, with its verdict.

    Args:
        estimate: Its parameters are the logarithms of the elements.
        circuit: Structure of the load.
        driver_result: Verdict of the driver.
        method: Name of the estimator.
    """
    fitted = circuit.with_log_values(estimate.parameters)
    values = fitted.values()
    errors = jnp.sqrt(jnp.diagonal(estimate.cov))  # of the logarithms, so relative ones
    settled = RESULTS.promote(estimate.result) == RESULTS.successful
    return Fit(
        circuit=fitted,
        cov=estimate.cov * jnp.outer(values, values),
        shared_cov=estimate.shared_cov * jnp.outer(values, values),
        rrse=estimate.rrse,
        chi2=estimate.chi2,
        result=first_verdict(
            (~jnp.isfinite(estimate.chi2), RESULTS.unstable),
            (~jnp.isfinite(values).all(), RESULTS.nonphysical),
            (~settled, MAX_STEPS_REACHED),
            (misses(estimate.chi2, estimate.rrse) | _too_late(estimate), RESULTS.misfit),
            (estimate.strain > STRAINED, RESULTS.inconsistent),
            # None of 0: that is an element without any effect.
            (~jnp.all((errors > 0) & (errors < 1)), RESULTS.insensitive),
            (driver_result != SUCCESSFUL, RESULTS.driver_failed),
        ),
        steps=estimate.steps,
        method=method,
    )


def source_starts(
    baseline: Float[Array, " a"],
    order: int,
    sample_rate: Float[Array, ""],
    r_load: Float[Array, ""],
) -> SourceImpedance:
    """Starts for Z_th, stacked: three generic ones, and one with the baseline's resonance.

    Every start has one slow real pole and sections at the given frequencies and damping ratios; all
    gains are of the size of a tenth of the known resistor.
    """
    sections = (order - 1) // 2
    reals = order - 2 * sections
    turn = 2 * jnp.pi * sample_rate
    generic = [[(0.1, 0.3), (0.5, 1.5)], [(0.25, 0.3), (0.5, 1.5)], [(0.1, 0.3), (0.25, 0.3)]]
    far = (0.5, 1.5)  # further sections start overdamped at the edge of what was sampled

    def start(pairs):
        pairs = (pairs + [far] * sections)[:sections]
        omega = (
            jnp.stack([jnp.asarray(w) * jnp.ones(()) for w, _ in pairs]) if pairs else jnp.ones(0)
        )
        zeta = (
            jnp.stack([jnp.asarray(z) * jnp.ones(()) for _, z in pairs]) if pairs else jnp.ones(0)
        )
        slow = jnp.array([3e-4] + [0.5] * (reals - 1))
        small = 0.1 * r_load
        return SourceImpedance(
            log_resistance=jnp.log(0.05 * small),
            log_omega=jnp.log(omega * turn),
            log_zeta=jnp.log(zeta),
            gain=jnp.full(sections, small),
            slope=jnp.full(sections, small),
            log_omega_real=jnp.log(slow * turn),
            gain_real=jnp.full(reals, -0.5 * small),
        )

    starts = [start(pairs) for pairs in generic]
    if sections:
        s = jnp.log(poles(baseline))  # s / fs of the discrete poles
        # Resonances are the poles well inside the band; the least damped comes first.
        resonant = (s.imag > 0.05) & (s.imag < 0.9 * jnp.pi) & (s.real < 0)
        damping = jnp.where(resonant, -s.real / jnp.abs(s), jnp.inf)
        found = jnp.argsort(damping)[0]
        usable = jnp.isfinite(damping[found])
        omega = jnp.where(usable, jnp.abs(s[found]) / (2 * jnp.pi), 0.1)
        zeta = jnp.where(usable, damping[found], 0.3)
        starts.append(start([(omega, zeta)]))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)


def driver_by_refinement(
    m: Measurement, r_load: Float[Array, " record"], order: int, window: Window | None
) -> Driver:
    """Refine Z_th from several starts and keep the best that settled.

    Args:
        m: Calibrations, stacked along a leading axis.
        r_load: Their resistors [Ω].
        order: Number of poles.
        window: As in `skin_by_refinement`.
    """
    baseline = driver_by_steiglitz_mcbride(m, r_load, order, steiglitz_mcbride.ITERATIONS)
    starts = source_starts(baseline.a, order, m.sample_rate[0], r_load.mean())
    if window is None:
        records = jax.vmap(prediction.prepare)(m)

        def fit(start):
            return output_error.fit_source(records, r_load, start)
    else:
        spectra = jax.vmap(lambda m: spectrum_of(m, window))(m)

        def fit(start):
            return maximum_likelihood.fit_source(spectra, r_load, m.sample_rate[0], start)

    # One start after the other: side by side they would all run as long as the slowest, and slower.
    sources, estimates, calibrations = jax.lax.map(fit, starts)
    frequency = jnp.asarray(BAND) * m.sample_rate[0]

    def resistance(source, cov):
        vector, unflatten = ravel_pytree(source)
        slope = jax.jacfwd(lambda p: unflatten(p).response(frequency).real)(vector)
        error = jnp.sqrt(jnp.maximum(jnp.einsum("fi,ij,fj->f", slope, cov, slope), 0.0))
        return jnp.min(source.response(frequency).real + PASSIVE * error)

    passive = jax.vmap(resistance)(sources, estimates.cov) >= 0
    settled = RESULTS.promote(estimates.result) == RESULTS.successful
    finite = jnp.isfinite(estimates.chi2)
    # Starts that settled on a passive circuit come first. Between them log s + chi2 decides, not
    # chi2 alone, which a noisy
    # record can lower by a spurious resonance that raises s.
    log_s = jnp.log(estimates.rrse**2 / estimates.chi2)
    cost = jnp.where(finite, estimates.chi2 + log_s, jnp.inf)
    cost = cost + jnp.where(settled, 0.0, UNWANTED) + jnp.where(passive, 0.0, UNWANTED)
    chosen = jnp.argmin(jnp.where(finite, cost, jnp.inf))
    source, estimate, calibration = jax.tree.map(
        lambda leaf: leaf[chosen], (sources, estimates, calibrations)
    )
    return Driver(
        b=baseline.b,
        a=baseline.a,
        sample_rate=m.sample_rate[0],
        source=source,
        cov=estimate.cov,
        calibration=calibration,
        rrse=estimate.rrse,
        chi2=estimate.chi2,
        result=first_verdict(
            (~finite[chosen], RESULTS.unstable),
            (~passive[chosen], RESULTS.nonphysical),
            (~settled[chosen], MAX_STEPS_REACHED),
            (misses(estimate.chi2, estimate.rrse) | _too_late(estimate), RESULTS.misfit),
        ),
        steps=estimate.steps,
        method="output_error" if window is None else "maximum_likelihood",
    )
