"""Checks of arguments, and the estimator that they select, before any computation.

A wrong type, a wrong method or the wrong precision of JAX is refused with a message.
"""

import dataclasses
import functools
import hashlib
import math
import operator
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.circuits.current_dependent import current_dependent
from etid.estimators.element_limits import Limits, checked_limits
from etid.estimators.element_prior import Known, checked
from etid.estimators.estimator import AbstractEstimator
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.output_error.estimator import OutputError
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, OUTPUT_ERROR, WITH_CURRENT, Method, named
from etid.recordings.errors import not_recorded
from etid.recordings.preflight import Inspected, preflight
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed, MeasuredCurrent
from etid.results.tried_orders import AUTO, Order
from etid.selection.search import usual_circuits

# Four times the order of the paper. Calibrations determine no more poles; with 50 poles an
# identification takes minutes and does not converge.
LARGEST_ORDER = 20

Circuit = AbstractCircuit | Literal["auto"] | None
"""A circuit, or `"auto"` for the simplest circuit that the data support; None for `SkinRC`."""

Interval = tuple[float | None, float | None]
"""Lower and upper bound of an element [SI]; None if there is none."""

_REMEDIES: dict[type, str] = {
    Recording: "Take one from a study, as in study['s01/dry/0'], or make one with etid.Recording",
    Driver: "Identify one with etid.identify_driver",
    Study: "Open a file with etid.read, or use etid.Study.from_recordings",
    AbstractCircuit: "Pass a circuit, as in etid.SkinRC() or etid.circuit('R0-p(R1,C1)'), or "
    "circuit='auto'",
}


def require(field: str, value: object, kind: type, remedy: str = "") -> None:
    """Refuse an argument that is not an instance of a class.

    Args:
        field: Name of the argument.
        value: The argument.
        kind: The class that it must have.
        remedy: What the user should do; not needed for classes of etid.

    Raises:
        RecordingError: The argument has another type. The message says so if it is the class
            itself instead of an instance.
    """
    if isinstance(value, kind):
        return
    if isinstance(value, type) and issubclass(value, kind):
        what = f"the class {value.__name__}"
        remedy = f"Pass an instance, {value.__name__}()" if kind is AbstractCircuit else remedy
    else:
        what = "None" if value is None else f"{type(value).__name__} {reprlib.repr(value)}"
    raise RecordingError(
        f"is {what}, must be of type {kind.__name__}",
        field=field,
        remedy=remedy or _REMEDIES.get(kind, ""),
    )


def recordings(field: str, value: Iterable[Recording]) -> list[Recording]:
    """Several recordings as a list.

    Raises:
        RecordingError: The value is not an iterable, or an item is not a recording.
    """
    if isinstance(value, Recording):
        raise RecordingError(
            "is a single recording", field=field, remedy="Put it into a list, [recording]"
        )
    if isinstance(value, str) or not isinstance(value, Iterable):
        require(field, value, Recording)
    found = list(value.values() if isinstance(value, Study) else value)
    for number, one in enumerate(found):
        require(f"{field}[{number}]", one, Recording)
    return found


def check_distinct(field: str, recordings: Sequence[Recording]) -> None:
    """Refuse a recording that is given twice: its noise would count as two measurements.

    Raises:
        RecordingError: Two recordings have the same samples of `v_out`.
    """
    first: dict[bytes, str] = {}
    for number, one in enumerate(recordings):
        check_new(f"{field}[{number}]", one, first)


def check_new(field: str, recording: Recording, first: dict[bytes, str]) -> None:
    """Refuse a recording with the samples of an earlier one; `check_distinct` for a stream.

    Args:
        field: Name of the recording in the message.
        recording: The recording.
        first: Digest of the samples of each earlier recording, and its name; grows by this one.

    Raises:
        RecordingError: An earlier recording has the same samples of `v_out`.
    """
    same = first.setdefault(hashlib.sha256(recording.v_out.tobytes()).digest(), field)
    if same != field:
        raise RecordingError(
            f"has the same samples as {same}",
            path=recording.path,
            field=field,
            remedy="Pass each recording once",
        )


