"""Identification of one skin: pre-flight, refinement, verdict. Batches share these steps."""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, Unpack, overload

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.judgement import MISFIT_CHI2
from etid.estimators.lanes import (
    AbstractLane,
    Harmonics,
    Lags,
    replaced,
    stacked,
    taken,
    unstacked,
)
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.registry import Method
from etid.identify import changes
from etid.identify.arguments import fed
from etid.identify.options import (
    Circuit,
    FitOptions,
    Interval,
    Options,
    candidates_of,
    check_default,
    plan,
)
from etid.identify.planning import EXPLAINED, explained, failed_fit
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.results.data import with_data
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fit import Fit, IdentificationError, Support
from etid.results.verdicts import message, verdicts_of
from etid.selection.evidence import best
from etid.selection.search import search
from etid.selection.selection import Selection

NOTED = ("changed", "out_of_bounds", "inconsistent")  # verdicts to which `note` adds numbers
SPARSE = 16  # every 16th sample enters a checksum
KEPT = 4  # drivers, for which `known_of` is kept
_Kind = TypeVar("_Kind", bound=AbstractCircuit)
_Outcome = TypeVar("_Outcome", Fit, Driver)


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[SkinRC]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[_Kind]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: str,
    throw: bool = True,
    **options: Unpack[FitOptions],
) -> Fit[AbstractCircuit]: ...


