"""A whole study in one fit: one source impedance, and every trial its own load and trigger delay.

Fitted one by one, trials share the error of the driver, and no spread between them shows it. Fitted
together they determine the driver better than its calibration does, and the standard errors of the
result tell what is a trial's own from what all trials have in common.
"""

import dataclasses
import functools
from collections import Counter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int
from tqdm import tqdm

from etid.circuits.circuit import AbstractCircuit
from etid.estimators import judgement, refinement
from etid.estimators.joint import fit as shared_driver
from etid.estimators.joint.terms import Loads
from etid.estimators.maximum_likelihood.driver import Calibrations, Joint, fit_load
from etid.estimators.registry import HARMONIC, serving
from etid.estimators.score_tests.unloaded import shape_of
from etid.identify import changes
from etid.identify.arguments import circuit_of, order_of, require
from etid.identify.compiled import stored_jit
from etid.identify.lanes import checksum, is_shared, lane, realigned, remarked, without_mains
from etid.identify.many import (
    LANES,
    Drivers,
    Refusal,
    each,
    filled,
    planned,
    table,
    to_identify,
    unstacked,
)
from etid.identify.one import failed_fit, note
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.recordings.study import Study
from etid.results.driver import HarmonicDriver
from etid.results.fits import Fit
from etid.results.provenance import Settings
from etid.results.study_fits import StudyFits
from etid.results.verdicts import RESULTS, verdict
from etid.signals.harmonics import Spectrum
from etid.signals.precision import require_float64

METHOD = "joint"
SINGLE = (
    "The record or its calibration does not hold several whole pulse periods, which a joint fit "
    "needs. Record more, or identify it on its own."
)


@stored_jit
def _alone(
    lanes: Any, count: Int[Array, ""], model: Joint, driver: HarmonicDriver
) -> tuple[Loads, Bool[Array, " load"], Bool[Array, " load"]]:
    """Loads identified one by one with Z_th as it is, where a joint fit may start.

    And whether each shows mains hum, and that the driver has changed since its calibration.
    """
    known = shape_of(driver, lanes[0][0])

    def one(lane):
        *fields, sample_rate = lane
        spectrum = Spectrum(*fields)
        z_th = model.calibrations.source.response(spectrum.frequency)
        starts = refinement.harmonic_starts(spectrum, sample_rate, z_th, model.circuit)
        own, result, chi2, error, hum = fit_load(model, spectrum, sample_rate, starts)
        settled = RESULTS.promote(result) == RESULTS.successful
        good = settled & jnp.isfinite(chi2) & ~judgement.misses(chi2, error)
        changed = jnp.array(False) if known is None else known.differs(spectrum)
        return Loads(spectrum, sample_rate, own, good & ~changed, jnp.array(-1)), hum, changed

    return each(one, lanes, count)


@stored_jit
def _together(
    model: Joint,
    groups: list[Loads],
    several: tuple[int, ...],
    driver: HarmonicDriver,
    tolerance: Array,
) -> tuple[list[Fit], HarmonicDriver]:
    common, cov, found = shared_driver.fit(model, groups, several)
    # All impedances are measured in units of the known resistor.
    power, _ = model.circuit.scaling()
    scale = tolerance**2 * jnp.outer(power, power)

    def fit(found):
        estimate, other = found
        with_scale = dataclasses.replace(
            estimate, cov=estimate.cov + scale, shared_cov=estimate.shared_cov + scale
        )
        fit = judgement.judged(with_scale, model.circuit, driver.result, METHOD)
        return judgement.unless(fit, other, RESULTS.misfit)

    of_driver = model.calibrations.named(common)
    kept = of_driver.source.size
    better = eqx.tree_at(
        lambda d: (d.source, d.cov, d.calibration.delay_samples, d.result),
        driver,
        (
            model.calibrations.z_th(common),
            cov[:kept, :kept],
            of_driver.delay_samples,
            RESULTS.where(
                found[0][0].strain[0] > judgement.STRAINED, RESULTS.inconsistent, driver.result
            ),
        ),
    )
    return [jax.vmap(fit)(of_group) for of_group in found], better


class _Waiting:
    """Recordings with equally many harmonics and one driver."""

    def __init__(self, model: Joint, driver: HarmonicDriver):
        self.model = model
        self.driver = driver
        self.rows: list[int] = []
        self.lanes: list[tuple[np.ndarray, ...]] = []
        self.chunks: list[Loads] = []
        self.remarks: list[int] = []
        self.changed: list[bool] = []  # since the calibration of the driver
        self.unloaded: list[int] = []
        self.repeats: list[Repeats | None] = []
        self.seen: list[Inspected] = []  # those of `lanes`

    def add(self, row: int, seen: Inspected) -> None:
        self.rows.append(row)
        self.unloaded.append(checksum(seen))
        self.seen.append(seen)
        self.lanes.append(lane(seen, "maximum_likelihood"))
        self.remarks.append(int(seen.remarks))
        if len(self.lanes) == LANES:
            self.run()

    def run(self) -> None:
        if not self.lanes:
            return
        first = len(self.rows) - len(self.lanes)
        loads, hum, changed = self._alone(self.lanes)
        late = loads.own.delay_samples
        late = np.where(np.abs(late) > 1, np.round(late), 0)  # more than a fit allows for
        if np.any(late) and np.isfinite(late).all():
            for number, delay in enumerate(late.astype(int)):
                one = self.lanes[number]
                self.lanes[number] = realigned(one, "maximum_likelihood", int(delay))
                self.remarks[first + number] |= Remark.aligned if delay else 0
            loads, hum, changed = self._alone(self.lanes)
        again = {}
        for number, one in enumerate(self.lanes):
            few = without_mains(one, "maximum_likelihood")
            if few is not None and (hum[number] or not loads.used[number]):
                again[number] = few
        if again:
            others, seen, _ = self._alone(list(again.values()))
            for row, number in enumerate(again):
                if others.used[row] and seen[row]:
                    self.remarks[first + number] |= Remark.mains_hum
                    for leaf, other in zip(*map(jax.tree.leaves, (loads, others)), strict=True):
                        leaf[number] = other[row]
        self.chunks.append(loads)
        self.changed += changed.tolist()
        self.repeats += repeats(self.seen)
        self.lanes, self.seen = [], []

    def _alone(self, lanes: list[tuple[np.ndarray, ...]]) -> tuple[Loads, np.ndarray, np.ndarray]:
        count = len(lanes)
        of = self.model, self.driver
        found = jax.device_get(_alone(filled(lanes), jnp.asarray(count), *of))
        return jax.tree.map(lambda leaf: leaf[:count].copy(), found)

    def several(self) -> list[int]:
        """Checksums of the unloaded records that several recordings have."""
        return [key for key, count in Counter(self.unloaded).items() if count > 1]

    def loads(self) -> Loads:
        self.run()
        loads = jax.tree.map(lambda *parts: np.concatenate(parts), *self.chunks)
        number = {key: i for i, key in enumerate(self.several())}
        unloaded = np.array([number.get(key, -1) for key in self.unloaded])
        return eqx.tree_at(lambda of: of.unloaded, loads, unloaded)