def candidates_of(value: Circuit) -> tuple[AbstractCircuit, ...]:
    """The circuits to choose from: `usual_circuits` for `"auto"`, else one.

    Raises:
        RecordingError: The value is neither a linear circuit nor `"auto"`.
    """
    if isinstance(value, str) and value == AUTO:
        return usual_circuits()
    circuit = circuit_of(value)  # pyright: ignore[reportArgumentType]
    if _depends_on_current(type(circuit)):
        raise RecordingError(
            f"is {type(circuit).__name__}, which is not linear: it depends on its current",
            field="circuit",
            remedy="Use etid.identify_amplitudes",
        )
    return (circuit,)


@functools.cache
def _depends_on_current(kind: type[AbstractCircuit]) -> bool:
    """Whether circuits of a class are not linear; kept, because every fit asks."""
    impedance = eqx.filter_eval_shape(lambda: kind().impedance())  # computes nothing
    return current_dependent(impedance) is not None


def circuit_of(value: AbstractCircuit | None) -> AbstractCircuit:
    """The given circuit, or `SkinRC` if none is given.

    Raises:
        RecordingError: The value is not a circuit; a class of circuits, for instance.
    """
    if value is None:
        return SkinRC()
    require("circuit", value, AbstractCircuit)
    return value


def order_of(value: Any) -> Order:
    """The number of poles of a driver, or `"auto"`.

    Raises:
        RecordingError: The value is neither a whole number nor `"auto"`, or it exceeds
            `LARGEST_ORDER`.
    """
    remedy = f'Pass a whole number from 2 to {LARGEST_ORDER}, as in order=5, or order="auto"'
    try:
        order = operator.index(value)
    except TypeError:
        order = None
    if isinstance(value, str) and value == AUTO:
        return AUTO
    if order is None or isinstance(value, bool):
        raise RecordingError(
            f"is {reprlib.repr(value)}, must be a whole number or 'auto'",
            field="order",
            remedy=remedy,
        )
    if order > LARGEST_ORDER:
        raise RecordingError(f"is {order}, too many poles", field="order", remedy=remedy)
    return order  # `identify_driver` refuses an order below 2


def number_of(field: str, value: Any) -> float:
    """The given real number.

    Raises:
        RecordingError: The value is a text, an array of several numbers, or nothing.
    """
    try:
        if not isinstance(value, str):
            return float(value)
    except (TypeError, ValueError):
        pass
    raise RecordingError(
        f"is {reprlib.repr(value)}, must be a number", field=field, remedy="Give one number [SI]"
    )


def drift_of(value: float, asked: AbstractEstimator | None) -> float:
    """The drift of a driver.

    Args:
        value: Relative standard deviation.
        asked: The estimator of driver and loads, if one is given.

    Raises:
        ValueError: The drift is not in 0 ≤ drift < 1, or the estimator gives no standard errors
            that it could enter.
    """
    if not 0 <= value < 1:
        raise ValueError(f"driver_drift is {value}; it must be at least 0 and below 1")
    if value and asked is not None and not issubclass(asked.driver, ContinuousDriver):
        raise ValueError(
            f"driver_drift enters standard errors, and method {str(asked)!r} gives none; leave "
            "driver_drift out, or use method='maximum_likelihood' or method='output_error'"
        )
    return value


# --- The estimator --------------------------------------------------------------------------------


def estimator_of(
    method: Method | None, candidates: Sequence[AbstractCircuit] = ()
) -> AbstractEstimator | None:
    """The requested estimator; None if `method` is None, so that each recording gets its default.

    Raises:
        ValueError: No estimator has this name, or the estimator cannot identify these circuits, or
            cannot choose between them.
    """
    if method is None:
        return None
    estimator = method if isinstance(method, AbstractEstimator) else named(str(method))
    check_circuits(estimator, candidates)
    return estimator