@in_float64
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, Interval] | None = None,
    throw: bool = True,
) -> Fit:
    """Identify the circuit that is connected to the driver in one recording.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Identified driver. Without a driver the load is identified from the current that the
            recording measured. With a driver, the default method uses a measured current too.
        circuit: Structure of the load and its typical values, or a circuit string such as
            `"R0-p(R1,C1)"`; `SkinRC` if not given. With `"auto"` it is the simplest circuit that
            the recording supports; `select_circuit` shows the choice.
        method: A method of `identify_driver`, or `"non_parametric"`, which uses the drivers of
            maximum likelihood, or any registered name.
        fixed: Known values of elements by name [SI], as in `{"r_s": 500.0}`. Their standard errors
            are 0.
        prior: Values of elements with their standard deviations, as in `{"r_s": (500.0, 50.0)}`;
            the standard errors of the fit contain this knowledge. Each set of values compiles a
            program of its own. Maximum likelihood and output error take known elements.
        bounds: Least and largest possible values of elements [SI], as in `{"r_s": (100.0, 2e3)}`;
            None where there is none. The estimate is the mean of what the likelihood leaves inside,
            and the standard errors are its own. The remark `at_bound` says that an element would
            lie outside without its bounds; the verdict `out_of_bounds` that they contradict the
            recording. They take the methods that take known elements.
        throw: Raise an error if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict. The fit knows its recording and its driver, so that
        `fit.plot()`, `fit.posterior()` and `fit.profile("c_p")` need no arguments.

    Raises:
        ValueError: The method cannot use this driver or this circuit.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    options = Options.of(
        candidates_of(circuit), method=method, fixed=fixed, prior=prior, bounds=bounds
    )
    fits, chosen = candidate_fits(recording, driver, options)
    single = len(options.circuits) == 1
    fit = fits[chosen] if single else Selection.of(fits, chosen, options.circuits).fit
    fit = with_data(fit, recording, driver)
    return successful(recording, fit) if throw else fit


def candidate_fits(
    recording: Recording, driver: Driver | None, options: Options
) -> tuple[dict[int, Fit], int]:
    """Fits of the circuits that a recording asks for, and the number of the chosen one.

    Raises:
        ValueError: The method cannot use this driver.
    """
    recording, feed = fed(recording, driver)
    seen = Inspected(recording)
    estimator, name = plan(options, seen, feed)
    if name is not None:
        return {0: failed_fit(name, options, str(estimator))}, 0
    check_default(estimator, options.circuits)
    lane = estimator.lane.of(seen)
    known = known_of(lane, feed, is_shared(seen, feed), estimator)

    def fit(lanes: Sequence[AbstractLane], circuit: AbstractCircuit) -> Fit:
        found = [skin(lane, feed, known, circuit, estimator) for lane in lanes]
        return stacked(jax.device_get(found))

    found = refined([lane], [seen], fit, feed, options.circuits)
    found = judged(found, feed, [seen], estimator)
    return found[0], found.chosen(0)


def successful(recording: Recording, fit: Fit) -> Fit:
    """The fit.

    Raises:
        IdentificationError: Its verdict is not successful.
    """
    if fit.verdict == "successful":
        return fit
    why = note(fit)
    if fit.verdict in EXPLAINED:
        why = explained(Inspected(recording), fit.verdict)
    raise IdentificationError(f"recording {recording.path!r}: {fit.verdict}. {why}", fit)


# --- Steps that one recording and batches share ---------------------------------------------------


def skin_lane(
    lane: Any,
    driver: AbstractFeed,
    known: Any,
    circuit: AbstractCircuit,
    estimator: AbstractEstimator,
) -> Fit:
    """The fit of one lane. The code is differentiable; the caller compiles and batches it."""
    return estimator.fit_load(lane, driver, known, circuit)


_skin = program(skin_lane)


def skin(
    lane: Any,
    driver: AbstractFeed,
    known: Any,
    circuit: AbstractCircuit,
    estimator: AbstractEstimator,
) -> Fit:
    """`skin_lane`, compiled. In a notebook, compilation takes longer than all fits."""
    return _skin(lane, driver, known, circuit, estimator)


@program  # once for each driver
def known_at(
    frequency: Float[Array, " harmonic"],
    driver: AbstractFeed,
    shared: bool,
    estimator: AbstractEstimator,
) -> Any:
    """`AbstractEstimator.known`, compiled."""
    return estimator.known(driver, frequency, shared)


def known_of(
    lane: AbstractLane, driver: AbstractFeed, shared: bool, estimator: AbstractEstimator
) -> Any:
    """What an estimator must know of a driver; valid for all lanes with equal harmonics.

    It is kept for the next recordings: it takes as long as half a fit. None for lanes without
    harmonics.
    """
    if not isinstance(lane, Harmonics):
        return None
    return _known_of(_Same(driver), np.asarray(lane.frequency).tobytes(), shared, estimator)


class _Same:
    """A driver that equals only itself: its arrays cannot be hashed."""

    def __init__(self, driver: AbstractFeed) -> None:
        self.driver = driver

    def __hash__(self) -> int:
        return id(self.driver)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.driver is other.driver


@functools.lru_cache(maxsize=KEPT)
def _known_of(driver: _Same, frequency: bytes, shared: bool, estimator: AbstractEstimator) -> Any:
    return known_at(jax.device_put(np.frombuffer(frequency)), driver.driver, shared, estimator)


@dataclasses.dataclass
class Tried:
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
    ) -> "Tried":
        """The same; the chosen fits are `concluded`.

        Args:
            driver: The driver of these fits.
            remarks: Remarks on the recordings.
            repeats: The periods of the recordings.
        """
        first, own = concluded(self.first, driver, remarks, repeats), dict(self.own)
        of_number: dict[int, list[int]] = {}
        for row in own:
            of_number.setdefault(self.chosen(row), []).append(row)
        for number, rows in of_number.items():  # circuits of one kind
            of_rows = [remarks[row] for row in rows], [repeats[row] for row in rows]
            fits = concluded(stacked([own[row][number] for row in rows]), driver, *of_rows)
            for place, row in enumerate(rows):
                own[row] = {**own[row], number: taken(fits, place)}
        return Tried(first, own)

    @property
    def only(self) -> Fit:
        """The fits, stacked, if there is only one candidate."""
        rows, fits = list(self.own), [fits[0] for fits in self.own.values()]
        return replaced(self.first, rows, stacked(fits)) if rows else self.first


_Several = TypeVar("_Several", Tried, list[Any])


def repeated(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane]], _Several],
    late_by: Callable[[Sequence[AbstractLane], _Several], Mapping[int, Lags]],
    need_another: Callable[[_Several], Iterable[int]],
    of_both: Callable[[Any, Any], Any],
) -> _Several:
    """Fits of lanes, some of them fitted again.

    A lane that is late is realigned and fitted again. A lane with hum is fitted again without the
    mains harmonics.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits lanes. Each lane can be read from the result and written into it by its number.
        late_by: Lags of lanes behind their fits, by number; only those that are late.
        need_another: Numbers of the lanes whose fits show hum, or that hum may explain.
        of_both: The better of two fits of a lane; the second is without the mains harmonics.
    """
    lanes = list(lanes)
    found = fit(lanes)
    late = late_by(lanes, found)
    for row, by in late.items():
        seen[row].realign(*by)
        lanes[row] = lanes[row].realigned(by)
    if late:
        again = fit([lanes[row] for row in late])
        for number, row in enumerate(late):
            found[row] = again[number]
    few = {
        row: less for row in need_another(found) if (less := lanes[row].without_mains()) is not None
    }
    if few:
        again = fit(list(few.values()))
        for number, row in enumerate(few):
            found[row] = of_both(found[row], again[number])
    return found


def refined(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane], AbstractCircuit], Fit],
    driver: AbstractFeed,
    candidates: Sequence[AbstractCircuit],
) -> Tried:
    """`repeated` for recordings with a known driver; each time the circuit is chosen anew.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits a circuit to lanes; the fits are stacked.
        driver: The driver of the recordings.
        candidates: Circuits to choose from.
    """

    def searched(lanes: Sequence[AbstractLane]) -> Tried:
        if len(candidates) == 1:
            return Tried(fit(lanes, candidates[0]))

        def rows(number: int, rows: Sequence[int]) -> list[Fit]:
            return unstacked(fit([lanes[row] for row in rows], candidates[number]))

        found = search(len(lanes), candidates, rows)
        several = {row: fits for row, fits in enumerate(found) if len(fits) > 1}
        return Tried(stacked([fits[0] for fits in found]), several)

    def late_by(lanes: Sequence[AbstractLane], found: Tried) -> dict[int, Lags]:
        late = {}
        for row in found.where(lambda fit: np.asarray(fit.verdict) == "misfit"):
            circuit = found[row][found.chosen(row)].circuit
            late[row] = lanes[row].late_by(circuit, driver)
        return {row: by for row, by in late.items() if any(by)}

    def of_all(first: dict[int, Fit], second: dict[int, Fit]) -> dict[int, Fit]:
        other = second[_chosen(second)]
        if of_both(first[_chosen(first)], other) is other:
            return second
        return {number: without_hum(fit) for number, fit in first.items()}

    def need_another(found: Tried) -> list[int]:
        return found.where(needs_another)

    return repeated(lanes, seen, searched, late_by, need_another, of_all)


def needs_another(fit: Fit | Driver) -> Bool[np.ndarray, "*lane"]:
    """Whether a fit shows hum, or misses the recording for any reason."""
    hum = (np.asarray(fit.remarks) & Remark.mains_hum) > 0
    return np.asarray(hum | ~(np.asarray(fit.chi2) < MISFIT_CHI2))


def of_both(first: _Outcome, second: _Outcome) -> _Outcome:
    """The second fit if it is successful and shows hum, else the first fit without that remark.

    The second fit is the one without the mains harmonics.
    """
    if second.verdict == "successful" and int(second.remarks) & Remark.mains_hum:
        return second
    return without_hum(first)


def without_hum(found: _Outcome) -> _Outcome:
    """A fit or driver without the remark `mains_hum`."""
    return dataclasses.replace(found, remarks=np.asarray(found.remarks & ~int(Remark.mains_hum)))


def _chosen(fits: dict[int, Fit]) -> int:
    """Number of the candidate to choose; without a choice, no reader needs to know how it goes."""
    return best(fits) if len(fits) > 1 else next(iter(fits))


def judged(
    found: Tried, driver: AbstractFeed, seen: Sequence[Inspected], estimator: AbstractEstimator
) -> Tried:
    """Fits with remarks, and with changes during the records; see `concluded`.

    A current that is used beside the driver shows smaller changes of the load than the driver does,
    and changes of its own gain.
    """
    remarks = [remarks_on(one, estimator) for one in seen]
    found = found.concluded(driver, remarks, repeats(seen))
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
    names = np.where(change.seen & np.isin(names, changes.EXPLAINED), "changed", names)
    support = fits.support
    if support is None:
        support = Support.unknown(fits.cov.shape[-1], len(names))
    return dataclasses.replace(
        fits,
        remarks=remarked,
        change=np.where(before, known, change.size),
        change_stderr=np.where(before, known_stderr, change.stderr),
        result=verdicts_of(names),
        support=support,
    )


def note(fit: Fit) -> str:
    """The message of the verdict of a fit; also the changes, elements outside, another circuit."""
    own = {"changed": fit.changes, "out_of_bounds": fit.outside}.get(fit.verdict, "")
    return " ".join(filter(None, (fit.other_circuit, message(fit.verdict), own)))


def notes_of(fits: Fit) -> list[str]:
    """`note` of each of several fits."""
    names = fits.verdict.tolist()
    return [
        note(taken(fits, row)) if name in NOTED else message(name) for row, name in enumerate(names)
    ]


def remarks_on(seen: Inspected, estimator: AbstractEstimator) -> int:
    """Remarks on a recording, also that the estimator leaves out a current beside a driver."""
    uses = isinstance(estimator, MaximumLikelihood) and estimator.with_current
    unused = seen.by_current is not None and not uses
    return int(seen.remarks | (Remark.current_unused if unused else 0))


def checksum(seen: Inspected) -> int:
    """Checksum that identifies an unloaded record; a part of its noise is enough."""
    return zlib.crc32(seen.v_th[::SPARSE].tobytes())


def is_shared(seen: Inspected, driver: AbstractFeed) -> bool:
    """Whether a recording and a calibration may share one unloaded record."""
    known = driver.unloaded if isinstance(driver, HarmonicDriver) else None
    return known is None or checksum(seen) in known
