"""Identify a skin: pre-flight, refinement, verdict; and what batches have in common with it."""

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.judgement import MISFIT_CHI2
from etid.estimators.lanes import AbstractLane, Harmonics
from etid.estimators.registry import (
    Method,
    check_default,
    estimator_of,
    for_samples,
    plan,
)
from etid.identify import changes
from etid.identify.arguments import circuit_of, require
from etid.identify.compiled import stored_jit
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.recordings.repeats import Repeats, repeats
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fits import Fit, IdentificationError
from etid.results.verdicts import message, verdict
from etid.signals.harmonics import whole_periods

_Found = TypeVar("_Found")
_Outcome = TypeVar("_Outcome", Fit, Driver)


def identify_skin(
    recording: Recording,
    driver: Driver,
    *,
    circuit: AbstractCircuit | None = None,
    method: Method | None = None,
    throw: bool = True,
) -> Fit:
    """Identify what is connected to the driver in one recording.

    Args:
        recording: Unloaded and loaded voltage.
        driver: Identified driver.
        circuit: Structure of the load and its typical values; `SkinRC` if not given.
        method: As in `identify_driver`, or `"non_parametric"` or `"harmonic_steiglitz_mcbride"`,
            whose drivers are those of maximum likelihood; or any name that was registered.
        throw: Raise if the verdict is not successful.

    Returns:
        Elements, standard errors and verdict.

    Raises:
        ValueError: The driver cannot serve this method, or the method this circuit.
        IdentificationError: The verdict is not successful and `throw` is set.
    """
    require("recording", recording, Recording)
    require("driver", driver, Driver)
    circuit = circuit_of(circuit)
    seen = Inspected(recording)
    estimator, name = plan(estimator_of(method, circuit), seen, driver)
    if name is not None:
        fit = failed_fit(name, circuit, str(estimator))
    else:
        check_default(estimator, circuit)
        lane = estimator.lane.of(seen)
        known = known_of(lane, driver, is_shared(seen, driver), estimator)

        def fits(lanes: Sequence[AbstractLane]) -> list[Fit]:
            on_device = [jax.tree.map(jnp.asarray, lane) for lane in lanes]
            return [skin(lane, driver, known, circuit, estimator) for lane in on_device]

        [fit] = refined([lane], [seen], fits, driver)
        [fit] = concluded([fit], driver, [int(seen.remarks)], repeats([seen]))
    if throw and fit.verdict != "successful":
        why = explained(seen, "rate_mismatch") if fit.verdict == "rate_mismatch" else note(fit)
        text = f"recording {recording.path!r}: {fit.verdict}. {why}"
        raise IdentificationError(text, fit)
    return fit


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
    """`identify_skin` for bare arrays, to be transformed by `jax.grad`, `jax.jit` and `jax.vmap`.

    The elements are differentiable with respect to both records and to every number in `driver`,
    its resistors `driver.calibration.r_load` for instance, by implicit differentiation of the
    minimum: as accurate as the minimum itself, a thousandth of a standard error. There is no
    pre-flight, but there is a verdict.

    Args:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        driver: Identified driver.
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        resolution: Step of the converter [V] at the terminal, 0 if not known.
        circuit: As in `identify_skin`.
        method: As in `identify_driver`; if not given, maximum likelihood for several whole
            periods, else output error. Whether they begin between pulses is not looked at.

    Returns:
        Elements, standard errors and verdict, as arrays that JAX can trace.

    Raises:
        ValueError: The driver cannot serve this method, or the method this circuit.
    """
    require("driver", driver, Driver)
    circuit = circuit_of(circuit)
    estimator = estimator_of(method, circuit)
    periods = whole_periods(v_out.shape[0], sample_rate, pulse_rate)
    if estimator is None:
        estimator = for_samples(driver, periods)
        check_default(estimator, circuit)
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
    return dataclasses.replace(fit, remarks=jnp.zeros_like(fit.remarks))  # nothing is left out


# --- What one recording and batches have in common ------------------------------------------------


def skin_lane(
    lane: Any, driver: Driver, known: Any, circuit: AbstractCircuit, estimator: AbstractEstimator
) -> Fit:
    """Identify one lane; differentiable code, to be jitted and batched by the caller."""
    return estimator.fit_load(lane, driver, known, circuit)


skin = stored_jit(skin_lane)


@stored_jit
def known_at(
    frequency: Float[Array, " harmonic"], driver: Driver, shared: bool, estimator: AbstractEstimator
) -> Any:
    """`AbstractEstimator.known`, compiled."""
    return estimator.known(driver, frequency, shared)


