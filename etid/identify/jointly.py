"""Joint fit of a study: one source impedance; a load and a trigger delay for each trial.

Trials that are fitted one by one share the error of the driver. The spread between the trials does
not show this error. A joint fit determines the driver better than its calibration does. Its
standard errors separate the own error of a trial from the error that all trials share.
"""

import contextlib
import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

from etid.estimators import judgement
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.joint.errors import Delay, Found
from etid.estimators.joint.fit import fit_alone, fit_together
from etid.estimators.joint.terms import Joint, Loads
from etid.estimators.lanes import (
    AbstractLane,
    Harmonics,
    HarmonicsWithCurrent,
    Lags,
    replaced,
    stacked,
    taken,
    unstacked,
)
from etid.estimators.maximum_likelihood import given_driver
from etid.estimators.maximum_likelihood.estimator import description
from etid.estimators.registry import register_description
from etid.estimators.score_tests.other_circuit import NO_OTHER_CIRCUIT, NO_OTHER_GAIN
from etid.estimators.score_tests.unloaded import shape_of
from etid.identify.arguments import check_new, require
from etid.identify.fitting import (
    Batch,
    Prepared,
    checksum,
    concluded,
    each,
    filled,
    notes_of,
    refitted,
    remarks_on,
)
from etid.identify.options import (
    Circuit,
    FitOptions,
    Interval,
    Options,
    candidates_of,
    instrument_of,
)
from etid.identify.planning import Refusal, batches, failed_fit
from etid.identify.study import Drivers, common_first, fields_of, table
from etid.likelihood.calibrations import Calibrations
from etid.numpy_tier.tiers import program, worth_compiling
from etid.precision import in_float64
from etid.recordings.errors import RecordingError
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.recordings.study import Study
from etid.results.driver import HarmonicDriver, Order
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.instrument import LATER, Effects, Instrument
from etid.results.study_fits import PLAUSIBLE, StudyFits
from etid.results.verdicts import RESULTS, verdict, verdicts_of
from etid.selection.delays import upper_limit

METHOD = "joint"
NOT_PERIODIC = Refusal(
    "not_periodic",
    "The record or its calibration holds less than two whole pulse periods, or begins in an edge. "
    "A joint fit needs whole periods. Record more of them, or identify the recording alone.",
)
register_description(
    METHOD,
    description(
        "joint maximum likelihood",
        "each driver and all recordings made with it were estimated in one fit by",
        "Z_th is common to all, each record has its own trigger delay τ. Where the delays scatter "
        "by less than their errors, the upper limit of their scatter (99.99 %) is the standard "
        "deviation of their prior. Where the current was measured beside V_th, I = X / (Z_L + "
        "Z_th), with a delay of its own, was the second equation for each harmonic. A load with a "
        "measured current alone needs no Z_th and was estimated alone.",
        (NO_OTHER_CIRCUIT, NO_OTHER_GAIN),
    ),
)


class _Start(NamedTuple):
    """Loads identified one by one (`fit_alone`); a joint fit starts from them.

    Attributes:
        loads: The loads.
        hum: Whether each recording shows mains hum.
        changed: Whether each recording shows that the driver has changed since its calibration.
        other: Whether each recording shows another circuit or gain.
    """

    loads: Loads
    hum: Bool[Array | np.ndarray, "*lane"]
    changed: Bool[Array | np.ndarray, "*lane"]
    other: Bool[Array | np.ndarray, "*lane"]


def _alone(lanes: Any, count: Int[Array, ""], model: Joint, driver: HarmonicDriver) -> _Start:
    frequency = jnp.asarray(lanes.frequency)[0]
    known = shape_of(driver, frequency)
    given = uncertain = given_driver.given(driver, frequency, model.shared)
    if not isinstance(lanes, HarmonicsWithCurrent) and driver.instrument is None:
        given = model.around(model.calibrations.start(), frequency, slopes=False)

    def one(lane: Harmonics) -> _Start:
        spectrum, sample_rate = lane.spectrum, jnp.asarray(lane.sample_rate)
        starts = given.starts(spectrum, sample_rate, model.circuit)
        current = None
        if isinstance(lane, HarmonicsWithCurrent):
            current = jnp.asarray(lane.i), jnp.asarray(lane.variance_i)
        found = fit_alone(model, given, uncertain, spectrum, sample_rate, starts, current)
        settled = found.result == optx.RESULTS.successful
        good = settled & jnp.isfinite(found.chi2) & ~judgement.misses(found.chi2, found.rrse)
        changed = jnp.array(False) if known is None else known.differs(spectrum)
        used = good & ~changed & ~found.other
        of = found.own, found.errors
        loads = Loads(spectrum, sample_rate, *of, used, jnp.array(-1), current)
        return _Start(loads, found.hum, changed, found.other)

    return each(one, lanes, count)


