"""The fit of a batch of recordings that share a driver: fitted, fitted again, judged.

NumPy fits rows of recordings. On accelerators, the recordings of one length share one compiled
function, which fits them side by side.

A recording is fitted again if it is late, after a shift of its records, and if hum may explain what
its fit misses, without the mains harmonics.
"""

import dataclasses
import functools
import logging
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.lanes import (
    LANES,
    AbstractLane,
    Harmonics,
    Held,
    Lags,
    replaced,
    stacked,
    taken,
    unstacked,
)
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify import changes
from etid.identify.second_minimum import ASIDE, likelier
from etid.likelihood.noise import MISFIT_CHI2
from etid.precision import one_thread, untraced
from etid.recordings.causes import LOG, log_changes
from etid.recordings.preflight import Inspected
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fit import Fit, Support
from etid.results.verdicts import USABLE, message, verdicts_of
from etid.selection.evidence import best
from etid.selection.search import search
from etid.signals.hold import NODES
from etid.signals.transfer import AnyArray

FEWEST = 16  # recordings that are read and fitted at once, however long they are
HELD = 2**21  # samples of waiting recordings; above, a call has fewer lanes, but at least `FEWEST`
# Relative standard deviation of the resonance, above which loads are searched twice. At 60 dB and
# 100 kHz it is 0.17 to 1.2 of 28 transformers that resonate at 95 kHz, of others 0.01 to 0.03.
OPEN = 0.1
ROWS = True  # whether NumPy fits harmonics as rows; if not, JAX does
_Outcome = TypeVar("_Outcome", Fit, Driver)


@eqx.filter_jit
def _side_by_side(
    lanes: AbstractLane,
    driver: AbstractFeed,
    known: Any,
    circuit: AbstractCircuit,
    estimator: AbstractEstimator,
) -> Fit:
    return jax.vmap(lambda lane: estimator.fit_load(lane, driver, known, circuit))(lanes)


@one_thread()
def known_at(
    frequency: Float[AnyArray, " harmonic"],
    driver: AbstractFeed,
    shared: bool,
    estimator: AbstractEstimator,
) -> Any:
    """`AbstractEstimator.known` with arrays of NumPy."""
    return estimator.known(untraced(driver), np.asarray(frequency), shared)


def known_of(
    lane: AbstractLane, driver: AbstractFeed, shared: bool, estimator: AbstractEstimator
) -> Any:
    """What an estimator must know of a driver; valid for all lanes with equal harmonics.

    It is kept for the next recordings: it takes as long as half a fit. None for lanes without
    harmonics.
    """
    if not isinstance(lane, Harmonics):
        return None
    held = float(lane.sample_rate) if isinstance(lane, Held) else 0.0
    of = np.asarray(lane.frequency).tobytes(), shared, estimator, held
    return _known_of(_Same(driver), *of)


class _Same:
    """A driver that equals only itself: its arrays cannot be hashed."""

    def __init__(self, driver: AbstractFeed) -> None:
        self.driver = driver

    def __hash__(self) -> int:
        return id(self.driver)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.driver is other.driver


@functools.lru_cache(maxsize=4)
def _known_of(
    driver: _Same, frequency: bytes, shared: bool, estimator: AbstractEstimator, held: float
) -> Any:
    """`known_of`; `held` is the sample rate of a command that a converter holds, else 0."""
    known = known_at(np.frombuffer(frequency), driver.driver, shared, estimator)
    if held == 0:
        return known
    beyond = known_at(NODES * held, driver.driver, False, estimator)
    return dataclasses.replace(known, beyond=beyond)


def checksum(seen: Inspected) -> int:
    """Checksum that identifies an unloaded record; a part of its noise is enough."""
    return zlib.crc32(seen.v_th[::16].tobytes())


def is_shared(seen: Inspected, driver: AbstractFeed) -> bool:
    """Whether a recording and a calibration may share one unloaded record."""
    known = driver.unloaded if isinstance(driver, HarmonicDriver) else None
    return known is None or checksum(seen) in known


def has_open_resonance(driver: AbstractFeed) -> bool:
    """Whether the resonance of a driver is so uncertain that a load may have a second minimum."""
    if not isinstance(driver, HarmonicDriver) or not driver.source.log_omega.size:
        return False
    return bool(np.asarray(driver.cov)[1, 1] > OPEN**2)  # ln ω of the first section


