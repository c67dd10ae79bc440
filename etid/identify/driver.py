"""Identification of a driver: pre-flight, baseline, refinement, verdict."""

import dataclasses
import logging
from collections.abc import Sequence
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float

from etid.estimators.estimator import AbstractEstimator, serving
from etid.estimators.lanes import AlignedSamples, Bins, Harmonics, stacked
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, Method, named
from etid.identify import changes
from etid.identify.arguments import check_alike, check_distinct, recordings
from etid.identify.fitting import better_of, checksum, may_hum
from etid.identify.options import (
    Options,
    check_instrument,
    check_order,
    instrument_of,
    unfit,
)
from etid.identify.planning import explained
from etid.precision import in_float64
from etid.printing import rounded
from etid.recordings.causes import LOG, log_changes
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.repeats import repeats
from etid.results.driver import AUTO, ContinuousDriver, Driver, HarmonicDriver, Order
from etid.results.fit import IdentificationError
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE
from etid.results.verdicts import message, verdict
from etid.selection.driver_order import TriedOrder, best, evidence, next_order
from etid.signals.harmonics import Spectrum
from etid.signals.knots import above_noise, banded

# Factor by which rough values of |Z_th| may differ between resistors. At low frequency Z_th is real
# to a few per cent.
ROUGHLY = 3.0

Lane = Harmonics | AlignedSamples


@in_float64
def identify_driver(
    calibrations: Recording | Sequence[Recording],
    *,
    order: Order = 5,
    method: Method | None = None,
    plausible: tuple[float, float] = PLAUSIBLE,
    instrument: Instrument | None = None,
    throw: bool = True,
) -> Driver:
    """Identify the source impedance Z_th from one or several records with known resistors.

    Args:
        calibrations: Recordings with `r_load`, all of the same length, sample rate and pulse rate.
        order: Number of poles of Z_th (the paper uses 5), or `"auto"`: from 7 on as many as the
            calibrations need, by maximum likelihood, so that the standard errors contain poles that
            the calibrations do not show. `driver.tried` holds the evidence.
        method: `"maximum_likelihood"`, the default; `"output_error"`, or the paper's
            `"steiglitz_mcbride"`. An estimator with options is possible too, as in
            `etid.SteiglitzMcBride(iterations=5)`.
        plausible: Smallest and largest |Z_th| [Ω] at 1 kHz that is accepted. The default range
            spans a factor of 1000: a driver within the range leaves it if `r_load` is given in kΩ.
        instrument: Tolerances of the instrument, as in `etid.Instrument(gain=1e-3)`. They enter the
            standard errors of the skins, as part of `shared_cov`. All but a drift need maximum
            likelihood. If not given, it is that of the calibrations (`Recording.instrument`).
        throw: Raise an error if the result cannot be used.

    Returns:
        The driver, with its verdict.

    Raises:
        ValueError: There is no calibration, a calibration has no `r_load`, one is given twice,
            their lengths, rates or instruments differ, the order is below 2, or the method has no
            likelihood that could choose the order, or nothing that the tolerances could enter.
        IdentificationError: The result cannot be used and `throw` is set.
    """
    options = Options.of(order=order, method=method, plausible=plausible, instrument=instrument)
    single = isinstance(calibrations, Recording)
    records = recordings("calibrations", [calibrations] if single else calibrations)
    driver = calibrated(records, options, throw)
    if instrument is not None:  # a file of this driver states it
        records = [one.replace(instrument=instrument.text() or None) for one in records]
    object.__setattr__(driver, "recordings", tuple(records))  # the module is frozen
    return driver


