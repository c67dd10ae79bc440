"""Draws of the perturbations: what each method answers, and what that is; and tables of them."""

import collections
import dataclasses
import functools
import itertools
import zlib
from collections.abc import Sequence
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

import etid
from benchmarks.estimators import DEFAULT, FAR, OFF, driver_of, shared
from benchmarks.failure_draws import DETERMINED, ELEMENTS
from benchmarks.laboratory import Record
from benchmarks.ladder import LOADS
from benchmarks.mappings import make_room
from benchmarks.perturbation_list import PERTURBATIONS
from benchmarks.perturbed_study import REFERENCE, Truth, undisturbed
from etid.identify.arguments import for_calibrations
from etid.recordings.preflight import Inspected
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

Kind = Literal["right", "refused", "said", "silent"]
KINDS: tuple[Kind, ...] = ("right", "refused", "said", "silent")


@dataclasses.dataclass(frozen=True)
class Answer:
    """One method's answer about one skin; arrays are (element,).

    Attributes:
        perturbation: Its name.
        snr_db: Of the noise [dB].
        path: Of the trial: dry or damp.
        method: Its name, or `default`.
        number: Of the driver.
        verdict: Name of the verdict.
        error: Relative error; NaN without an answer, 0 where there is no truth.
        stderr: Relative standard error; NaN where the method gives none.
        bound: Cramer-Rao bound of the standard error.
        words: Whether the elements are a matter of words: wrong by 20 % only.
    """

    perturbation: str
    snr_db: float
    path: str
    method: str
    number: int
    verdict: str
    error: Float[np.ndarray, " element"]
    stderr: Float[np.ndarray, " element"]
    bound: Float[np.ndarray, " element"]
    words: bool = False

    @property
    def stderrs(self) -> Float[np.ndarray, " element"]:
        """Errors in standard errors; in bounds, where the method gives no standard error.

        An infinite element is infinitely far off, although its standard error is infinite, too.
        """
        far = np.abs(self.error)
        size = np.where(self.stderr > 0, self.stderr, self.bound)
        return np.divide(far, size, out=far.copy(), where=np.isfinite(far))

    @property
    def wrong_elements(self) -> np.ndarray:
        """Elements that are too far off."""
        far = (self.stderrs > FAR) & (not self.words)
        return far | ((np.abs(self.error) > OFF) & (self.bound <= DETERMINED))

    @property
    def kind(self) -> Kind:
        """What the answer is."""
        wrong = bool(self.wrong_elements.any() or np.isnan(self.error).any())
        if self.verdict == "successful":
            return "silent" if wrong else "right"
        return "said" if wrong else "refused"


def error_of(
    values: Float[np.ndarray, " element"], truth: Truth, remarked: bool
) -> Float[np.ndarray, " element"]:
    """Relative errors of an answer; 0 where the truth has no such element.

    Args:
        values: The elements that are said.
        truth: What is right.
        remarked: Whether the answer says that something was wrong with the recording.
    """
    to_low, to_high = values / truth.low - 1, values / truth.high - 1
    inside = (to_low >= 0) & (to_high <= 0)
    nearest = np.where(np.abs(to_low) < np.abs(to_high), to_low, to_high)
    farthest = np.where(np.abs(to_low) < np.abs(to_high), to_high, to_low)
    error = farthest if truth.moves and not remarked else np.where(inside, 0.0, nearest)
    return np.where(np.isnan(truth.low), 0.0, error)


def answers_of(
    records: Sequence[etid.Recording],
    driver: etid.Driver | None,
    method: str | None,
) -> list[tuple[str, np.ndarray, np.ndarray, bool]]:
    """Verdict, elements, standard errors, and whether there is a remark, for each recording."""
    if driver is None:
        nothing = np.full(len(ELEMENTS), np.nan)
        return [("driver_failed", nothing, nothing, False)] * len(records)
    fits = etid.identify_skins(records, driver, method=method)
    remarks = np.broadcast_to(np.asarray(getattr(fits.fit, "remarks", 0)), len(fits))
    values = np.stack([np.asarray(getattr(fits.circuit, name)) for name in ELEMENTS], -1)
    errors = np.stack([np.asarray(getattr(fits.stderr, name)) for name in ELEMENTS], -1)
    return list(zip(map(str, fits.verdicts), values, errors, map(bool, remarks), strict=True))