def informed(
    fixed: Mapping[str, float] | None, prior: Mapping[str, tuple[float, float]] | None
) -> Known:
    """The elements that are known before a fit, from the arguments of a caller.

    Raises:
        RecordingError: An argument is no mapping, an element is both fixed and has a prior, or a
            value is no number.
    """
    for field, value in (("fixed", fixed), ("prior", prior)):
        if not isinstance(value, Mapping | None):
            raise RecordingError(
                f"is {reprlib.repr(value)}, must name the elements",
                field=field,
                remedy='Pass fixed={"r_s": 500.0} or prior={"r_s": (500.0, 50.0)}',
            )
    fixed, prior = dict(fixed or {}), dict(prior or {})
    for name in fixed.keys() & prior.keys():
        raise RecordingError(f"{name} is fixed and has a prior", field="prior", remedy="Remove one")
    try:
        known = [(str(name), float(value), 0.0) for name, value in fixed.items()]
        known += [(str(name), float(mean), float(std)) for name, (mean, std) in prior.items()]
    except (TypeError, ValueError):
        raise RecordingError(
            "must be numbers [SI]",
            field="prior" if prior else "fixed",
            remedy='Pass fixed={"r_s": 500.0} or prior={"r_s": (500.0, 50.0)}',
        ) from None
    return tuple(known)


def bounded(bounds: Mapping[str, Interval] | None) -> Limits:
    """The bounds of elements, from the argument of a caller. Elements are positive.

    Raises:
        RecordingError: A bound is no number.
    """
    try:
        ends = [(str(name), low, high) for name, (low, high) in dict(bounds or {}).items()]
        return tuple(
            (name, float(low or 0.0), math.inf if high is None else float(high))
            for name, low, high in ends
        )
    except (TypeError, ValueError):
        raise RecordingError(
            "must be pairs of numbers [SI] or None",
            field="bounds",
            remedy='Pass bounds={"r_s": (100.0, 2e3)}, or (100.0, None) without an upper bound',
        ) from None


def with_known(
    estimator: AbstractEstimator, known: Known, bounds: Limits = ()
) -> AbstractEstimator:
    """The estimator with elements that are known, and with bounds.

    Raises:
        ValueError: It takes no known elements.
    """
    if not known and not bounds:
        return estimator
    if not isinstance(estimator, MaximumLikelihood | OutputError):
        raise ValueError(
            f"method {str(estimator)!r} takes no known elements and no bounds; use "
            "method='maximum_likelihood' or 'output_error'"
        )
    return dataclasses.replace(estimator, known_elements=known, bounds=bounds)


class Asked(NamedTuple):
    """What a caller asks for.

    Attributes:
        estimator: The requested estimator; None for the default of each recording.
        known: Elements that are known.
        bounds: Elements with bounds.
    """

    estimator: AbstractEstimator | None = None
    known: Known = ()
    bounds: Limits = ()


def asked_of(
    method: Method | None,
    candidates: Sequence[AbstractCircuit],
    fixed: Mapping[str, float] | None,
    prior: Mapping[str, tuple[float, float]] | None,
    bounds: Mapping[str, Interval] | None,
) -> Asked:
    """What the arguments of a caller ask for.

    Raises:
        ValueError: As `estimator_of`, `informed`, `bounded` and `with_known`; or a known element is
            no element of one of these circuits, or its bounds are impossible.
    """
    asked = Asked(estimator_of(method, candidates), informed(fixed, prior), bounded(bounds))
    if asked.estimator is not None:
        with_known(asked.estimator, asked.known, asked.bounds)
    for name, *_ in asked.known if len(candidates) > 1 else ():
        without = [type(one).__name__ for one in candidates if name not in one.names()]
        if without:
            raise ValueError(
                f"{name} is known, but {' and '.join(without)} have no such element, so the choice "
                "would compare circuits with different knowledge; pass one circuit, or call "
                "select_circuit with candidates that all have it"
            )
    for circuit in candidates if asked.known else ():
        checked(asked.known, circuit)
    if asked.bounds:
        checked_limits(asked.bounds, asked.known, candidates)
    return asked


