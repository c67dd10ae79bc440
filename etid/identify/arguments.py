"""Checks of argument types: a wrong type is refused with a message before any computation."""

import operator
import reprlib
from collections.abc import Iterable
from typing import Any

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import Driver

LARGEST_ORDER = 50  # ten times the order of the paper; memory grows with the square of the order

_REMEDIES: dict[type, str] = {
    Recording: "Take one from a study, as in study['s01/dry/0'], or make one with etid.Recording",
    Driver: "Identify one with etid.identify_driver",
    Study: "Open a file with etid.read, or use etid.Study.from_recordings",
    AbstractCircuit: "Pass a circuit, as in etid.SkinRC()",
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


def circuit_of(value: AbstractCircuit | None) -> AbstractCircuit:
    """The given circuit, or `SkinRC` if none is given.

    Raises:
        RecordingError: The value is not a circuit; a class of circuits, for instance.
    """
    if value is None:
        return SkinRC()
    require("circuit", value, AbstractCircuit)
    return value


def order_of(value: Any) -> int:
    """The number of poles of a driver.

    Raises:
        RecordingError: The value is not a whole number, or it exceeds `LARGEST_ORDER`.
    """
    remedy = f"Pass a whole number from 2 to {LARGEST_ORDER}, as in order=5"
    try:
        order = operator.index(value)
    except TypeError:
        order = None
    if order is None or isinstance(value, bool):
        raise RecordingError(
            f"is {reprlib.repr(value)}, must be a whole number", field="order", remedy=remedy
        )
    if order > LARGEST_ORDER:
        raise RecordingError(f"is {order}, too many poles", field="order", remedy=remedy)
    return order  # `identify_driver` refuses an order below 2