def calibrated(records: Sequence[Recording], options: Options, throw: bool) -> Driver:
    """`identify_driver` with arguments that are checked."""
    if not records:
        raise ValueError(
            "no calibration given; a driver needs at least one record with a known r_load"
        )
    resistances: list[float] = []
    for record in records:
        if record.r_load is None:
            raise ValueError(
                f"recording {record.path!r} has no r_load; a calibration needs its resistor [ohm]. "
                "The calibrations of a study are study.calibrations"
            )
        resistances.append(record.r_load)
    check_alike("calibrations", records)
    check_distinct("calibrations", records)
    seen = [Inspected.of(record) for record in records]
    for one in seen:
        _refused(one, preflight(one))
    rough = [_rough_impedance(*one) for one in zip(seen, resistances, strict=True)]
    if max(rough) > ROUGHLY * min(rough):
        shown = ", ".join(
            f"{one.recording.path!r} {rounded(z / 1e3, 3)} kΩ"
            for one, z in zip(seen, rough, strict=True)
        )
        text = f"calibrations show impedances of about {shown}: resistors_disagree. "
        raise IdentificationError(text + message("resistors_disagree"), None)
    estimator = options.estimator or MAXIMUM_LIKELIHOOD
    for one in seen:
        _refused(one, unfit(estimator, one))
    check_order(options.order, estimator)
    instrument = options.instrument
    # What a file states enters no standard errors where there are none.
    if instrument is None and issubclass(estimator.driver, ContinuousDriver):
        instrument = instrument_of(records)
    check_instrument(instrument, estimator)
    arrays = None if instrument is None else instrument.as_arrays()
    if options.order == AUTO:
        driver = _of_chosen_order(seen, estimator, arrays)
    else:
        driver = _driver(seen, options.order, estimator, arrays)
    for one in seen if LOG.isEnabledFor(logging.INFO) else ():
        log_changes(one)
    remarks = [int(of.remarks) for of in (driver, *seen)]
    driver = dataclasses.replace(driver, remarks=np.asarray(np.bitwise_or.reduce(remarks)))
    if isinstance(driver, HarmonicDriver):
        unloaded = np.array([checksum(one) for one in seen])
        driver = dataclasses.replace(driver, unloaded=unloaded)
    periods = repeats(seen)
    at = np.append(changes.bands(periods), 1e3)
    *z_th, at_1_khz = np.asarray(driver.response(jax.device_put(at)))
    driver = changes.driver_judged(
        driver, np.asarray(resistances), periods, np.array(z_th, complex)
    )
    size = abs(at_1_khz)
    if np.isfinite(size) and not options.plausible[0] <= size <= options.plausible[1]:
        driver = dataclasses.replace(driver, result=verdict("implausible"))
    if LOG.isEnabledFor(logging.INFO):
        said = [driver._overview().title]
        if isinstance(driver, ContinuousDriver):
            said += [f"start {int(driver.start)} won", *filter(None, [str(driver.tried)])]
        LOG.info("%s: %s", seen[0].recording.path, "; ".join(said))
    if throw and not driver.usable:
        raise IdentificationError(f"driver: {driver.verdict}. {driver.note}", driver)
    return driver


def _rough_impedance(calibration: Inspected, r_load: float) -> float:
    """Rough |Z_th| [Ω] from a resistor [Ω] and the amplitudes of both records."""
    x, y = (v - v.mean() for v in calibration.aligned)
    return r_load * abs(float(x @ x / (y @ x)) - 1)


def _refused(seen: Inspected, name: str | None) -> None:
    """Raise IdentificationError if there is a verdict that forbids a fit of this calibration."""
    if name is not None:
        text = f"calibration {seen.recording.path!r}: {name}. {explained(seen, name)}"
        raise IdentificationError(text, None)


def _of_chosen_order(
    seen: Sequence[Inspected], estimator: AbstractEstimator, instrument: Instrument | None
) -> Driver:
    """The driver of the order that `next_order` and `best` choose."""
    drivers: dict[int, HarmonicDriver] = {}
    tried: list[TriedOrder] = []
    while (order := next_order(tried)) is not None:
        driver = _driver(seen, order, estimator, instrument)
        drivers[order] = serving(driver, HarmonicDriver, str(estimator))
        tried.append(_tried_order(drivers[order]))
    return dataclasses.replace(drivers[best(tried).order], tried=evidence(tried))