class Prepared(NamedTuple):
    """A recording that can be fitted.

    Attributes:
        seen: The recording and its properties.
        driver: Its driver.
        estimator: Its estimator.
        lane: Its arrays.
        shared: Whether it and a calibration may share one unloaded record.
    """

    seen: Inspected
    driver: AbstractFeed
    estimator: AbstractEstimator
    lane: AbstractLane
    shared: bool

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for recordings that one call can fit."""
        rates = self.seen.recording.sample_rate, self.seen.recording.pulse_rate
        return (
            id(self.driver),
            self.estimator,
            type(self.lane),
            self.lane.shapes,
            self.shared,
            rates,
        )


@dataclasses.dataclass
class CandidateFits:
    """Fits of several recordings.

    Attributes:
        first: Fits of the first candidate to each recording, stacked.
        own: Fits by number of the candidate, for the recordings that do not have this fit only.
    """

    first: Fit
    own: dict[int, dict[int, Fit]] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.first.chi2)

    def __getitem__(self, row: int) -> dict[int, Fit]:
        """Fits of a recording, by number of the candidate."""
        return self.own[row] if row in self.own else {0: taken(self.first, row)}

    def __setitem__(self, row: int, fits: dict[int, Fit]) -> None:
        self.own[row] = fits

    def chosen(self, row: int) -> int:
        """Number of the chosen candidate of a recording."""
        return _chosen(self.own[row]) if row in self.own else 0

    def where(self, test: Callable[[Fit], Bool[np.ndarray, "*lane"]]) -> list[int]:
        """Recordings whose chosen fit passes a test."""
        passed = np.array(test(self.first))
        for row, fits in self.own.items():
            passed[row] = test(fits[_chosen(fits)])
        return np.flatnonzero(passed).tolist()

    def concluded(
        self, driver: AbstractFeed, remarks: Sequence[int], repeats: Sequence[Repeats | None]
    ) -> "CandidateFits":
        """The same; the chosen fits are `concluded`, whose arguments these are."""
        first, own = concluded(self.first, driver, remarks, repeats), dict(self.own)
        of_number: dict[int, list[int]] = {}
        for row in own:
            of_number.setdefault(self.chosen(row), []).append(row)
        for number, rows in of_number.items():  # circuits of one kind
            of_rows = [remarks[row] for row in rows], [repeats[row] for row in rows]
            fits = concluded(stacked([own[row][number] for row in rows]), driver, *of_rows)
            for place, row in enumerate(rows):
                own[row] = {**own[row], number: taken(fits, place)}
        return CandidateFits(first, own)

    @property
    def only(self) -> Fit:
        """The fits, stacked, if there is only one candidate."""
        rows, fits = list(self.own), [fits[0] for fits in self.own.values()]
        return replaced(self.first, rows, stacked(fits)) if rows else self.first


def _chosen(fits: dict[int, Fit]) -> int:
    """Number of the candidate to choose; without a choice, no reader needs to know how it goes."""
    return best(fits) if len(fits) > 1 else next(iter(fits))


_Several = TypeVar("_Several", CandidateFits, list[Any])


def as_fitted(
    seen: Inspected,
    kind: type[Harmonics],
    circuit: AbstractCircuit,
    feed: AbstractFeed,
    hums: bool,
) -> tuple[Harmonics, Any]:
    """The lane of a recording that `refitted` ends with, and what is known of its driver.

    Args:
        seen: The recording; the function corrects its lag.
        kind: Class of the lane.
        circuit: The fitted load.
        feed: Its driver, or the measured current.
        hums: Whether the harmonics of the mains are left out.
    """
    seen.realign(*kind.of(seen).late_by(circuit, feed))
    lane = kind.of(seen)
    if hums:
        lane = lane.without_mains() or lane
    return lane, known_of(lane, feed, is_shared(seen, feed), MAXIMUM_LIKELIHOOD)


def refitted(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane], bool], _Several],
    late_by: Callable[[Sequence[AbstractLane], _Several], Mapping[int, Lags]],
    may_hum: Callable[[_Several], Iterable[int]],
    better: Callable[[Any, Any], Any],
) -> _Several:
    """Fits of lanes, some of them fitted again.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits lanes, whose circuits may be inexact or not. Each lane can be read from the result
            and written into it by its number.
        late_by: Lags of lanes behind their fits, by number; only those that are late.
        may_hum: Numbers of the lanes whose fits show hum, or that hum may explain.
        better: The better of two fits of a lane; the second is without the mains harmonics.
    """
    lanes = list(lanes)

    def aligned(found: _Several) -> dict[int, AbstractLane]:
        late = late_by(lanes, found)
        for row, by in late.items():
            seen[row].realign(*by)
            lanes[row] = type(lanes[row]).of(seen[row])
        return {row: lanes[row] for row in late}

    def without_mains(found: _Several) -> dict[int, AbstractLane]:
        less = {row: lanes[row].without_mains() for row in may_hum(found)}
        return {row: lane for row, lane in less.items() if lane is not None}

    found = fit(lanes, True)
    # A second fit that is not exact would not be the better one.
    for change, inexact, choose, why in (
        (aligned, True, lambda _, second: second, "with v_out aligned to the first fit"),
        (without_mains, False, better, "without the mains harmonics"),
    ):
        if changed := change(found):
            again = fit(list(changed.values()), inexact)
            for number, row in enumerate(changed):
                second = again[number]
                found[row] = kept = choose(found[row], second)
                which = "second" if kept is second else "first"
                path = seen[row].recording.path or "recording"
                LOG.info("%s: fitted again %s; the %s fit is kept.", path, why, which)
    return found


def refitted_loads(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane], AbstractCircuit, bool], Fit],
    driver: AbstractFeed,
    candidates: Sequence[AbstractCircuit],
) -> CandidateFits:
    """`refitted` for recordings with a known driver; each time the circuit is chosen anew.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits a circuit to lanes, which may be inexact or not; the fits are stacked.
        driver: The driver of the recordings.
        candidates: Circuits to choose from.
    """

    def searched(lanes: Sequence[AbstractLane], inexact: bool) -> CandidateFits:
        if len(candidates) == 1:
            return CandidateFits(fit(lanes, candidates[0], inexact))

        def rows(number: int, rows: Sequence[int]) -> list[Fit]:
            return unstacked(fit([lanes[row] for row in rows], candidates[number], inexact))

        found = search(len(lanes), candidates, rows)
        several = {row: fits for row, fits in enumerate(found) if len(fits) > 1}
        return CandidateFits(stacked([fits[0] for fits in found]), several)

    def late_by(lanes: Sequence[AbstractLane], found: CandidateFits) -> dict[int, Lags]:
        late = {}
        for row in found.where(lambda fit: np.asarray(fit.verdict) == "misfit"):
            circuit = found[row][found.chosen(row)].circuit
            late[row] = lanes[row].late_by(circuit, driver)
        return {row: by for row, by in late.items() if any(by)}

    def better(first: dict[int, Fit], second: dict[int, Fit]) -> dict[int, Fit]:
        other = second[_chosen(second)]
        if better_of(first[_chosen(first)], other) is other:
            return second
        return {number: _without_hum(fit) for number, fit in first.items()}

    return refitted(lanes, seen, searched, late_by, lambda found: found.where(may_hum), better)


def may_hum(fit: Fit | Driver) -> Bool[np.ndarray, "*lane"]:
    """Whether a fit shows hum, or misses the recording for any reason."""
    hum = (np.asarray(fit.remarks) & Remark.mains_hum) > 0
    return np.asarray(hum | ~(np.asarray(fit.chi2) < MISFIT_CHI2) | fit.inexact)


def better_of(first: _Outcome, second: _Outcome) -> _Outcome:
    """The second fit if hum explains what the first misses, else the first without that remark.

    The second fit is the one without the mains harmonics.
    """
    explains = second.verdict == "successful" and not second.inexact
    if explains and int(second.remarks) & Remark.mains_hum:
        return second
    return _without_hum(first)


def _without_hum(found: _Outcome) -> _Outcome:
    return dataclasses.replace(found, remarks=np.asarray(found.remarks & ~int(Remark.mains_hum)))


def judged(
    found: CandidateFits,
    driver: AbstractFeed,
    seen: Sequence[Inspected],
    estimator: AbstractEstimator,
) -> CandidateFits:
    """Fits with remarks, and with changes during the records; see `concluded`.

    A current that is used beside the driver shows smaller changes of the load than the driver does,
    and changes of its own gain.
    """
    remarks = [remarks_on(one, estimator) for one in seen]
    found = found.concluded(driver, remarks, repeats(seen))
    for row in range(len(found)) if LOG.isEnabledFor(logging.INFO) else ():
        tried, fit = len(found[row]), found[row][found.chosen(row)]
        best_of = f", best of {tried} circuits" if tried > 1 else ""
        LOG.info("%s: %s", seen[row].recording.path, f"{fit._overview().title}{best_of}")
    if not (isinstance(estimator, MaximumLikelihood) and estimator.with_current):
        return found
    by_current = [of for one in seen if (of := one.by_current) is not None]
    return found.concluded(MEASURED_CURRENT, remarks, repeats(by_current))


def concluded(
    fits: Fit, driver: AbstractFeed, remarks: Sequence[int], repeats: Sequence[Repeats | None]
) -> Fit:
    """Fits with the remarks on their recordings and the changes during the records.

    Args:
        fits: Fits of circuits of one kind, stacked; they may have remarks and changes already.
        driver: The driver of these fits.
        remarks: Remarks on the recordings.
        repeats: The periods of the recordings.
    """
    change = changes.of_fits(fits, driver, repeats)
    before = (fits.verdict == "changed")[:, None]
    # Few fits have changes of their own; those of the others are not asked for.
    known, known_stderr = fits.known_changes if before.any() else (change.size, change.stderr)
    names, remarked = fits.verdict, fits.remarks | np.asarray(remarks, int)
    coarse = (remarked & Remark.coarse_converter) > 0
    names = np.where(coarse & (names == "insensitive"), "resolution", names)
    explained = np.isin(names, (*USABLE, "misfit", "inconsistent", "biased"))
    names = np.where(change.seen & explained, "changed", names)
    return dataclasses.replace(
        fits,
        remarks=remarked,
        change=np.where(before, known, change.size),
        change_stderr=np.where(before, known_stderr, change.stderr),
        result=verdicts_of(names),
        support=fits.support or Support.unknown(fits.cov.shape[-1], len(names)),
    )


def notes_of(fits: Fit, feed: AbstractFeed) -> list[str]:
    """The note of each of several fits behind one driver, or by their currents."""
    names = fits.verdict  # some have more to say than the message of the verdict
    more = np.isin(names, ("changed", "misfit", "out_of_bounds", "inconsistent")) | fits.inexact
    each = enumerate(zip(names.tolist(), more.tolist(), strict=True))
    notes = (taken(fits, row).note if of else message(name) for row, (name, of) in each)
    return [with_driver(note, feed) for note in notes]


def with_driver(note: str, feed: AbstractFeed | None) -> str:
    """The note of a fit, and why its driver failed if it did."""
    why = feed.why if note and isinstance(feed, Driver) else ""
    return " ".join(filter(None, (note, why)))


def remarks_on(seen: Inspected, estimator: AbstractEstimator) -> int:
    """Remarks on a recording, also that the estimator leaves out a current beside a driver."""
    if LOG.isEnabledFor(logging.INFO):
        log_changes(seen)
    uses = isinstance(estimator, MaximumLikelihood) and estimator.with_current
    unused = seen.by_current is not None and not uses
    return int(seen.remarks | (Remark.current_unused if unused else 0))


def fits_of(
    lanes: Sequence[AbstractLane],
    driver: AbstractFeed,
    known: Any,
    circuit: AbstractCircuit,
    estimator: AbstractEstimator,
) -> Fit:
    """Fits of lanes of one shape, stacked."""
    if ROWS and jax.default_backend() == "cpu":
        parts = estimator.fit_rows(lanes, driver, known, circuit)
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return jax.device_get(_side_by_side(stacked(lanes), driver, known, circuit, estimator))


class Batch:
    """Recordings that one call fits: they share a compiled function and a driver.

    Attributes:
        like: The first of them.
        rows: Their numbers.
        lanes: Their arrays.
        seen: The recordings and their properties.
    """

    def __init__(self, like: Prepared) -> None:
        self.like = like
        self.rows: list[int] = []
        self.lanes: list[AbstractLane] = []
        self.seen: list[Inspected] = []
        self._samples = 0

    def add(self, row: int, one: Prepared) -> None:
        """Append a recording."""
        self.rows.append(row)
        self.lanes.append(one.lane)
        self.seen.append(one.seen)
        self._samples += one.seen.recording.samples["v_out"].stored.size

    @property
    def full(self) -> bool:
        """Whether a call has its lanes, or the recordings take much memory."""
        return len(self.rows) == LANES or (len(self.rows) >= FEWEST and self._samples >= HELD)

    def fitted(self, candidates: Sequence[AbstractCircuit]) -> CandidateFits:
        """The fits of the best of these circuits, with their verdicts."""
        _, driver, estimator, _, shared = self.like

        def alike(lanes: Sequence[AbstractLane], circuit: AbstractCircuit, inexact: bool) -> Fit:
            of = estimator
            if isinstance(of, MaximumLikelihood) and not inexact:
                of = dataclasses.replace(of, accept=0.0)
            known = known_of(lanes[0], driver, shared, of)
            found = fits_of(lanes, driver, known, circuit, of)
            if isinstance(known, GivenDriver) and has_open_resonance(driver):
                aside = dataclasses.replace(known, aside=np.asarray(ASIDE))
                found = likelier(found, fits_of(lanes, driver, aside, circuit, of))
            return dataclasses.replace(found, method=str(estimator))

        def fit(lanes: Sequence[AbstractLane], circuit: AbstractCircuit, inexact: bool) -> Fit:
            rows: dict[Any, list[int]] = {}  # those that are realigned may have other shapes
            for row, lane in enumerate(lanes):
                rows.setdefault(lane.shapes, []).append(row)
            of = circuit, inexact
            if len(rows) == 1:
                return alike(lanes, *of)
            parts = [alike([lanes[row] for row in each], *of) for each in rows.values()]
            whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
            return taken(whole, np.argsort(np.concatenate(list(rows.values()))))

        found = refitted_loads(self.lanes, self.seen, fit, driver, candidates)
        return judged(found, driver, self.seen, estimator)
