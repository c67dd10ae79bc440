"""Checks of recordings, drivers, circuits and numbers that a caller passes."""

import hashlib
import math
import operator
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.circuits.lookup import circuit
from etid.estimators.element_limits import Limits
from etid.estimators.element_prior import Known
from etid.printing import Overviewed, several
from etid.recordings.errors import not_recorded
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import AUTO, Driver, Order
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.study_fits import PLAUSIBLE

# Four times the order of the paper. Calibrations determine no more poles; with 50 poles an
# identification takes minutes and does not converge.
LARGEST_ORDER = 20

Interval = tuple[float | None, float | None]
"""Lower and upper bound of an element [SI]; None if there is none."""

_REMEDIES: dict[type, str] = {
    Recording: "Take one from a study, as in study['s01/dry/0'], or make one with etid.Recording",
    Driver: "Identify one with etid.identify_driver",
    Study: "Open a file with etid.read, or use etid.Study.from_recordings",
    AbstractCircuit: "Pass a circuit, as in etid.SkinRC() or 'R0-p(R1,C1)'",
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
        what = "None" if value is None else type(value).__name__
        if not isinstance(value, Overviewed | None):  # a print has many lines
            what = f"{what} {reprlib.repr(value)}"
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


def check_alike(field: str, recordings: Sequence[Recording]) -> None:
    """Refuse recordings of different lengths, rates or holds.

    Raises:
        RecordingError: There is none, or one differs from the first.
    """
    if not recordings:
        raise RecordingError("is empty", field=field, remedy="Pass the recordings in a list")

    def of(one: Recording) -> str:
        size = one.samples["v_out"].stored.size
        rates = f"sample_rate {one.sample_rate} Hz, pulse_rate {one.pulse_rate} Hz"
        held = "" if one.hold is None else f", hold {one.hold}"
        return f"{several(size, 'sample')}, {rates}{held}"

    for number, one in enumerate(recordings):
        if of(one) != of(recordings[0]):
            raise RecordingError(
                f"has {of(one)}; the first has {of(recordings[0])}",
                path=one.path,
                field=f"{field}[{number}]",
                remedy="Record all with the same settings, or cut them to one length",
            )


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


def circuit_of(value: AbstractCircuit | str | None) -> AbstractCircuit:
    """`given_circuit`, or `SkinRC` if none is given."""
    return SkinRC() if value is None else given_circuit("circuit", value)


def given_circuit(field: str, value: Any) -> AbstractCircuit:
    """The given circuit, or that of a circuit string.

    Raises:
        RecordingError: The value is not a circuit, or the circuit string cannot be read.
    """
    if isinstance(value, str):
        try:
            return circuit(value)
        except ValueError as error:
            raise RecordingError(str(error), field=field) from None
    require(field, value, AbstractCircuit)
    return cast(AbstractCircuit, value)


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


def order_of(value: Any) -> Order:
    """The number of poles of a driver, or `"auto"`.

    Raises:
        RecordingError: The value is neither a whole number from 2 to `LARGEST_ORDER` nor `"auto"`.
    """
    try:
        order = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        order = None
    if isinstance(value, str) and value == AUTO:
        return AUTO
    if order is not None and 2 <= order <= LARGEST_ORDER:
        return order
    raise RecordingError(
        f"is {reprlib.repr(value)}, must be a whole number from 2 to {LARGEST_ORDER}, or 'auto'",
        field="order",
        remedy="Pass a number of poles, such as 5, or 'auto'",
    )


def range_of(field: str, value: Any) -> tuple[float, float]:
    """A range of impedances [Ω].

    Raises:
        RecordingError: It is no pair of numbers, or it is empty.
    """
    try:
        low, high = map(float, value)
    except (TypeError, ValueError):
        low = high = math.nan
    if 0 <= low < high:
        return low, high
    raise RecordingError(
        f"is {reprlib.repr(value)}, must be the lowest and the highest impedance [ohm]",
        field=field,
        remedy=f"Pass a pair, as in {field}={PLAUSIBLE}",
    )


def known_elements(
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
    known = [
        (str(name), number_of(f"fixed[{name!r}]", value), 0.0) for name, value in fixed.items()
    ]
    for name, told in prior.items():
        try:
            mean, error = told
        except (TypeError, ValueError):
            raise RecordingError(
                f"is {reprlib.repr(told)}, must be a value and its standard deviation",
                field=f"prior[{name!r}]",
                remedy='Pass prior={"r_s": (500.0, 50.0)} [SI]',
            ) from None
        mean, error = (number_of(f"prior[{name!r}]", one) for one in (mean, error))
        known.append((str(name), mean, error))
    return tuple(known)


def bounds_of(bounds: Mapping[str, Interval] | None) -> Limits:
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


def driver_of(value: Driver | None) -> Driver | None:
    """The given driver, or None.

    Raises:
        RecordingError: The value is neither.
    """
    if value is not None:
        require("driver", value, Driver)
    return value


def check_no_filters(recording: Recording, what: str) -> None:
    """Refuse a recording whose current and V_out have passed different known filters.

    Raises:
        RecordingError: It states one, and has no `v_th`, whose filter is that of V_out.
    """
    if recording.cause == "current" and recording.filters is not None:
        raise RecordingError(
            f"has a known filter of one channel, which {what} does not take",
            field="recording",
            remedy="Use identify_skin or identify_skins",
        ).located(path=recording.path)


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
