"""Refined Z_th: fits from several starts; the best result is kept and judged."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from etid.estimators.judgement import MAX_STEPS_REACHED
from etid.estimators.lanes import Harmonics
from etid.estimators.starts import source_starts
from etid.estimators.steiglitz_mcbride import iteration
from etid.likelihood import driver, of_calibrations
from etid.likelihood.approximate_driver import approximated, departs, needs_order
from etid.likelihood.calibrations import Calibrations, Near
from etid.likelihood.linear import inverse
from etid.likelihood.noise import MISFIT_RRSE, misses, pull_of_ignored, shows_hum
from etid.likelihood.sandwich import Linear
from etid.likelihood.source_prior import delay_std, delay_width
from etid.precision import array_function, namespace, one_thread
from etid.recordings.remarks import Remark
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.fit import complex_rrse
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, first_verdict, left
from etid.signals.harmonics import Spectrum
from etid.signals.hold import DELAY, of_hold
from etid.signals.knots import above_noise, banded
from etid.signals.transfer import AnyArray, Rational, power

PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.001, 1.0, 400)  # of the highest bin in use; the source must be passive there
BIASED = 25.0  # at 40 dB it is 15, which moves a skin by half a standard error; at 30 dB 110
UNWANTED = 1e3  # added to the cost of a start that did not converge; larger than any cost
# Two sections closer than `SPLIT` in ln ω and ln ζ are one section, split by noise. Their gains
# grow with opposite signs along a curved valley, so the curvature at one point is not informative.
# `BLURRED` is added to the cost of such a start. The costs of good starts differ by 0.01.
SPLIT, BLURRED = 0.1, 1.0


def is_split(source: SourceImpedance) -> Bool[AnyArray, "*start"]:
    """Whether two sections of a source coincide."""
    xp = namespace(source.log_omega)
    place = xp.stack([source.log_omega, source.log_zeta])
    first, second = np.triu_indices(place.shape[-1], 1)
    near = xp.abs(place[..., first] - place[..., second]) < SPLIT
    return near.all(0).any(-1)


class _Best(NamedTuple):
    """The best of several starts.

    Attributes:
        model: The calibrations, with its Z_th.
        near: The likelihood near the minimum.
        least: The minimum.
        start: Number of the start.
        baseline: Z_th by Steiglitz-McBride.
    """

    model: Calibrations
    near: Near
    least: driver.Minimum
    start: int
    baseline: Rational


def _best(
    spectra: Spectrum,
    bands: Spectrum,
    r_load: Float[AnyArray, " record"],
    rate: Float[AnyArray, ""],
    order: int,
    instrument: Instrument | None,
) -> _Best:
    of_samples = spectra
    if spectra.held:  # a discrete filter takes the samples of the command
        hold = of_hold(spectra.frequency / rate)
        of_samples = dataclasses.replace(spectra, x=spectra.x / hold)
    baseline = iteration.periodic_driver_filter(of_samples, r_load, rate, order).filter
    starts = source_starts(baseline.den, order, rate, r_load.mean())
    first = jax.tree.map(lambda of: of[0], starts)
    width, std = delay_width(instrument, rate), delay_std(r_load)
    if spectra.held:
        width, std = DELAY, np.minimum(std, DELAY)
    calibration = Calibration(r_load, np.zeros(r_load.shape), std)
    model = Calibrations(first, calibration, spectra, rate, width, instrument)
    if r_load.size == 1:  # a single calibration does not show errors of the instrument
        model = dataclasses.replace(model, instrument=None)
    vectors = starts.vector()
    delays = np.zeros((len(vectors), r_load.size))
    q, steps = driver.brought_near(model, bands, np.concatenate([vectors, delays], -1))
    least = driver.minimum(model, np.pad(q, ((0, 0), (0, model.tolerances.size))))
    sources = jax.tree.map(lambda *of: np.stack(of), *map(model.source_of, least.q))
    kept = model.parameters(least.q[0]).size
    passive = _is_passive(sources, inverse(least.matrix)[:, :kept, :kept], spectra)
    costs = _cost(sources, driver.cost(model, least), passive)
    start = int(np.argmin(costs + np.where(least.settled, 0.0, UNWANTED)))
    least = driver.Minimum(*(of[start] for of in least._replace(points=least.points + steps)))
    model = model.at(least.q)
    return _Best(model, model.near(least.q), least, start, baseline)


@one_thread()
@array_function
def from_harmonics(
    records: Harmonics,
    r_load: Float[AnyArray, " record"],
    order: int,
    method: str,
    instrument: Instrument | None,
    accept: float,
) -> HarmonicDriver:
    """Refine Z_th by maximum likelihood.

    All harmonics are used of the bands in which V_th exceeds its noise.

    Where Z_th leaves more than noise, and so does a Z_th with one more section, all but chi2 and
    rrse is that of a Z_th with a smooth error (`etid.likelihood.approximate_driver`).
    """
    fields = records.fields, records.noise_of_x, r_load
    spectrum, (of_x, ignored), r_load = jax.tree.map(np.asarray, fields)
    spectrum = dataclasses.replace(spectrum, variance_x=of_x)
    rate = np.asarray(records.sample_rate)[0]
    bands = banded(spectrum)
    spectra = above_noise(spectrum, bands)
    of = spectra, bands, r_load, rate, order, instrument
    model, near, least, start, baseline = _best(*of)
    linear = model.linear(near)
    statistic = np.nanmax(of_calibrations.missing_pole(model, near, linear))
    calibration = _compared(model, near, linear)
    chi2 = 2 * least.objective / (model.terms - model.unknowns - model.unknown_states)
    predicted, y = near.profiles[0].gains * spectra.x, model.without_states(near.profiles)
    rrse = complex_rrse(predicted, y, spectra.selected).max()
    too_low, hum = statistic > of_calibrations.MISSING_POLE, _hums(model, near)
    inexact, wrong = False, _disagree(calibration, chi2, model.terms, statistic)
    if accept > 0 and least.settled and not wrong and departs(model, near):
        found = None if too_low and needs_order(model, near) else approximated(model, near)
        if found is not None and found.explains:
            inexact, too_low, points = True, np.bool_(False), least.points
            model, near, least = found.model.at(found.least.q), found.near, found.least
            least = least._replace(points=points + least.points)
            linear, hum = model.linear(near), hum | _hums(model, near)
            calibration = _compared(model, near, linear)
    kept = model.parameters(least.q).size
    cov = linear.first(model.unknowns).covariance()[:kept, :kept]  # at these errors
    passive = _is_passive(model.source, cov, spectra)
    rest = left(chi2, rrse)
    missed = rest > accept if inexact else misses(chi2, rrse)
    faults = _faults(chi2, missed, least.settled, calibration, passive, wrong)
    return HarmonicDriver(
        b=baseline.num,
        a=baseline.den,
        sample_rate=rate,
        cov=cov,
        rrse=rrse,
        chi2=chi2,
        steps=least.points,
        start=np.asarray(start),
        remarks=np.where(hum, int(Remark.mains_hum), 0),
        source=model.source,
        calibration=calibration,
        result=first_verdict(
            *faults,
            (too_low, RESULTS.order_too_low),
            (_is_biased(model, near, linear, ignored), RESULTS.biased),
            (np.bool_(inexact and rest > MISFIT_RRSE), RESULTS.approximate),
        ),
        method=method,
        spectra=spectra,
        instrument=instrument,
        missing_pole=statistic,
    )


def _is_biased(
    model: Calibrations,
    near: Near,
    linear: Linear,
    ignored: Float[np.ndarray, "record bin"] | None,
) -> np.bool_:
    """Whether noise of X that the weights leave out has moved the minimum.

    `BIASED` is the square of the move in standard errors of all parameters.
    """
    if ignored is None:
        return np.bool_(False)
    s, slopes = model.spectra, near.slopes
    weight = np.where(s.selected, 2 * ignored / s.variance_y, 0.0)
    gradient = pull_of_ignored(model.knots, weight, slopes.gains, slopes.by_q)
    return gradient @ linear.bread() @ gradient > BIASED


@array_function
def _is_passive(
    source: SourceImpedance,
    cov: Float[AnyArray, "*start parameter parameter"],
    spectra: Spectrum,
) -> Bool[AnyArray, "*start"]:
    """Whether Re Z_th is nowhere negative by more than its standard errors allow."""
    xp = namespace(cov)
    frequency = BAND * xp.where(spectra.selected, spectra.frequency, 0.0).max()
    z_th, slopes = source.slopes(source.vector(), frequency)
    slope = slopes.real
    error = xp.sqrt(xp.maximum((slope * (cov @ slope)).sum(-2), 0.0))
    return (z_th.real + PASSIVE * error).min(-1) >= 0


def _cost(
    source: SourceImpedance, cost: Float[AnyArray, "*start"], passive: Bool[AnyArray, "*start"]
) -> Float[AnyArray, "*start"]:
    """The cost by which starts compete; passive circuits come first."""
    xp = namespace(cost)
    cost = cost + xp.where(passive, 0.0, UNWANTED)
    cost = cost + xp.where(is_split(source), BLURRED, 0.0)
    return xp.where(xp.isfinite(cost), cost, np.inf)


def _compared(model: Calibrations, near: Near, linear: Linear) -> Calibration:
    """The calibrations, with what each known resistor shows beside the others."""
    if model.calibration.r_load.size == 1:
        return model.calibration
    off = of_calibrations.mismatch(model, near, linear)
    return dataclasses.replace(model.calibration, mismatch=off.off, across=off.across)


def _hums(model: Calibrations, near: Near) -> Bool[AnyArray, ""]:
    """Whether the residual of a calibration shows hum."""
    # Gains are those of all calibrations; hum shows in harmonics that are not used.
    s, gains = model.spectra, near.profiles[0].gains
    squares = power(model.without_states(near.profiles) - gains * s.x)
    squares = squares / (s.variance_y + power(gains) * s.variance_x)
    return shows_hum(squares, s.frequency[0], s.selected)


def _disagree(
    of: Calibration,
    chi2: Float[AnyArray, ""],
    terms: Float[AnyArray, ""],
    missing_pole: Float[AnyArray, ""],
) -> Bool[AnyArray, ""]:
    """Whether the resistors show different impedances."""
    if of.mismatch is None or of.across is None:
        return np.bool_(False)
    wrong = of_calibrations.disagree(of.mismatch, chi2, terms)
    return wrong | of_calibrations.bridged(of.across, chi2, terms, missing_pole)


def _faults(
    chi2: Float[AnyArray, ""],
    missed: Bool[AnyArray, ""],
    settled: Bool[AnyArray, ""],
    calibration: Calibration,
    passive: Bool[AnyArray, ""],
    wrong: Bool[AnyArray, ""],
) -> list[tuple[Bool[AnyArray, ""], RESULTS]]:
    """What is wrong with a driver, the worst first."""
    xp = namespace(chi2)
    late = (xp.abs(calibration.delay_samples) > 1).any()  # the model holds up to one sample
    return [
        (~xp.isfinite(chi2), RESULTS.unstable),
        (wrong, RESULTS.resistors_disagree),
        (~passive, RESULTS.nonphysical),
        (~settled, MAX_STEPS_REACHED),
        (missed | late, RESULTS.misfit),
    ]