@functools.cache
def _bounds(snr_db: float, samples: int, bits: int, full_scale: float) -> dict[str, np.ndarray]:
    """Bounds of the undisturbed scene with this noise and converter, by path."""
    scene = Scene(
        tuple(Trial(name, skin) for name, skin in LOADS.items()),
        (Trial("calibration", ResistorLoad(REFERENCE)),),
        snr_db=snr_db,
        samples=samples,
        bits=bits,
        full_scale=full_scale,
    )
    return {path: np.array(list(of.relative.values())) for path, of in etid.bound(scene).items()}


def _checksum(records: Sequence[etid.Recording]) -> tuple:
    """Tells calibrations apart: a driver is identified once for all perturbations that share it."""
    return tuple(
        (*(zlib.crc32(r.samples[name].stored.tobytes()) for name in ("v_th", "v_out")), r.metadata)
        for r in records
    )


def draw(names: Sequence[str], number: int, snr_db: float, methods: Sequence[str]) -> list[Answer]:
    """All answers behind one driver with one noise."""
    with jax.enable_x64(True):  # of a worker process
        waiting: dict[tuple, list[tuple[str, Record, Truth, etid.Recording]]] = {}
        calibrations = {}
        for name in names:
            study = PERTURBATIONS[name](undisturbed(number, snr_db))
            known = [of.recording(number) for of in study.calibrations]
            key = _checksum(known)
            calibrations[key] = known
            waiting.setdefault(key, []).extend(
                (name, of, study.truths[of.path], of.recording(number)) for of in study.trials
            )
        drivers: dict[tuple, etid.Driver | None] = {}
        found = []
        for (key, trials), method in itertools.product(waiting.items(), methods):
            given = None if method == DEFAULT else method
            seen = [Inspected(record) for record in calibrations[key]]
            kind = shared(given or str(for_calibrations(None, seen)))
            if (key, kind) not in drivers:
                drivers[key, kind] = driver_of(calibrations[key], kind)
            said = answers_of([trial[-1] for trial in trials], drivers[key, kind], given)
            for (name, of, truth, _), (verdict, values, stderr, remarked) in zip(
                trials, said, strict=True
            ):
                error = error_of(values, truth, remarked)
                bound = _bounds(snr_db, of.samples, of.bits, of.full_scale)[of.path]
                place = name, snr_db, of.path, method, number
                middle = (truth.low + truth.high) / 2
                found.append(Answer(*place, verdict, error, stderr / middle, bound, truth.words))
        make_room()
        return found


def table(answers: Sequence[Answer], by: Sequence[str]) -> list[dict[str, Any]]:
    """Counts for each group of answers, in the order of their first ones.

    Args:
        answers: What was said.
        by: Attributes of an answer that make the groups.
    """
    groups: dict[tuple, list[Answer]] = {}
    for answer in answers:
        groups.setdefault(tuple(getattr(answer, name) for name in by), []).append(answer)
    rows = []
    for key, of in groups.items():
        counts = collections.Counter(answer.kind for answer in of)
        row: dict[str, Any] = dict(zip(by, key, strict=True))
        row |= {"answers": len(of), **{kind: counts[kind] for kind in KINDS}}
        row |= _worst([answer for answer in of if answer.kind == "silent"])
        said = collections.Counter(answer.verdict for answer in of).most_common()
        row["verdicts"] = ", ".join(f"{count} {verdict}" for verdict, count in said)
        rows.append(row)
    return rows


def _worst(silent: Sequence[Answer]) -> dict[str, Any]:
    """The element of silent answers that is farthest off in standard errors."""
    names = ("worst_path", "worst_element", "worst_stderrs", "worst_error")
    if not silent:
        return dict.fromkeys(names, "")
    worst = max(silent, key=lambda answer: np.nanmax(answer.stderrs))
    element = int(np.nanargmax(worst.stderrs))
    place = worst.path, ELEMENTS[element]
    sizes = float(worst.stderrs[element]), float(worst.error[element])
    return dict(zip(names, (*place, *sizes), strict=True))