def check_circuits(estimator: AbstractEstimator, candidates: Sequence[AbstractCircuit]) -> None:
    """Raise ValueError unless an estimator can identify these circuits and choose between them."""
    if len(candidates) > 1 and not estimator.chooses:
        raise ValueError(
            f"method {str(estimator)!r} computes no likelihood, which the choice of a circuit "
            "needs; use method='maximum_likelihood'"
        )
    for circuit in candidates:
        estimator.check_circuit(circuit)


def check_default(estimator: AbstractEstimator, candidates: Sequence[AbstractCircuit]) -> None:
    """Raise ValueError if the default estimator cannot identify these circuits."""
    try:
        check_circuits(estimator, candidates)
    except ValueError as error:
        raise ValueError(
            "the record holds less than two whole pulse periods or begins in a pulse, or its "
            f"driver was identified without harmonics; {str(error).partition(';')[0]}. Record "
            "three periods or more and identify the driver with method='maximum_likelihood', or "
            "ask for method='maximum_likelihood', whose standard errors do not include the "
            "effect of aliases in a single period"
        ) from error


def for_calibrations(
    asked: AbstractEstimator | None, recordings: Sequence[Inspected]
) -> AbstractEstimator:
    """The requested estimator, or the default estimator of calibrations.

    The default is maximum likelihood if all records hold several periods. Otherwise it is output
    error: in a single period the aliases are not in the standard errors of maximum likelihood.
    """
    if asked is not None:
        return asked
    several = all(seen.periods[0] > 1 and seen.is_periodic for seen in recordings)
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def driver_of(value: Driver | None) -> Driver | None:
    """The given driver, or None.

    Raises:
        RecordingError: The value is neither.
    """
    if value is not None:
        require("driver", value, Driver)
    return value


def fed(recording: Recording, driver: Driver | None) -> tuple[Recording, AbstractFeed]:
    """A recording and its feed: the driver, or without a driver the measured current.

    Without a driver `v_th` is not used.

    Raises:
        RecordingError: An argument has another type, or the recording lacks what its feed needs.
    """
    require("recording", recording, Recording)
    driver = driver_of(driver)
    if driver is None:
        return recording.without_v_th(), MEASURED_CURRENT
    if recording.cause != driver.recorded:
        remedy = "Leave the driver out: the load is then identified from the current"
        raise not_recorded(recording.path, driver.recorded, remedy)
    return recording, driver


def for_samples(driver: Driver, periods: tuple[int, int]) -> AbstractEstimator:
    """The default estimator of arrays with this number of whole periods and samples."""
    several = isinstance(driver, HarmonicDriver) and periods[0] > 1
    return MAXIMUM_LIKELIHOOD if several else OUTPUT_ERROR


def plan(
    asked: Asked, seen: Inspected, driver: AbstractFeed
) -> tuple[AbstractEstimator, str | None]:
    """The estimator of a load, and the verdict that excludes a fit; None if it can be fitted.

    Raises:
        ValueError: The estimator cannot use this driver.
    """
    of_caller = asked.estimator
    name = preflight(seen, periodic=of_caller is not None and of_caller.lane.periodic)
    estimator = of_caller or OUTPUT_ERROR
    if name is None and isinstance(driver, HarmonicDriver | MeasuredCurrent):
        estimator = for_calibrations(of_caller, [seen])
        if of_caller is None and estimator is MAXIMUM_LIKELIHOOD and seen.by_current is not None:
            name = preflight(seen.by_current, periodic=True)
            estimator = WITH_CURRENT if name is not None or seen.has_all else estimator
    if name is None and isinstance(estimator, MaximumLikelihood) and estimator.with_current:
        if not seen.has_all:
            raise ValueError(
                f"recording {seen.recording.path!r}: method {str(estimator)!r} needs a driver and "
                "a current, and no disturbed periods; use method='maximum_likelihood'"
            )
        if seen.by_current is not None and seen.by_current.is_aliased:
            name = "biased"
    if name is None and estimator.lane.periodic and seen.is_aliased:
        name = "biased"
    estimator.check_driver(driver, seen.recording.sample_rate, seen.recording.pulse_rate)
    return with_known(estimator, asked.known, asked.bounds), name