def _together(
    model: Joint, groups: list[Loads], several: tuple[int, ...], driver: HarmonicDriver
) -> tuple[list[Fit], HarmonicDriver, list[Delay], Float[Array, "common common"]]:
    common, cov, found = fit_together(model, groups, several)

    def fit(found: Found) -> Fit:
        of_model = METHOD, model.bounds, model.prior
        estimate, told, of = found.estimate, driver.instrument, model.calibrations
        if told is not None:
            # The search has the errors that nobody stated with a size that no recording changes.
            sizes = told.complete().deviations(of.calibration.r_load.size) / of.tolerances
            moved = found.by_error.T * sizes[:, None]
            later = jnp.full((len(LATER), moved.shape[-1]), jnp.nan)  # nothing changes between them
            effects = Effects.of_errors(moved, later, told.budgeted())
            estimate = dataclasses.replace(estimate, by_tolerance=effects)
        fit = judgement.judged(estimate, model.circuit, driver.result, *of_model)
        fit = judgement.unless(fit, found.scale, RESULTS.inconsistent)
        return judgement.unless(fit, found.other, RESULTS.misfit)

    kept = model.calibrations.parameters(common).size
    better = eqx.tree_at(
        lambda d: (d.source, d.cov, d.calibration.delay_samples, d.result),
        driver,
        (
            model.calibrations.source_of(common),
            cov[:kept, :kept],
            model.calibrations.delays(common),
            RESULTS.where(
                found[0].estimate.strain[0] > judgement.STRAINED,
                RESULTS.inconsistent,
                driver.result,
            ),
        ),
    )
    fits = [jax.vmap(fit)(of_group) for of_group in found]
    return fits, better, [of.delay for of in found], cov


# By whether they are compiled.
_ALONE = {batch: program(_alone, batch=batch) for batch in (False, True)}
_TOGETHER = {batch: program(_together, batch=batch) for batch in (False, True)}


def _narrower(
    groups: Sequence[Loads],
    fits: Sequence[Fit],
    delays: Sequence[Delay],
    cov: Float[np.ndarray, "common common"],
    rate: float,
    widest: float,
) -> float | None:
    """Width of the prior of every delay [samples] that the recordings support, if it pays.

    Args:
        groups: The recordings.
        fits: Their fits.
        delays: Their delays.
        cov: Covariance of the common parameters.
        rate: Sampling rate of the calibrations [Hz].
        widest: Width of the prior in these fits [samples].
    """
    good = np.concatenate([fit.verdict == "successful" for fit in fits])
    if good.sum() < 2 or any(np.any(np.asarray(loads.sample_rate) != rate) for loads in groups):
        return None
    late, own, slope = (
        np.concatenate([np.asarray(getattr(of, name)) for of in delays])[good]
        for name in ("samples", "own_variance", "slope")
    )
    width = upper_limit(late, own, slope, cov, widest)
    errors = np.sqrt(own + np.einsum("ij,jk,ik->i", slope, cov, slope))
    return width if width < np.median(errors) else None


def _key(one: Prepared) -> tuple[Any, ...]:
    """Equal for recordings of one group: their harmonics are the same."""
    return one.seen.v_th.size, *one.key


class _Group:
    """Recordings of one driver with the same number of harmonics, fitted by one estimator."""

    def __init__(self, options: Options, like: Prepared, total: int) -> None:
        self.total = total  # recordings of the study
        self.estimator = like.estimator
        self.driver = serving(like.driver, HarmonicDriver, str(like.estimator))
        self.shared = like.shared
        self.model = _model(options, self.driver, like.shared)
        self.rows: list[int] = []
        self.starts: list[_Start] = []
        self.remarks: list[int] = []
        self.unloaded: list[int] = []
        self.repeats: list[Repeats | None] = []

    def add(self, batch: Batch) -> None:
        """Identify the loads of a batch one by one."""
        starts = refitted(batch.lanes, batch.seen, self._alone, _late_by, _may_hum, _better)
        for start, seen in zip(starts, batch.seen, strict=True):
            hum = Remark.mains_hum if start.hum else 0
            self.remarks.append(remarks_on(seen, self.estimator) | hum)
        self.rows += batch.rows
        self.starts += starts
        self.unloaded += map(checksum, batch.seen)
        self.repeats += repeats(batch.seen)

    def _alone(self, lanes: Sequence[AbstractLane]) -> list[_Start]:
        fit = _ALONE[worth_compiling(self.total)]
        several = filled(lanes), jax.device_put(len(lanes))
        found = jax.device_get(fit(*several, self.model, self.driver))
        return unstacked(found)[: len(lanes)]

    def several(self) -> list[int]:
        """Checksums of the unloaded records that several recordings share."""
        return [key for key, count in Counter(self.unloaded).items() if count > 1]

    def loads(self) -> Loads:
        loads = stacked([start.loads for start in self.starts])
        number = {key: i for i, key in enumerate(self.several())}
        unloaded = np.array([number.get(key, -1) for key in self.unloaded])
        return eqx.tree_at(lambda of: of.unloaded, loads, unloaded)