def known_of(lane: AbstractLane, driver: Driver, shared: bool, estimator: AbstractEstimator) -> Any:
    """What an estimator needs to know of a driver, for this lane and all with harmonics like it."""
    if not isinstance(lane, Harmonics):
        return None
    return known_at(jnp.asarray(lane.frequency), driver, shared, estimator)


def repeated(
    lanes: Sequence[AbstractLane],
    seen: Sequence[Inspected],
    fit: Callable[[Sequence[AbstractLane]], list[_Found]],
    late_by: Callable[[AbstractLane, _Found], int],
    needs_another: Callable[[_Found], bool],
    of_both: Callable[[_Found, _Found], _Found],
) -> list[_Found]:
    """Fit lanes; those that are late once more, and those with hum again without its harmonics.

    Args:
        lanes: Of the recordings.
        seen: The recordings; the lag of those that are late is corrected.
        fit: Fits lanes.
        late_by: Whole samples by which a lane is later than what was fitted to it.
        needs_another: Whether hum is seen in what was fitted, or may explain it.
        of_both: The better of two, the second without the harmonics of the mains.
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
    fit: Callable[[Sequence[AbstractLane]], list[Fit]],
    driver: Driver,
) -> list[Fit]:
    """`repeated` for fits of single recordings with a driver."""

    def late_by(lane: AbstractLane, fit: Fit) -> int:
        return lane.late_by(fit.circuit, driver) if fit.verdict == "misfit" else 0

    return repeated(lanes, seen, fit, late_by, needs_another, of_both)


def needs_another(fit: Fit | Driver) -> bool:
    """Whether hum is seen in a fit, or it misses the recording, be it for hum or not."""
    return bool(int(fit.remarks) & Remark.mains_hum) or not fit.chi2 < MISFIT_CHI2


def of_both(first: _Outcome, second: _Outcome) -> _Outcome:
    """A fit, or the `second` without the mains harmonics, if it is good and they show hum."""
    if second.verdict == "successful" and int(second.remarks) & Remark.mains_hum:
        return second
    return dataclasses.replace(first, remarks=np.zeros((), int))


def concluded(
    fits: Sequence[Fit],
    driver: Driver,
    remarks: Sequence[int],
    repeats: Sequence[Repeats | None],
) -> list[Fit]:
    """Fits with the remarks on their recordings, and with what changed during them.

    Args:
        fits: Fits of circuits of one kind, with remarks of their own.
        driver: Their driver.
        remarks: Of their recordings.
        repeats: The periods of their recordings.
    """
    found = changes.of_fits(fits, driver, repeats)
    return [_marked(*parts) for parts in zip(fits, remarks, found, strict=True)]


def _marked(fit: Fit, remarks: int, change: changes.Change) -> Fit:
    """The fit with the remarks on its recording and what changed during it, in one copy."""
    remarks, result = int(fit.remarks) | remarks, fit.result
    if remarks & Remark.coarse_converter and fit.verdict == "insensitive":
        result = verdict("resolution")
    if change.seen and fit.verdict in changes.EXPLAINED:
        result = verdict("changed")
    return dataclasses.replace(
        fit,
        remarks=np.asarray(remarks),
        change=change.size,
        change_stderr=change.stderr,
        result=result,
    )


def checksum(seen: Inspected) -> int:
    """Checksum that identifies an unloaded record."""
    return zlib.crc32(seen.v_th.tobytes())


def is_shared(seen: Inspected, driver: Driver) -> bool:
    """Whether the unloaded record of a recording may be that of a calibration."""
    known = driver.unloaded if isinstance(driver, HarmonicDriver) else None
    return known is None or checksum(seen) in known


def explained(seen: Inspected, name: str) -> str:
    """What a verdict of `etid.recordings.preflight` means, with the numbers that were found."""
    found = seen.train.mismatch if name == "rate_mismatch" else ""
    return f"{found} {message(name)}".strip()


def failed_fit(name: str, circuit: AbstractCircuit, method: str) -> Fit:
    """A fit without numbers, for a recording that was stopped before it."""
    size = len(circuit.names())
    nan = np.full((size, size), np.nan)
    empty = circuit.with_log_values(jnp.full(size, jnp.nan))
    scalar = np.asarray(np.nan)
    none = changes.unknown(size)
    return Fit(
        *(empty, nan, nan, scalar, scalar, verdict(name), np.asarray(0), method),
        *(np.zeros((), int), none.size, none.stderr),
    )


def note(fit: Fit) -> str:
    """What the verdict of a fit means, and what changed if that is what it says."""
    text = message(fit.verdict)
    return f"{text} {fit.changes}" if fit.verdict == "changed" else text
