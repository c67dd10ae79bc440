"""Refinement: samples or harmonics in, judged estimate out; for one recording and for a batch."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators import harmonic_steiglitz_mcbride, non_parametric, steiglitz_mcbride
from etid.estimators.baseline import driver_by_steiglitz_mcbride, skin_by_steiglitz_mcbride
from etid.estimators.judgement import (
    MAX_STEPS_REACHED,
    SUCCESSFUL,
    judged,
    misses,
    remarks,
    too_late,
    unless,
)
from etid.estimators.maximum_likelihood import driver as maximum_likelihood
from etid.estimators.maximum_likelihood import load as single_load
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.score_tests import missing_pole, resistors
from etid.estimators.score_tests.unloaded import UnloadedShape
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver, SourceImpedance
from etid.results.fits import Fit
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import Spectrum
from etid.signals.measurement import Measurement
from etid.signals.transfer import poles

CORRECTED = (
    2.0  # standard errors of bias that may be corrected; what it leaves is below half of one
)
# Of the signal, what the interpolation of output error may leave unexplained. At 100 kHz and 80 dB
# it is 6e-4 and costs R_s ten standard errors; at 200 kHz it is 1e-4 and costs less than one.
INTERPOLATED = 3e-4
PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.0003, 0.4, 400)  # of the sample rate, where a source must be passive
LEVELS = (1.0, 0.125, 0.5, 2.0, 8.0)  # impedance levels at which a circuit is started
START_STEPS = 8  # of Steiglitz-McBride on harmonics, which settles in three to eight
UNWANTED = 1e3  # added to the cost of a start that did not settle; any cost is smaller
# Two sections closer than this in ln ω and ln ζ are one that noise has split: their gains grow
# against each other along a curved valley, of which the curvature at one place tells nothing. Costs
# of good starts differ by 0.01.
SPLIT, BLURRED = 0.1, 1.0


def circuit_starts(
    circuit: AbstractCircuit, baseline: AbstractCircuit | None
) -> Float[Array, "start element"]:
    """Logarithms of elements: several impedance levels, and a simpler estimate of them."""
    typical = circuit.log_values()
    power, _ = circuit.scaling()
    starts = [typical + float(np.log(level)) * power for level in LEVELS]
    if baseline is not None:
        values = baseline.values()
        usable = jnp.all(values > 0) & jnp.isfinite(values).all()
        starts.append(jnp.where(usable, jnp.log(jnp.where(usable, values, 1.0)), typical))
    return jnp.stack(starts)


def skin_by_output_error(
    m: Measurement, samples: Int[Array, ""], driver: ContinuousDriver, circuit: AbstractCircuit
) -> Fit:
    """Refine from the best of several starts.

    Args:
        m: One recording.
        samples: How many of its first samples were recorded.
        driver: Its driver.
        circuit: Structure and typical values.
    """
    baseline = None
    if isinstance(circuit, SkinRC):
        baseline = skin_by_steiglitz_mcbride(m, driver, steiglitz_mcbride.ITERATIONS).circuit
    starts = circuit.with_log_values(circuit_starts(circuit, baseline))
    _, estimate, other = output_error.fit_circuit(
        prediction.prepare(m, samples=samples), driver, starts
    )
    fit = judged(estimate, circuit, driver.result, "output_error")
    fit = unless(fit, misses(estimate.chi2, estimate.rrse, INTERPOLATED), RESULTS.biased)
    if isinstance(driver, HarmonicDriver):
        # Maximum likelihood knows its driver better than output error is exact: what that is off
        # by, three standard errors, would be seen as a relaxation.
        return fit
    return unless(fit, other, RESULTS.misfit)


def harmonic_starts(
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    z_th: Complex[Array, " harmonic"],
    circuit: AbstractCircuit,
) -> LoadUnknowns:
    """Where a fit on harmonics may start, stacked; the likeliest comes last.

    Args:
        spectrum: One recording.
        sample_rate: Its sampling rate [Hz].
        z_th: Source impedance there [Ω].
        circuit: Structure and typical values.
    """
    if not isinstance(circuit, SkinRC):
        starts = circuit_starts(circuit, None)
        return LoadUnknowns(starts, jnp.zeros(starts.shape[0]))
    baseline = harmonic_steiglitz_mcbride.fit_skin(spectrum, z_th, sample_rate, START_STEPS)
    starts = circuit_starts(circuit, baseline.circuit)
    return LoadUnknowns(starts, jnp.zeros(starts.shape[0]).at[-1].set(baseline.delay_samples))


def skin_by_maximum_likelihood(
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    driver: Driver,
    known: GivenDriver,
    circuit: AbstractCircuit,
) -> Fit:
    """Refine from the best of several starts, jointly with what the driver leaves open.

    Args:
        spectrum: One recording.
        sample_rate: Its sampling rate [Hz].
        driver: Its driver.
        known: What its calibrations tell.
        circuit: Structure and typical values.
    """
    starts = harmonic_starts(
        spectrum, sample_rate, known.z_th(jnp.zeros_like(known.loaded)), circuit
    )
    estimate, far, other = single_load.fit_circuit(known, circuit, spectrum, sample_rate, starts)
    fit = judged(estimate, circuit, driver.result, "maximum_likelihood")
    if known.shape is not None:
        fit = unless(fit, known.shape.differs(spectrum), RESULTS.inconsistent)
    return unless(unless(fit, far, RESULTS.driver_unclear), other, RESULTS.misfit)


def skin_by_non_parametric(
    spectrum: Spectrum,
    sample_rate: Float[Array, ""],
    driver: HarmonicDriver,
    known: UnloadedShape | None,
    circuit: AbstractCircuit,
) -> Fit:
    """The same with Z_th as the calibrations show it at each harmonic, and their V_th."""
    starts = harmonic_starts(spectrum, sample_rate, driver.response(spectrum.frequency), circuit)
    estimate, bias = non_parametric.fit_circuit(circuit, driver, spectrum, sample_rate, starts)
    # It needs the harmonics of the driver, whether or not a model of them was found.
    fit = judged(estimate, circuit, SUCCESSFUL, "non_parametric")
    if known is not None:
        fit = unless(fit, known.differs(spectrum), RESULTS.inconsistent)
    far = jnp.any(jnp.abs(bias) > CORRECTED * jnp.sqrt(jnp.diagonal(estimate.cov)))
    return unless(fit, far, RESULTS.biased)


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


def is_split(source: SourceImpedance) -> Bool[Array, ""]:
    """Whether two sections of a source are in one place."""
    place = jnp.stack([source.log_omega, source.log_zeta])
    first, second = np.triu_indices(place.shape[1], 1)
    return jnp.any(jnp.all(jnp.abs(place[:, first] - place[:, second]) < SPLIT, axis=0))


def driver_by_refinement(
    m: Measurement, r_load: Float[Array, " record"], order: int, spectra: Spectrum | None
) -> Driver:
    """Refine Z_th from several starts and keep the best that settled.

    Args:
        m: Calibrations, stacked along a leading axis.
        r_load: Their resistors [Ω].
        order: Number of poles.
        spectra: Their harmonics, for maximum likelihood; None for output error.
    """
    baseline = driver_by_steiglitz_mcbride(m, r_load, order, steiglitz_mcbride.ITERATIONS)
    starts = source_starts(baseline.a, order, m.sample_rate[0], r_load.mean())
    if spectra is None:
        records = jax.vmap(prediction.prepare)(m)

        def fit(start):
            return output_error.fit_source(records, r_load, start)
    else:

        def fit(start):
            return maximum_likelihood.fit_source(spectra, r_load, m.sample_rate[0], start)

    # One start after the other: side by side they would all run as long as the slowest, and slower.
    sources, estimates, known = jax.lax.map(fit, starts)
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
    cost = cost + jnp.where(jax.vmap(is_split)(sources), BLURRED, 0.0)
    chosen = jnp.argmin(jnp.where(finite, cost, jnp.inf))
    source, estimate, calibration = jax.tree.map(
        lambda leaf: leaf[chosen], (sources, estimates, known)
    )
    lacks = wrong = jnp.array(False)
    terms = jnp.asarray(m.v_out.size, m.v_out.dtype)
    if spectra is not None:
        calibrations = maximum_likelihood.Calibrations(
            source, calibration, spectra, m.sample_rate[0]
        )
        lacks = missing_pole.is_seen(calibrations)
        terms = 2 * jnp.sum(spectra.selected, dtype=terms.dtype)
        if r_load.size > 1:
            off = resistors.mismatch(calibrations)
            calibration = dataclasses.replace(calibration, mismatch=off)
    if calibration.mismatch is not None:
        wrong = resistors.disagree(calibration.mismatch, estimate.chi2, terms)
    kind = (
        ContinuousDriver if spectra is None else functools.partial(HarmonicDriver, spectra=spectra)
    )
    return kind(
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
            (wrong, RESULTS.resistors_disagree),
            (~passive[chosen], RESULTS.nonphysical),
            (~settled[chosen], MAX_STEPS_REACHED),
            (misses(estimate.chi2, estimate.rrse) | too_late(estimate), RESULTS.misfit),
            (lacks, RESULTS.order_too_low),
        ),
        steps=estimate.steps,
        remarks=remarks(estimate.hum),
        method="output_error" if spectra is None else "maximum_likelihood",
    )