def _late_by(lanes: Sequence[AbstractLane], starts: Sequence[_Start]) -> dict[int, Lags]:
    del lanes
    each = [map(float, start.loads.own.delays()) for start in starts]
    # A fit allows for one sample.
    late = {row: Lags.of(*of, left=1.0) for row, of in enumerate(each)}
    return {row: by for row, by in late.items() if any(by)}


def _may_hum(starts: Sequence[_Start]) -> list[int]:
    return [row for row, one in enumerate(starts) if one.hum or not one.loads.used]


def _better(first: _Start, second: _Start) -> _Start:
    if second.loads.used and second.hum:
        return second._replace(changed=first.changed)
    return first._replace(hum=np.asarray(False))


@in_float64
def identify_jointly(
    study: Study,
    *,
    order: Order = 5,
    circuit: Circuit = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    instrument: Instrument | None = None,
    plausible: tuple[float, float] = PLAUSIBLE,
    progress: bool = False,
) -> StudyFits:
    """Identify every driver of a study together with all recordings made with it.

    The method is maximum likelihood, for records of several whole pulse periods. Its cost is linear
    in the number of records. A recording that this kind of circuit does not explain does not
    influence the driver. If the trigger delays of all recordings scatter by less than their errors,
    a second fit limits each delay by this scatter; the fits then have the remark `small_delays`.
    Recordings of a measured current share no driver; each is fitted alone. `identify_amplitudes`
    fits one load to several recordings. A current that a recording measured beside `v_th` is used
    too, as in `identify_skin`.

    Args:
        study: Calibrations and loaded recordings.
        order: Number of poles of Z_th.
        circuit: Structure of the loads and its typical values; `SkinRC` if not given. With
            `"auto"` it is chosen as in `identify_skins`, from fits of single recordings.
        fixed: As in `identify_skin`, for all recordings.
        prior: As in `identify_skin`, for all recordings.
        bounds: As in `identify_skin`, for all recordings.
        instrument: Tolerances of the instrument, as in `identify_driver`; errors of one driver are
            common to its calibrations and all its recordings. With `etid.Instrument()`, which has
            none, `fit.budget` shows what they would add.
        plausible: As in `identify_driver`.
        progress: Show a progress bar.

    Returns:
        One fit for each recording, and the drivers that all records together determine. In the
        fits, `shared_cov` is the error that all recordings with one driver share: the error of
        Z_th, and the tolerances of the instrument. The rest of `cov` is the own error of each
        recording.

    Raises:
        ValueError: The study has no loaded recording.
        RecordingError: Two recordings with a driver have the same samples of `v_out`.
    """
    require("study", study, Study)
    of_fit = FitOptions(fixed=fixed, prior=prior, bounds=bounds)
    options = Options.of(
        candidates_of(circuit), order=order, instrument=instrument, plausible=plausible, **of_fit
    )
    drivers = Drivers(study, options)
    _check_steady(study, instrument)
    paths = drivers.paths
    options = common_first(drivers, options)
    only = dataclasses.replace(options, circuits=(options.circuit,))
    fits: dict[int, Fit] = {}
    notes = [""] * len(paths)
    refused: dict[int, Refusal] = {}

    def keep(rows: Sequence[int], found: Fit, feed: AbstractFeed) -> None:
        for row, fit, text in zip(rows, unstacked(found), notes_of(found, feed), strict=True):
            fits[row], notes[row] = fit, text

    groups: dict[tuple[str, ...], dict[Any, _Group]] = {}
    first: dict[bytes, str] = {}
    for batch in batches(len(paths), drivers.loader(paths), only, progress, _key):
        if not isinstance(batch, Batch):
            row, refusal = batch
            refused[row] = NOT_PERIODIC if refusal.name == NOT_PERIODIC.name else refusal
        elif isinstance(batch.like.driver, MeasuredCurrent):
            found = batch.fitted(only.circuits, len(paths)).only
            keep(batch.rows, dataclasses.replace(found, method=METHOD), batch.like.driver)
        elif batch.like.estimator.lane.periodic:
            for row, seen in zip(batch.rows, batch.seen, strict=True):
                check_new(f"study[{paths[row]!r}]", seen.recording, first)
            lengths = groups.setdefault(drivers.of(batch.seen[0].recording), {})
            key = _key(batch.like)
            lengths[key] = lengths.get(key) or _Group(only, batch.like, len(paths))
            lengths[key].add(batch)
        else:
            refused |= dict.fromkeys(batch.rows, NOT_PERIODIC)
    for row, refusal in refused.items():
        fits[row], notes[row] = failed_fit(refusal.name, only, METHOD), refusal.note
    for names, lengths in tqdm(groups.items(), unit="driver", disable=not progress):
        together = list(lengths.values())
        found, drivers.found[names] = _fit_together(only, together)
        for group, judged in zip(together, found, strict=True):
            keep(group.rows, judged, drivers.found[names])
    ordered = stacked([fits[row] for row in range(len(paths))])
    outcome = table([fields_of(study, path) for path in paths], ordered, notes)
    settings = options.settings(study, len(paths), METHOD)
    return StudyFits(outcome, drivers.found, drivers.failures, settings)


