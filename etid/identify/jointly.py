"""Joint fit of a study: one source impedance; a load and a trigger delay for each trial.

Trials that are fitted one by one share the error of the driver. The spread between the trials does
not show this error. A joint fit determines the driver better than its calibration does. Its
standard errors separate the own error of a trial from the error that all trials share.
"""

import contextlib
import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from tqdm import tqdm

from etid.estimators.element_limits import of_circuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.estimator import serving
from etid.estimators.judgement import STRAINED
from etid.estimators.lanes import AbstractLane, Harmonics, Lags, replaced, stacked, taken, unstacked
from etid.estimators.maximum_likelihood.estimator import (
    CITED,
    NO_OTHER_CIRCUIT,
    NO_OTHER_GAIN,
    description,
    what_is_accepted,
)
from etid.estimators.maximum_likelihood.rows import estimates, loads_of, source_of
from etid.estimators.maximum_likelihood.verdict import judged
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, register_description
from etid.identify.arguments import check_new, require
from etid.identify.fitting import (
    Batch,
    Prepared,
    checksum,
    concluded,
    known_of,
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
from etid.likelihood.fit import Estimate
from etid.likelihood.joint.fit import Delays, Found, start_of
from etid.likelihood.joint.fit import fit as fit_together
from etid.likelihood.joint.loads import Loads
from etid.likelihood.noise import misses
from etid.precision import array_function, in_float64, one_thread, untraced
from etid.recordings.errors import RecordingError
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.recordings.study import Study
from etid.results.driver import HarmonicDriver, Order
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.results.study_fits import PLAUSIBLE, StudyFits
from etid.results.verdicts import USABLE, verdict, verdicts_of
from etid.selection.delays import upper_limit
from etid.signals.harmonics import same_unloaded
from etid.signals.transfer import AnyArray

METHOD = "joint"
NOT_PERIODIC = Refusal(
    "not_periodic",
    "The record or its calibration holds less than two whole pulse periods, or begins in an edge. "
    "A joint fit needs whole periods. Record more of them, or identify the recording alone.",
)
_FOUND = description(
    "joint maximum likelihood",
    "each driver and all recordings made with it were estimated in one fit by",
    "Z_th is common to all, each record has its own trigger delay τ. Where the delays scatter "
    "by less than their errors, the upper limit of their scatter (99.99 %) is the standard "
    "deviation of their prior. Where the current was measured beside V_th, I = X / (Z_L + "
    "Z_th), with a delay of its own, was the second equation for each harmonic. A load with a "
    "measured current alone needs no Z_th and was estimated alone.",
    (NO_OTHER_CIRCUIT, NO_OTHER_GAIN),
)
register_description(
    METHOD,
    dataclasses.replace(
        _FOUND,
        inexact="A recording whose circuit leaves more than noise did not influence the driver "
        "and was fitted alone. "
        + what_is_accepted("the part of the signal that the settings accept"),
        cited=(*_FOUND.cited, *CITED),
    ),
)


class _Start(NamedTuple):
    """A load identified alone; a joint fit starts from it.

    Attributes:
        lane: Its harmonics.
        logs: Logarithms of its elements.
        delays: Delays of its outputs [samples].
        errors: Errors of the instrument that it shows [their standard deviations].
        used: Whether it takes part in the joint fit.
        hum: Whether the recording shows mains hum.
        falls: Whether a resistance that falls with its current explains most of what it misses.
        changed: Whether the recording shows that the driver has changed since its calibration.
        other: Whether the recording shows another circuit or gain.
        inexact: Its fit, if its circuit leaves more than the noise: it takes no part, for weights
            of the noise would trust it too far.
    """

    lane: Harmonics
    logs: Float[np.ndarray, " element"]
    delays: Float[np.ndarray, " output"]
    errors: Float[np.ndarray, " error"]
    used: bool
    hum: bool
    falls: bool
    changed: bool
    other: bool
    inexact: Fit | None


def _narrower(
    groups: Sequence[Loads],
    fits: Sequence[Fit],
    delays: Sequence[Delays],
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
    good = np.concatenate([fit.usable for fit in fits])
    if good.sum() < 2 or any(loads.load.gains.sample_rate != rate for loads in groups):
        return None
    late, own, slope = (
        np.concatenate([getattr(of, name) for of in delays])[good]
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

    def __init__(self, options: Options, like: Prepared) -> None:
        self.circuit, self.bounds = options.circuit, of_circuit(options.bounds, options.circuit)
        self.prior = ElementPrior.of(options.known, options.circuit)
        self.estimator, self.accept = like.estimator, options.accept
        self.driver = untraced(serving(like.driver, HarmonicDriver, str(like.estimator)))
        self.known = known_of(like.lane, self.driver, like.shared, MAXIMUM_LIKELIHOOD)
        self.rows: list[int] = []
        self.starts: list[_Start] = []
        self.remarks: list[int] = []
        self.unloaded: list[int] = []
        self.repeats: list[Repeats | None] = []

    def add(self, batch: Batch) -> None:
        """Identify the loads of a batch one by one."""
        starts = refitted(batch.lanes, batch.seen, self._alone, _late_by, _may_hum, _better)
        for start, seen in zip(starts, batch.seen, strict=True):
            remarks = remarks_on(seen, self.estimator)
            remarks |= Remark.mains_hum if start.hum else 0
            self.remarks.append(remarks | (Remark.falls_with_current if start.falls else 0))
        self.rows += batch.rows
        self.starts += starts
        self.unloaded += map(checksum, batch.seen)
        self.repeats += repeats(batch.seen)

    @one_thread()
    @array_function
    def _alone(self, lanes: Sequence[AbstractLane], inexact: bool) -> list[_Start]:
        every, of, parts = cast("Sequence[Harmonics]", lanes), source_of(self.known).errors, []
        of_all = self.known, self.circuit, self.prior, inexact
        for found, changed in estimates(every, *of_all):
            errors = np.zeros((len(changed), 0))
            if self.driver.instrument is not None and of is not None:
                errors = of.at + found.z @ of.by_z
            good = found.settled & np.isfinite(found.chi2) & ~misses(found.chi2, found.rrse)
            used = good & ~changed & ~found.other & ~(found.strain > STRAINED) & ~found.approximate
            own: list[Fit | None] = [None] * len(changed)
            if found.approximate.any():
                fits = self._judged(found, changed)
                for row in np.flatnonzero(found.approximate).tolist():
                    own[row] = taken(fits, row)
            signs = used, found.hum, found.falls, changed, found.other, own
            parts.append(zip(found.logs, found.delays, errors, *signs, strict=True))
        each = itertools.chain.from_iterable(parts)
        return [_Start(lane, *numbers) for lane, numbers in zip(every, each, strict=True)]

    def loads(self) -> Loads:
        """The recordings for a joint fit."""
        lanes = [start.lane for start in self.starts]
        load = loads_of(lanes, source_of(self.known), self.circuit, self.prior, None)
        of, same = self.known.records, None
        if of is not None and of.x.shape[-1] == load.records.x.shape[-1]:
            same = np.asarray(same_unloaded(load.records.x[:, None], of.x))
        several = [key for key, count in Counter(self.unloaded).items() if count > 1]
        number = {key: i for i, key in enumerate(several)}
        unloaded = np.array([number.get(key, -1) for key in self.unloaded])
        used = np.array([start.used for start in self.starts])
        return Loads(load, same if np.any(same) else None, used, unloaded)

    def judged(self, found: Estimate) -> Fit:
        """Fits with their verdicts."""
        fits = self._judged(found, np.zeros(len(self.starts), bool))  # these take no part
        alone = {row: one.inexact for row, one in enumerate(self.starts) if one.inexact is not None}
        return replaced(fits, list(alone), stacked(list(alone.values()))) if alone else fits

    def _judged(self, found: Estimate, changed: Bool[np.ndarray, " recording"]) -> Fit:
        of = self.driver.result, METHOD, self.prior, self.bounds, self.accept
        return judged(found, self.circuit, changed, *of)

    def concluded(self, fits: Fit, driver: HarmonicDriver, narrow: AnyArray) -> Fit:
        """Fits with remarks, with the verdicts of recordings that take no part, and with changes.

        These verdicts are `misfit` for another circuit or gain, and `inconsistent` where the driver
        has changed. `narrow` says where a narrower prior of the delays was used.
        """
        changed, other = np.array([(one.changed, one.other) for one in self.starts]).T
        names = np.where(other & fits.usable, "misfit", fits.verdict)
        names = np.where(changed & np.isin(names, (*USABLE, "misfit")), "inconsistent", names)
        fits = dataclasses.replace(fits, result=verdicts_of(names))
        remarks = np.where(narrow, np.array(self.remarks) | Remark.small_delays, self.remarks)
        return concluded(fits, driver, remarks.tolist(), self.repeats)


def _late_by(lanes: Sequence[AbstractLane], starts: Sequence[_Start]) -> dict[int, Lags]:
    del lanes
    # A fit allows for one sample.
    late = {row: Lags.of(*start.delays.tolist(), left=1.0) for row, start in enumerate(starts)}
    return {row: by for row, by in late.items() if any(by)}


def _may_hum(starts: Sequence[_Start]) -> list[int]:
    return [row for row, one in enumerate(starts) if one.hum or not one.used]


def _better(first: _Start, second: _Start) -> _Start:
    if second.used and second.hum:
        return second._replace(changed=first.changed)
    return first._replace(hum=False)


@in_float64
def identify_jointly(
    study: Study,
    *,
    order: Order = 5,
    circuit: Circuit = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    accept: float | None = None,
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
        accept: As in `identify_skin`. A recording whose circuit leaves more than noise does not
            influence the driver, and is fitted alone.
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
    of_fit = FitOptions(fixed=fixed, prior=prior, bounds=bounds, accept=accept)
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
            found = batch.fitted(only.circuits).only
            keep(batch.rows, dataclasses.replace(found, method=METHOD), batch.like.driver)
        elif batch.like.lane.periodic:
            for row, seen in zip(batch.rows, batch.seen, strict=True):
                check_new(f"study[{paths[row]!r}]", seen.recording, first)
            lengths = groups.setdefault(drivers.of(batch.seen[0].recording), {})
            key = _key(batch.like)
            lengths[key] = lengths.get(key) or _Group(only, batch.like)
            lengths[key].add(batch)
        else:
            refused |= dict.fromkeys(batch.rows, NOT_PERIODIC)
    for row, refusal in refused.items():
        fits[row], notes[row] = failed_fit(refusal.name, only, METHOD), refusal.note
    for names, lengths in tqdm(groups.items(), unit="driver", disable=not progress):
        together = list(lengths.values())
        found, drivers.found[names] = _fit_together(together)
        for group, fitted in zip(together, found, strict=True):
            keep(group.rows, fitted, drivers.found[names])
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


@one_thread()
@array_function
def _fit_together(groups: Sequence[_Group]) -> tuple[list[Fit], HarmonicDriver]:
    """The fits of all recordings of one driver, by group, and the driver."""
    driver, loads = groups[0].driver, [group.loads() for group in groups]
    told, starts = driver.instrument, [one for group in groups for one in group.starts]
    # With all errors of the instrument that a budget shows.
    of = dataclasses.replace(Calibrations.of(driver), instrument=told and told.narrow())
    used = [start.errors for start in starts if start.used]
    errors = np.mean(used, axis=0) if used else np.zeros(of.tolerances.size)
    owns = [np.array([np.concatenate([one.logs, one.delays]) for one in group.starts])
            for group in groups]  # fmt: skip
    found = fit_together(of, loads, start_of(of, errors), owns, told)
    fits = [group.judged(one) for group, one in zip(groups, found.estimates, strict=True)]
    better = _better_driver(driver, of, found)
    small = [np.zeros(len(group.rows), bool) for group in groups]
    width = _narrower(loads, fits, found.delays, found.cov, float(of.rate), float(of.delay_width))
    if width is not None and better.usable:
        of = dataclasses.replace(of, delay_width=np.asarray(width))
        found = fit_together(of, loads, found.common, found.owns, told)
        better = _better_driver(driver, of, found)
        for number, (group, one) in enumerate(zip(groups, found.estimates, strict=True)):
            first, second = fits[number], group.judged(one)
            where = first.usable & second.usable
            small[number], fits[number] = where, replaced(first, where, taken(second, where))
    if any(one.changed for one in starts) and not any(one.used for one in starts):
        better = dataclasses.replace(better, result=verdict("inconsistent"))
    each = zip(groups, fits, small, strict=True)
    return [group.concluded(found, better, narrow) for group, found, narrow in each], better


def _better_driver(driver: HarmonicDriver, of: Calibrations, found: Found) -> HarmonicDriver:
    """The driver that all recordings together determine."""
    kept, result = of.parameters(found.common).size, driver.result
    if found.strain > STRAINED:
        result = verdict("inconsistent")
    return dataclasses.replace(
        driver,
        source=of.source_of(found.common),
        cov=found.cov[:kept, :kept],
        calibration=dataclasses.replace(driver.calibration, delay_samples=of.delays(found.common)),
        result=result,
        method=METHOD,
    )
