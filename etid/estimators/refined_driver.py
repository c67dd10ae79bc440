"""Refined Z_th: fits from several starts; the best result is kept and judged."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from etid.estimators.estimate import SOLVER, Estimate
from etid.estimators.judgement import MAX_STEPS_REACHED, misses, remarks, too_late
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood import driver as maximum_likelihood
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.score_tests import of_calibrations
from etid.estimators.starts import source_starts
from etid.estimators.steiglitz_mcbride import iteration
from etid.results.driver import Calibration, ContinuousDriver, HarmonicDriver, SourceImpedance
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.knots import above_noise, banded
from etid.signals.noise import Measurement
from etid.signals.transfer import Rational

PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.0003, 0.4, 400)  # of the sample rate; the source must be passive there
ROUGHLY = 1e-5  # reduction of Σ r² in a step, below which a start of output error ends
UNWANTED = 1e3  # added to the cost of a start that did not converge; larger than any cost
# Two sections closer than `SPLIT` in ln ω and ln ζ are one section, split by noise. Their gains
# grow with opposite signs along a curved valley, so the curvature at one point is not informative.
# `BLURRED` is added to the cost of such a start. The costs of good starts differ by 0.01.
SPLIT, BLURRED = 0.1, 1.0


def is_split(source: SourceImpedance) -> Bool[Array, ""]:
    """Whether two sections of a source coincide."""
    place = jnp.stack([source.log_omega, source.log_zeta])
    first, second = np.triu_indices(place.shape[1], 1)
    return jnp.any(jnp.all(jnp.abs(place[:, first] - place[:, second]) < SPLIT, axis=0))


def from_harmonics(
    records: Harmonics,
    r_load: Float[Array, " record"],
    order: int,
    method: str,
    instrument: Instrument | None,
) -> HarmonicDriver:
    """Refine Z_th by maximum likelihood.

    The fits from all starts use bands of harmonics. The best is refined with all harmonics of the
    bands in which V_th exceeds its noise.
    """
    bands, rate = banded(records.spectrum), jnp.asarray(records.sample_rate)[0]
    spectra = above_noise(records.spectrum, bands)
    baseline = iteration.periodic_driver_filter(spectra, r_load, rate, order)

    def fit(start: SourceImpedance) -> maximum_likelihood.Rough:
        return maximum_likelihood.rough_source(spectra, bands, r_load, rate, start)

    starts = source_starts(baseline.filter.den, order, rate, r_load.mean())
    # One start after the other. In parallel all would run as long as the slowest, and be slower.
    found = jax.lax.map(fit, starts)
    passive = jax.vmap(_is_passive, (0, 0, None))(found.source, found.cov, rate)
    ranked = jnp.argsort(jax.vmap(_cost)(found.source, found.cost, passive))
    candidates = jax.tree.map(lambda leaf: leaf[ranked], found)
    calibrations, estimate, near, linear = maximum_likelihood.fit_source(
        spectra, r_load, rate, candidates, instrument
    )
    estimate = dataclasses.replace(estimate, start=ranked[estimate.start])
    source, calibration = calibrations.source, calibrations.calibration
    statistic = jnp.nanmax(of_calibrations.missing_pole(calibrations, near, linear))
    if r_load.size > 1:
        off = of_calibrations.mismatch(calibrations, near, linear)
        calibration = dataclasses.replace(calibration, mismatch=off.off, across=off.across)
    terms = 2 * jnp.sum(spectra.selected, dtype=rate.dtype)
    passive = _is_passive(source, estimate.cov, rate)
    return HarmonicDriver(
        **_fields(baseline.filter, estimate, rate),
        source=source,
        calibration=calibration,
        result=first_verdict(
            *_faults(estimate, calibration, passive, terms, statistic),
            (statistic > of_calibrations.MISSING_POLE, RESULTS.order_too_low),
        ),
        method=method,
        spectra=spectra,
        instrument=instrument,
        missing_pole=statistic,
    )


def from_samples(
    m: Measurement,
    r_load: Float[Array, " record"],
    order: int,
    method: str,
    instrument: Instrument | None,
) -> ContinuousDriver:
    """Refine Z_th by output error."""
    rate = m.sample_rate[0]
    baseline = iteration.driver_filter(m.v_th, m.v_out, r_load, order).filter
    records = jax.vmap(prediction.prepare)(m)
    starts = source_starts(baseline.den, order, rate, r_load.mean())
    count = starts.log_resistance.size

    def fitted(best: tuple[SourceImpedance, Array, Array], number: Array) -> tuple[Any, Any]:
        last = number == count
        start = jax.tree.map(
            lambda every, one: jnp.where(last, one, every[number % count]), starts, best[0]
        )
        ftol = jnp.where(last, SOLVER.ftol, ROUGHLY)
        source, estimate, calibration = output_error.fit_source(records, r_load, start, ftol)
        passive = _is_passive(source, estimate.cov, rate)
        # Starts that converged to a passive circuit come first. Among them log s + chi2 decides.
        # With a noisy record, a spurious resonance can lower chi2 alone; but it raises s.
        log_s = jnp.log(estimate.rrse**2 / estimate.chi2)
        settled = estimate.result == optx.RESULTS.successful
        cost = estimate.chi2 + log_s + jnp.where(settled, 0.0, UNWANTED)
        estimate = dataclasses.replace(estimate, start=best[1])
        new = source, number, _cost(source, cost, passive)
        better = new[2] < best[2]
        best = jax.tree.map(lambda one, other: jnp.where(better, one, other), new, best)
        return best, (source, estimate, calibration, passive)

    # All starts roughly, and then the best of them well: one loop holds the only copy of the fit.
    nothing = jax.tree.map(lambda leaf: leaf[0], starts), jnp.array(0), jnp.array(jnp.inf)
    _, found = jax.lax.scan(fitted, nothing, jnp.arange(count + 1))
    source, estimate, calibration, passive = jax.tree.map(lambda leaf: leaf[-1], found)
    terms = jnp.asarray(m.v_out.size, m.v_out.dtype)
    return ContinuousDriver(
        **_fields(baseline, estimate, rate),
        source=source,
        calibration=calibration,
        result=first_verdict(*_faults(estimate, calibration, passive, terms)),
        instrument=instrument,
        method=method,
    )


def _fields(baseline: Rational, estimate: Estimate, rate: Float[Array, ""]) -> dict[str, Any]:
    """What the drivers of both methods have from their baseline and their estimate."""
    return {
        "b": baseline.num,
        "a": baseline.den,
        "sample_rate": rate,
        "cov": estimate.cov,
        "rrse": estimate.rrse,
        "chi2": estimate.chi2,
        "steps": estimate.steps,
        "start": estimate.start,
        "remarks": remarks(estimate),
    }


def _is_passive(
    source: SourceImpedance, cov: Float[Array, "parameter parameter"], rate: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether Re Z_th is nowhere negative by more than its standard errors allow."""
    frequency = jnp.asarray(BAND) * rate
    z_th, slopes = source.with_slopes(frequency)
    slope = slopes.real
    error = jnp.sqrt(jnp.maximum(jnp.sum(slope * (cov @ slope), axis=0), 0.0))
    return jnp.min(z_th.real + PASSIVE * error) >= 0