def _check_steady(study: Study, instrument: Instrument | None) -> None:
    """Raise ValueError if an instrument says that a driver drifts."""
    told = [instrument]
    for path in study.named.calibrations if instrument is None else ():
        with contextlib.suppress(RecordingError):  # costs the recordings of that driver alone
            told.append(instrument_of([study.named.metadata(path)]))
    if any("drift" in one.stored() for one in told if one is not None):
        raise ValueError(
            "a joint fit identifies each driver together with all its recordings, so that it has "
            "no drift between them; use identify_study, or pass an instrument without drift"
        )


def _fit_together(options: Options, groups: Sequence[_Group]) -> tuple[list[Fit], HarmonicDriver]:
    """The fits of all recordings of one driver, by group, and the driver."""
    driver, loads = groups[0].driver, [group.loads() for group in groups]
    several = tuple(len(group.several()) for group in groups)
    model = _model(options, driver, any(group.shared for group in groups))
    together = _TOGETHER[worth_compiling(sum(of.used.size for of in loads))]
    found, better, delays, cov = together(model, loads, several, driver)
    found, delays, cov = jax.device_get((found, delays, cov))
    small = [np.zeros(len(group.rows), bool) for group in groups]
    widest = float(np.asarray(model.calibrations.delay_width))
    width = _narrower(loads, found, delays, cov, float(driver.sample_rate), widest)
    if width is not None and better.verdict == "successful":
        # A start with errors of the instrument is made from the calibrations alone.
        start = better if driver.instrument is None else driver
        again = dataclasses.replace(_calibrations(start), delay_width=jax.device_put(width))
        model = dataclasses.replace(model, calibrations=again)
        others, better, *_ = together(model, loads, several, better)
        others = jax.device_get(others)
        for number, (first, second) in enumerate(zip(found, others, strict=True)):
            where = (first.verdict == "successful") & (second.verdict == "successful")
            small[number], found[number] = where, replaced(first, where, taken(second, where))
    # A compiled function returns JAX arrays. The checksums must stay a numpy array.
    better = dataclasses.replace(better, method=METHOD, unloaded=driver.unloaded)
    changed = any(start.changed for group in groups for start in group.starts)
    if changed and not any(np.any(of.used) for of in loads):
        better = dataclasses.replace(better, result=verdict("inconsistent"))
    judged = []
    for group, fit, narrow in zip(groups, found, small, strict=True):
        remarks = np.where(narrow, np.array(group.remarks) | Remark.small_delays, group.remarks)
        alone = _alone_judged(fit, group.starts)
        judged.append(concluded(alone, better, remarks.tolist(), group.repeats))
    return judged, better


def _alone_judged(fits: Fit, starts: Sequence[_Start]) -> Fit:
    """Fits without remarks on hum, with the verdicts of recordings that take no part.

    That is `misfit` for another circuit or gain, and `inconsistent` where the driver has changed.
    """
    changed, other = np.array([(bool(one.changed), bool(one.other)) for one in starts]).T
    names = np.where(other & (fits.verdict == "successful"), "misfit", fits.verdict)
    names = np.where(changed & np.isin(names, ("successful", "misfit")), "inconsistent", names)
    result = verdicts_of(names)
    # The fit of each recording alone decides whether hum is left out.
    return dataclasses.replace(fits, remarks=fits.remarks & ~int(Remark.mains_hum), result=result)


def _model(options: Options, driver: HarmonicDriver, shared: bool) -> Joint:
    prior = ElementPrior.of(options.known, options.circuit)
    return Joint(options.circuit, _calibrations(driver), shared, prior, options.bounds)


def _calibrations(driver: HarmonicDriver) -> Calibrations:
    """The calibrations, with all errors of the instrument that a budget shows."""
    told = driver.instrument
    return dataclasses.replace(Calibrations.of(driver), instrument=told and told.narrow())
