"""Identification of one skin: pre-flight, refinement, verdict. Batches share these steps."""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.judgement import MISFIT_CHI2
from etid.estimators.lanes import AbstractLane, Harmonics, stacked, unstacked
from etid.estimators.registry import Method
from etid.identify import changes
from etid.identify.arguments import (
    Asked,
    Circuit,
    asked_of,
    candidates_of,
    check_default,
    estimator_of,
    fed,
    for_samples,
    plan,
    require,
)
from etid.identify.compiled import stored_jit
from etid.recordings.preflight import Inspected, why_implausible, why_misaligned
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.results.data import with_data
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import AbstractFeed
from etid.results.fits import Fit, IdentificationError, Support
from etid.results.verdicts import message, verdict, verdicts_of
from etid.selection.evidence import best
from etid.selection.search import search
from etid.selection.selection import Selection
from etid.signals.harmonics import whole_periods

EXPLAINED = ("rate_mismatch", "misaligned", "wrong_unit")  # verdicts with numbers in the message
SPARSE = 16  # every 16th sample enters a checksum
KEPT = 4  # drivers, for which `known_of` is kept
_Kind = TypeVar("_Kind", bound=AbstractCircuit)
_Found = TypeVar("_Found")
_Outcome = TypeVar("_Outcome", Fit, Driver)


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: None = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    throw: bool = True,
) -> Fit[SkinRC]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: _Kind,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    throw: bool = True,
) -> Fit[_Kind]: ...


@overload
def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: Literal["auto"],
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    throw: bool = True,
) -> Fit[AbstractCircuit]: ...