def _cost(
    source: SourceImpedance, cost: Float[Array, ""], passive: Bool[Array, ""]
) -> Float[Array, ""]:
    """The cost by which starts compete; passive circuits come first."""
    cost = cost + jnp.where(passive, 0.0, UNWANTED)
    cost = cost + jnp.where(is_split(source), BLURRED, 0.0)
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def _faults(
    estimate: Estimate,
    calibration: Calibration,
    passive: Bool[Array, ""],
    terms: Float[Array, ""],
    missing_pole: Float[Array, ""] | None = None,
) -> list[tuple[Bool[Array, ""], RESULTS]]:
    """What is wrong with a driver, the worst first."""
    settled = estimate.result == optx.RESULTS.successful
    wrong = jnp.array(False)
    if calibration.mismatch is not None:
        wrong = of_calibrations.disagree(calibration.mismatch, estimate.chi2, terms)
    if calibration.across is not None and missing_pole is not None:
        of = calibration.across, estimate.chi2, terms
        wrong |= of_calibrations.bridged(*of, missing_pole)
    return [
        (~jnp.isfinite(estimate.chi2), RESULTS.unstable),
        (wrong, RESULTS.resistors_disagree),
        (~passive, RESULTS.nonphysical),
        (~settled, MAX_STEPS_REACHED),
        (misses(estimate.chi2, estimate.rrse) | too_late(estimate), RESULTS.misfit),
    ]