def _tried_order(driver: HarmonicDriver) -> TriedOrder:
    """The evidence for the order of a driver."""
    unknowns = driver.cov.shape[0] + driver.calibration.r_load.size
    terms = 2 * int(np.sum(np.asarray(driver.spectra.selected)))
    return TriedOrder(
        order=driver.order,
        squares=float(driver.chi2) * (terms - unknowns),
        unknowns=unknowns,
        terms=terms,
        missing_pole=float(driver.missing_pole),
        adequate=driver.usable,
    )


def _driver(
    seen: Sequence[Inspected],
    order: int,
    estimator: AbstractEstimator,
    instrument: Instrument | None,
) -> Driver:
    """The driver from calibrations that passed the pre-flight; late ones are aligned again."""
    driver = _aligned(seen, order, estimator, instrument)
    late = np.zeros(len(seen))
    if isinstance(driver, ContinuousDriver):
        late = np.asarray(driver.calibration.delay_samples)
    if not driver.usable and 1 < np.max(np.abs(late)) < np.inf:
        for one, delay in zip(seen, late, strict=True):
            one.lag += round(delay)
        driver = _aligned(seen, order, estimator, instrument)
    return driver


def _aligned(
    seen: Sequence[Inspected],
    order: int,
    estimator: AbstractEstimator,
    instrument: Instrument | None,
) -> Driver:
    """The driver from calibrations that passed the pre-flight, aligned by their lags."""
    r_load = np.array([one.recording.r_load for one in seen], float)
    records = _lanes(seen, estimator)
    driver = _identified(records, r_load, order, estimator, instrument)
    # A driver fits hum on a harmonic by a pole at that frequency, and this pole is then missing
    # elsewhere.
    doubtful = may_hum(driver) or driver.verdict != "successful"
    if driver.inexact:  # its residual is noise, and so is that of hum
        doubtful = bool(int(driver.remarks) & Remark.mains_hum)
    if isinstance(records, Harmonics) and doubtful:
        few = records.without_mains()
        if few is not None:
            driver = better_of(driver, _identified(few, r_load, order, estimator, instrument))
    return driver


def _lanes(seen: Sequence[Inspected], estimator: AbstractEstimator) -> Lane:
    """The data of the calibrations, stacked."""
    kinds = {estimator.lane_of(one) for one in seen}
    kind = kinds.pop() if len(kinds) == 1 else Bins
    if issubclass(kind, Bins):  # the bins of all of them have the same frequencies
        shortest = min(one.aligned[0].size for one in seen)
        return stacked([kind.of_first(one, shortest) for one in seen])
    lanes: list[Any] = [kind.of(one) for one in seen]
    size = min(one.size for one in lanes)  # counted pulse rates may differ by one harmonic
    return stacked([jax.tree.map(lambda of: of[:size] if of.ndim else of, one) for one in lanes])


@in_float64
def with_harmonics(driver: ContinuousDriver, calibrations: Sequence[Recording]) -> HarmonicDriver:
    """A driver of a file of fits, with the harmonics of its calibrations, which no file holds."""
    seen = [Inspected.of(one) for one in calibrations]
    for one in seen:
        _refused(one, preflight(one))
    own = {of.name: getattr(driver, of.name) for of in dataclasses.fields(ContinuousDriver)}
    records = cast(Harmonics, _lanes(seen, named(str(driver.method))))
    if int(driver.remarks) & Remark.mains_hum:
        records = records.without_mains() or records
    spectra = _clear(records)
    return HarmonicDriver(**own, spectra=spectra, missing_pole=jax.device_put(np.nan))


def _clear(records: Harmonics) -> Spectrum:
    """The harmonics that a driver is refined with."""
    spectrum = jax.tree.map(np.asarray, records.fields)
    return jax.device_put(above_noise(spectrum, banded(spectrum)))


def _identified(
    lanes: AlignedSamples | Harmonics,
    r_load: Float[np.ndarray, " record"],
    order: int,
    estimator: AbstractEstimator,
    instrument: Instrument | None,
) -> Driver:
    records = lanes.measure() if isinstance(lanes, AlignedSamples) else lanes
    return jax.device_put(estimator.fit_driver(records, r_load, order, instrument))