def identify_skin(
    recording: Recording,
    driver: Driver | None = None,
    *,
    circuit: Circuit = None,
    method: Method | None = None,
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    throw: bool = True,
) -> Fit:
    """Identify the circuit that is connected to the driver in one recording.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Identified driver. Without a driver the load is identified from the current that the
            recording measured. With a driver, the default method uses a measured current too.
        circuit: Structure of the load and its typical values; `SkinRC` if not given. With
            `"auto"` it is the simplest circuit that the recording supports; `select_circuit` shows
            the choice.
        method: A method of `identify_driver`, or `"non_parametric"` or
            `"harmonic_steiglitz_mcbride"`, or any registered name. `"non_parametric"` and
            `"harmonic_steiglitz_mcbride"` use the drivers of maximum likelihood.
        fixed: Known values of elements by name [SI], as in `{"r_s": 500.0}`. Their standard errors
            are 0.
        prior: Values of elements with their standard deviations, as in `{"r_s": (500.0, 50.0)}`;
            the standard errors of the fit contain this knowledge. Each set of values compiles a
            program of its own. Maximum likelihood and output error take known elements.
        throw: Raise an error if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict. The fit knows its recording and its driver, so that
        `fit.plot()`, `fit.posterior()` and `fit.profile("c_p")` need no arguments.

    Raises:
        ValueError: The method cannot use this driver or this circuit.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    candidates = candidates_of(circuit)
    asked = asked_of(method, candidates, fixed, prior)
    fits, chosen = candidate_fits(recording, driver, candidates, asked)
    single = len(candidates) == 1
    fit = fits[chosen] if single else Selection.of(fits, chosen, candidates).fit
    fit = with_data(fit, recording, driver)
    return successful(recording, fit) if throw else fit


def candidate_fits(
    recording: Recording,
    driver: Driver | None,
    candidates: Sequence[AbstractCircuit],
    asked: Asked,
) -> tuple[dict[int, Fit], int]:
    """Fits of the candidates that a recording asks for, and the number of the chosen one.

    Raises:
        ValueError: The method cannot use this driver.
    """
    recording, feed = fed(recording, driver)
    seen = Inspected(recording)
    estimator, name = plan(asked, seen, feed)
    if name is not None:
        return {0: failed_fit(name, candidates[0], str(estimator))}, 0
    check_default(estimator, candidates)
    lane = estimator.lane.of(seen)
    known = known_of(lane, feed, is_shared(seen, feed), estimator)

    def fit(lanes: Sequence[AbstractLane], circuit: AbstractCircuit) -> list[Fit]:
        found = [skin(lane, feed, known, circuit, estimator) for lane in lanes]
        return jax.device_get(found)

    found = refined([lane], [seen], fit, feed, candidates)
    [outcome] = chosen_fits(found, feed, [int(seen.remarks)], repeats([seen]))
    return outcome


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


def identify_samples(
    v_th: Float[Array, " time"],
    v_out: Float[Array, " time"],
    driver: Driver,
    *,
    sample_rate: float,
    pulse_rate: float,
    resolution: float = 0.0,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
) -> Fit:
    """`identify_skin` for plain arrays; `jax.grad`, `jax.jit` and `jax.vmap` can transform it.

    The elements are differentiable with respect to both records and to every number in `driver`,
    for example its resistors `driver.calibration.r_load`. The derivatives come from implicit
    differentiation of the minimum. They are as accurate as the minimum itself: a thousandth of a
    standard error. There is no pre-flight, but there is a verdict.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        driver: Identified driver.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        resolution: Step of the converter [V] at the terminal; 0 if not known.
        circuit: As in `identify_skin`.
        method: As in `identify_driver`. If not given, maximum likelihood for several whole
            periods, else output error. The function does not check that the periods begin between
            pulses.

    Returns:
        Elements, standard errors and verdict, as arrays that JAX can trace.

    Raises:
        ValueError: The method cannot use this driver or this circuit.
    """
    require("driver", driver, Driver)
    [circuit] = candidates_of(circuit)
    estimator = estimator_of(method, [circuit])
    periods = whole_periods(v_out.shape[0], sample_rate, pulse_rate)
    if estimator is None:
        estimator = for_samples(driver, periods)
        check_default(estimator, [circuit])
    estimator.check_driver(driver, sample_rate, pulse_rate)
    step = jnp.asarray(resolution, dtype=v_out.dtype)
    rate = jnp.asarray(sample_rate, dtype=v_out.dtype)
    lane = estimator.lane.of_samples(v_th, v_out, step, rate, periods)
    known = (
        estimator.known(driver, jnp.asarray(lane.frequency), True)
        if isinstance(lane, Harmonics)
        else None
    )
    fit = skin_lane(lane, driver, known, circuit, estimator)
    # No harmonic is left out here, so a remark about hum would be untrue.
    return dataclasses.replace(fit, remarks=fit.remarks & ~int(Remark.mains_hum))


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


skin = stored_jit(skin_lane)


@functools.partial(stored_jit, rare=True)  # once for each driver
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
    return known_at(jnp.asarray(np.frombuffer(frequency)), driver.driver, shared, estimator)


def repeated(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane]], list[_Found]],
    late_by: Callable[[AbstractLane, _Found], int],
    needs_another: Callable[[_Found], bool],
    of_both: Callable[[_Found, _Found], _Found],
) -> list[_Found]:
    """Fits of lanes, some of them fitted again.

    A lane that is late is realigned and fitted again. A lane with hum is fitted again without the
    mains harmonics.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits lanes.
        late_by: Lag of a lane behind its fit [whole samples].
        needs_another: Whether the fit shows hum, or hum may explain the fit.
        of_both: The better of two fits; the second is without the mains harmonics.
    """
    lanes = list(lanes)
    found = fit(lanes)
    late = {row: by for row, lane in enumerate(lanes) if (by := late_by(lane, found[row]))}
    for row, by in late.items():
        seen[row].lag += by
        lanes[row] = lanes[row].realigned(by)
    if late:
        for row, again in zip(late, fit([lanes[row] for row in late]), strict=True):
            found[row] = again
    few = {
        row: less
        for row, lane in enumerate(lanes)
        if needs_another(found[row]) and (less := lane.without_mains()) is not None
    }
    if few:
        for row, second in zip(few, fit(list(few.values())), strict=True):
            found[row] = of_both(found[row], second)
    return found


def refined(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane], AbstractCircuit], list[Fit]],
    driver: AbstractFeed,
    candidates: Sequence[AbstractCircuit],
) -> list[dict[int, Fit]]:
    """`repeated` for single recordings with a known driver; each time the circuit is chosen anew.

    Args:
        lanes: Lanes of the recordings.
        seen: The recordings. The function corrects the lag of those that are late.
        fit: Fits a circuit to lanes.
        driver: The driver of the recordings.
        candidates: Circuits to choose from.

    Returns:
        Fits of each recording, by number of the candidate.
    """

    def searched(lanes: Sequence[AbstractLane]) -> list[dict[int, Fit]]:
        if len(candidates) == 1:
            return [{0: one} for one in fit(lanes, candidates[0])]

        def rows(number: int, rows: Sequence[int]) -> list[Fit]:
            return fit([lanes[row] for row in rows], candidates[number])

        return search(len(lanes), candidates, rows)

    def late_by(lane: AbstractLane, fits: dict[int, Fit]) -> int:
        fit = fits[_chosen(fits)]
        return lane.late_by(fit.circuit, driver) if fit.verdict == "misfit" else 0

    def of_all(first: dict[int, Fit], second: dict[int, Fit]) -> dict[int, Fit]:
        other = second[_chosen(second)]
        if of_both(first[_chosen(first)], other) is other:
            return second
        return {number: without_hum(fit) for number, fit in first.items()}

    def another(fits: dict[int, Fit]) -> bool:
        return needs_another(fits[_chosen(fits)])

    return repeated(lanes, seen, searched, late_by, another, of_all)


def needs_another(fit: Fit | Driver) -> bool:
    """Whether a fit shows hum, or misses the recording for any reason."""
    return bool(int(fit.remarks) & Remark.mains_hum) or not fit.chi2 < MISFIT_CHI2


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


def chosen_fits(
    found: Sequence[dict[int, Fit]],
    driver: AbstractFeed,
    remarks: Sequence[int],
    repeats: Sequence[Repeats | None],
) -> list[tuple[dict[int, Fit], int]]:
    """The fits of several recordings, of which the chosen ones are `concluded`, and their numbers.

    Args:
        found: Fits of each recording, by number of the candidate.
        driver: The driver of these fits.
        remarks: Remarks on the recordings.
        repeats: The periods of the recordings.
    """
    outcome = [(dict(fits), _chosen(fits)) for fits in found]
    for number in {chosen for _, chosen in outcome}:  # circuits of one kind
        rows = [row for row, (_, chosen) in enumerate(outcome) if chosen == number]
        fits = [found[row][number] for row in rows]
        of_rows = [remarks[row] for row in rows], [repeats[row] for row in rows]
        for row, fit in zip(rows, concluded(fits, driver, *of_rows), strict=True):
            outcome[row][0][number] = fit
    return outcome


def concluded(
    fits: Sequence[Fit],
    driver: AbstractFeed,
    remarks: Sequence[int],
    repeats: Sequence[Repeats | None],
) -> list[Fit]:
    """Fits with the remarks on their recordings and the changes during the records.

    Args:
        fits: Fits of circuits of one kind; they may have remarks already.
        driver: The driver of these fits.
        remarks: Remarks on the recordings.
        repeats: The periods of the recordings.
    """
    whole = stacked(fits)
    change = changes.of_fits(whole, driver, repeats)
    names, remarked = whole.verdict, whole.remarks | np.asarray(remarks, int)
    coarse = (remarked & Remark.coarse_converter) > 0
    names = np.where(coarse & (names == "insensitive"), "resolution", names)
    names = np.where(change.seen & np.isin(names, changes.EXPLAINED), "changed", names)
    support = whole.support
    if support is None:
        support = Support.unknown(len(whole.circuit.names()), len(fits))
    return unstacked(
        dataclasses.replace(
            whole,
            remarks=remarked,
            change=change.size,
            change_stderr=change.stderr,
            result=verdicts_of(names),
            support=support,
        )
    )


def checksum(seen: Inspected) -> int:
    """Checksum that identifies an unloaded record; a part of its noise is enough."""
    return zlib.crc32(seen.v_th[::SPARSE].tobytes())


def is_shared(seen: Inspected, driver: AbstractFeed) -> bool:
    """Whether a recording and a calibration may share one unloaded record."""
    known = driver.unloaded if isinstance(driver, HarmonicDriver) else None
    return known is None or checksum(seen) in known


def explained(seen: Inspected, name: str) -> str:
    """The message of a verdict of `etid.recordings.preflight`, with the numbers found."""
    found = ""
    if name == "rate_mismatch":
        found = seen.train.mismatch
    elif name == "misaligned":
        found = why_misaligned(seen)
    elif name == "wrong_unit":
        found = why_implausible(seen.by_current or seen)
    return f"{found} {message(name)}".strip()


def failed_fit(name: str, circuit: AbstractCircuit, method: str) -> Fit:
    """A fit without numbers, for a recording that was not fitted."""
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    none = changes.unknown(size)
    fit = Fit(
        circuit=empty,
        cov=nan,
        shared_cov=nan,
        rrse=scalar,
        chi2=scalar,
        result=verdict(name),
        steps=np.asarray(0),
        method=method,
        change=none.size,
        change_stderr=none.stderr,
        support=Support.unknown(size),
    )
    return jax.tree.map(np.asarray, fit)


def note(fit: Fit) -> str:
    """The message of the verdict of a fit; for `changed` also the changes."""
    text = message(fit.verdict)
    return f"{text} {fit.changes}" if fit.verdict == "changed" else text