def identify_jointly(
    study: Study,
    *,
    order: int = 5,
    circuit: AbstractCircuit | None = None,
    r_load_tolerance: float = 0.0,
    progress: bool = False,
) -> StudyFits:
    """Identify every driver of a study together with all recordings made with it.

    By maximum likelihood, for records of several whole pulse periods; its cost is linear in their
    number. A recording that no circuit of this kind explains does not take part in the driver.

    Args:
        study: Calibrations and loaded recordings.
        order: Number of poles of Z_th.
        circuit: Structure of the loads and its typical values; `SkinRC` if not given.
        r_load_tolerance: Relative standard deviation of the known resistors, which no record can
            tell; it passes 1:1 into every resistance and, inversely, into every capacitance.
        progress: Show a progress bar.

    Returns:
        One fit per recording, and the drivers as all records together determine them. In the fits,
        `shared_cov` holds what all recordings with one driver have in common: the error of Z_th and
        `r_load_tolerance`; the rest of `cov` is each recording's own.

    Raises:
        ValueError: The study has no loaded recording.
    """
    require_float64()
    require("study", study, Study)
    order = order_of(order)
    circuit = circuit_of(circuit)
    drivers = Drivers(study, order, None)
    paths = to_identify(study)
    fits: dict[int, Fit] = {}
    notes = [""] * len(paths)
    waiting: dict[tuple[str, ...], dict[Any, _Waiting]] = {}

    def load(row):
        recording = study[paths[row]]
        return recording, drivers.found[drivers.of(recording)]

    for row in tqdm(range(len(paths)), unit="recording", disable=not progress):
        try:
            seen, found, method = planned(functools.partial(load, row), None)
            if method not in HARMONIC:
                raise Refusal("not_periodic", SINGLE)
        except Refusal as refusal:
            fits[row] = failed_fit(refusal.name, circuit, METHOD)
            notes[row] = refusal.note
            continue
        driver = serving(found, HarmonicDriver, method)
        lengths = waiting.setdefault(drivers.of(seen.recording), {})
        shared = is_shared(seen, driver)
        key = seen.v_th.size, shared, seen.recording.sample_rate, seen.recording.pulse_rate
        if key not in lengths:
            lengths[key] = _Waiting(_model(circuit, driver, shared), driver)
        lengths[key].add(row, seen)
    for names, lengths in tqdm(waiting.items(), unit="driver", disable=not progress):
        driver = next(iter(lengths.values())).driver
        groups = [group.loads() for group in lengths.values()]
        several = tuple(len(group.several()) for group in lengths.values())
        shared = any(group.model.shared for group in lengths.values())
        tolerance = jnp.asarray(r_load_tolerance, dtype=float)
        model = _model(circuit, driver, shared)
        found, better = _together(model, groups, several, driver, tolerance)
        changed = any(any(group.changed) for group in lengths.values())
        if changed and not any(np.any(loads.used) for loads in groups):
            better = dataclasses.replace(better, result=verdict("inconsistent"))
        drivers.found[names] = dataclasses.replace(better, method=METHOD)
        for group, fit in zip(lengths.values(), jax.device_get(found), strict=True):
            of_group = zip(group.remarks, group.changed, unstacked(fit), strict=True)
            marked = [remarked(_of(one, changed), remarks) for remarks, changed, one in of_group]
            judged = changes.judged(marked, better, group.repeats)
            for row, one in zip(group.rows, judged, strict=True):
                fits[row] = one
                notes[row] = note(one)
    ordered = [fits[row] for row in range(len(paths))]
    outcome = table(study, paths, ordered, notes)
    settings = Settings.of(study, len(paths), order, METHOD, circuit, r_load_tolerance)
    return StudyFits(outcome, drivers.found, drivers.failures, settings)


def _of(fit: Fit, changed: bool) -> Fit:
    """The fit with the verdict of a driver that has changed since its calibration."""
    explained = changed and fit.verdict in ("successful", "misfit")
    return dataclasses.replace(fit, result=verdict("inconsistent")) if explained else fit


def _model(circuit: AbstractCircuit, driver: HarmonicDriver, shared: bool) -> Joint:
    return Joint(circuit, Calibrations.of(driver), shared)
