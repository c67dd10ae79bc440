"""Refined Z_th: a fit from several starts; the best result is kept and judged."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from etid.estimators.estimate import Estimate
from etid.estimators.judgement import MAX_STEPS_REACHED, misses, remarks, too_late
from etid.estimators.maximum_likelihood import driver as maximum_likelihood
from etid.estimators.output_error import fit as output_error
from etid.estimators.output_error import prediction
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import missing_pole, resistors
from etid.estimators.starts import source_starts
from etid.estimators.steiglitz_mcbride import iteration
from etid.results.driver import Calibration, ContinuousDriver, HarmonicDriver, SourceImpedance
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import Spectrum
from etid.signals.noise import Measurement

PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.0003, 0.4, 400)  # of the sample rate; the source must be passive there
UNWANTED = 1e3  # added to the cost of a start that did not converge; larger than any cost
# Two sections closer than `SPLIT` in ln ω and ln ζ are one section, split by noise. Their gains
# grow with opposite signs along a curved valley, so the curvature at one point is not informative.
# `BLURRED` is added to the cost of such a start. The costs of good starts differ by 0.01.
SPLIT, BLURRED = 0.1, 1.0


class _Found(NamedTuple):
    """The result of a fit from one start; `linear` are the terms if it is on harmonics."""

    source: SourceImpedance
    estimate: Estimate
    calibration: Calibration
    linear: Linear | None = None


def is_split(source: SourceImpedance) -> Bool[Array, ""]:
    """Whether two sections of a source coincide."""
    place = jnp.stack([source.log_omega, source.log_zeta])
    first, second = np.triu_indices(place.shape[1], 1)
    return jnp.any(jnp.all(jnp.abs(place[:, first] - place[:, second]) < SPLIT, axis=0))


def refined_driver(
    m: Measurement,
    r_load: Float[Array, " record"],
    order: int,
    spectra: Spectrum | None,
    method: str,
) -> ContinuousDriver:
    """Refine Z_th from several starts and keep the best that converged.

    Args:
        m: Calibrations, stacked along a leading axis.
        r_load: Resistor of each calibration [Ω].
        order: Number of poles.
        spectra: Harmonics of the calibrations for maximum likelihood; None for output error.
        method: Name of the estimator.
    """
    rate = m.sample_rate[0]
    # Its resonance is one start. Without it, 5 of 200 drivers end in a minimum with a larger χ².
    baseline = iteration.driver_filter(m.v_th, m.v_out, r_load, order).filter
    if spectra is None:
        records = jax.vmap(prediction.prepare)(m)

        def fit(start: SourceImpedance) -> _Found:
            return _Found(*output_error.fit_source(records, r_load, start))
    else:

        def fit(start: SourceImpedance) -> _Found:
            return _Found(*maximum_likelihood.fit_source(spectra, r_load, rate, start))

    starts = source_starts(baseline.den, order, rate, r_load.mean())
    # One start after the other. In parallel all would run as long as the slowest, and be slower.
    found = jax.lax.map(fit, starts)
    sources, estimates = found.source, found.estimate
    frequency = jnp.asarray(BAND) * rate

    def resistance(
        source: SourceImpedance, cov: Float[Array, "parameter parameter"]
    ) -> Float[Array, ""]:
        slope = source.slopes(frequency).real
        error = jnp.sqrt(jnp.maximum(jnp.sum(slope * (cov @ slope), axis=0), 0.0))
        return jnp.min(source.response(frequency).real + PASSIVE * error)

    passive = jax.vmap(resistance)(sources, estimates.cov) >= 0
    settled = RESULTS.promote(estimates.result) == RESULTS.successful
    finite = jnp.isfinite(estimates.chi2)
    # Starts that converged to a passive circuit come first. Among them log s + chi2 decides. With a
    # noisy record, a spurious resonance can lower chi2 alone; but it raises s.
    log_s = jnp.log(estimates.rrse**2 / estimates.chi2)
    cost = jnp.where(finite, estimates.chi2 + log_s, jnp.inf)
    cost = cost + jnp.where(settled, 0.0, UNWANTED) + jnp.where(passive, 0.0, UNWANTED)
    cost = cost + jnp.where(jax.vmap(is_split)(sources), BLURRED, 0.0)
    chosen = jnp.argmin(jnp.where(finite, cost, jnp.inf))
    best = jax.tree.map(lambda leaf: leaf[chosen], found)
    source, estimate, calibration = best.source, best.estimate, best.calibration
    wrong = jnp.array(False)
    kind, lacks = ContinuousDriver, jnp.array(False)
    terms = jnp.asarray(m.v_out.size, m.v_out.dtype)
    if spectra is not None:
        calibrations = maximum_likelihood.Calibrations(source, calibration, spectra, rate)
        statistic = missing_pole.largest(calibrations, best.linear)
        kind = functools.partial(HarmonicDriver, spectra=spectra, missing_pole=statistic)
        lacks = statistic > missing_pole.SEEN
        terms = 2 * jnp.sum(spectra.selected, dtype=terms.dtype)
        if r_load.size > 1:
            off = resistors.mismatch(calibrations, best.linear)
            calibration = dataclasses.replace(calibration, mismatch=off)
    if calibration.mismatch is not None:
        wrong = resistors.disagree(calibration.mismatch, estimate.chi2, terms)
    return kind(
        b=baseline.num,
        a=baseline.den,
        sample_rate=rate,
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
        method=method,
    )
