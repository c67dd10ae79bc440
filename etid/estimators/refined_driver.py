"""Refined Z_th: fits from several starts; the best result is kept and judged."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float

from etid.estimators.judgement import MAX_STEPS_REACHED
from etid.estimators.lanes import Harmonics
from etid.estimators.starts import source_starts
from etid.estimators.steiglitz_mcbride import iteration
from etid.likelihood import driver, of_calibrations
from etid.likelihood.calibrations import Calibrations
from etid.likelihood.linear import inverse
from etid.likelihood.noise import misses, shows_hum
from etid.likelihood.source_prior import delay_std, delay_width
from etid.precision import array_function, namespace, one_thread
from etid.recordings.remarks import Remark
from etid.results.driver import Calibration, HarmonicDriver, SourceImpedance
from etid.results.fit import complex_rrse
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals import modal
from etid.signals.hold import DELAY, of_hold
from etid.signals.knots import above_noise, banded
from etid.signals.transfer import AnyArray, power

PASSIVE = 2.0  # standard errors by which Re Z_th may be negative
BAND = np.linspace(0.0003, 0.4, 400)  # of the sample rate; the source must be passive there
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


@one_thread()
@array_function
def from_harmonics(
    records: Harmonics,
    r_load: Float[AnyArray, " record"],
    order: int,
    method: str,
    instrument: Instrument | None,
) -> HarmonicDriver:
    """Refine Z_th by maximum likelihood.

    All harmonics are used of the bands in which V_th exceeds its noise.
    """
    spectrum, r_load = jax.tree.map(np.asarray, (records.fields, r_load))
    rate = np.asarray(records.sample_rate)[0]
    bands = banded(spectrum)
    spectra = above_noise(spectrum, bands)
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
    passive = _is_passive(sources, inverse(least.matrix)[:, :kept, :kept], rate)
    costs = _cost(sources, driver.cost(model, least), passive)
    start = int(np.argmin(costs + np.where(least.settled, 0.0, UNWANTED)))
    least = least._replace(points=least.points + steps)
    least = driver.Minimum(*(of[start] for of in least))
    model, near = model.at(least.q), model.near(least.q)
    linear = model.linear(near)
    cov = linear.first(model.unknowns).covariance()[:kept, :kept]  # at these errors
    statistic = np.nanmax(of_calibrations.missing_pole(model, near, linear))
    calibration = model.calibration
    if r_load.size > 1:
        off = of_calibrations.mismatch(model, near, linear)
        calibration = dataclasses.replace(calibration, mismatch=off.off, across=off.across)
    chi2 = 2 * least.objective / (model.terms - model.unknowns - model.unknown_states)
    gains = near.profiles[0].gains  # of all calibrations; hum shows in harmonics that are not used
    y = model.without_states(near.profiles)
    squares = power(y - gains * spectra.x)
    squares = squares / (spectra.variance_y + power(gains) * spectra.variance_x)
    rrse = complex_rrse(gains * spectra.x, y, spectra.selected).max()
    hum = shows_hum(squares, spectra.frequency[0], spectra.selected)
    passive = _is_passive(model.source, cov, rate)
    faults = _faults(chi2, rrse, least.settled, calibration, passive, model.terms, statistic)
    too_low = statistic > of_calibrations.MISSING_POLE
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
        result=first_verdict(*faults, (too_low, RESULTS.order_too_low)),
        method=method,
        spectra=spectra,
        instrument=instrument,
        missing_pole=statistic,
    )


@array_function
def _is_passive(
    source: SourceImpedance,
    cov: Float[AnyArray, "*start parameter parameter"],
    rate: Float[AnyArray, ""],
) -> Bool[AnyArray, "*start"]:
    """Whether Re Z_th is nowhere negative by more than its standard errors allow."""
    xp, frequency = namespace(cov), BAND * rate
    z_th, slopes = modal.with_slopes(source.vector(), source.log_omega.shape[-1], frequency)
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


def _faults(
    chi2: Float[AnyArray, ""],
    rrse: Float[AnyArray, ""],
    settled: Bool[AnyArray, ""],
    calibration: Calibration,
    passive: Bool[AnyArray, ""],
    terms: Float[AnyArray, ""],
    missing_pole: Float[AnyArray, ""] | None = None,
) -> list[tuple[Bool[AnyArray, ""], RESULTS]]:
    """What is wrong with a driver, the worst first."""
    xp = namespace(chi2)
    wrong = xp.bool_(False)
    if calibration.mismatch is not None:
        wrong = of_calibrations.disagree(calibration.mismatch, chi2, terms)
    if calibration.across is not None and missing_pole is not None:
        wrong = wrong | of_calibrations.bridged(calibration.across, chi2, terms, missing_pole)
    late = (xp.abs(calibration.delay_samples) > 1).any()  # the model holds up to one sample
    return [
        (~xp.isfinite(chi2), RESULTS.unstable),
        (wrong, RESULTS.resistors_disagree),
        (~passive, RESULTS.nonphysical),
        (~settled, MAX_STEPS_REACHED),
        (misses(chi2, rrse) | late, RESULTS.misfit),
    ]
