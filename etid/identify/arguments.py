"""Types of arguments: what is of another one is refused in words, before anything is computed."""

import operator
import reprlib
from collections.abc import Iterable
from typing import Any

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import Driver

LARGEST_ORDER = 50  # of a driver: ten times the paper's; the memory of a fit grows with its square

_REMEDIES: dict[type, str] = {
    Recording: "Take one from a study, as in study['s01/dry/0'], or make one with etid.Recording",
    Driver: "Identify one with etid.identify_driver",
    Study: "Open a file with etid.read, or use etid.Study.from_recordings",
    AbstractCircuit: "Pass a circuit, as in etid.SkinRC()",
}


def require(field: str, value: object, kind: type, remedy: str = "") -> None:
    """Refuse an argument that is no instance of a class.

    Args:
        field: Name of the argument.
        value: What was passed.
        kind: The class.
        remedy: What to do about it; not needed for classes of etid.

    Raises:
        RecordingError: It is something else; a class in place of its instance is told apart.
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
        RecordingError: It is no iterable, or one of them is something else.
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
    """The circuit that was passed, or `SkinRC` where none was.

    Raises:
        RecordingError: It is something else, a class of circuits for instance.
    """
    if value is None:
        return SkinRC()
    require("circuit", value, AbstractCircuit)
    return value


def order_of(value: Any) -> int:
    """The number of poles of a driver.

    Raises:
        RecordingError: It is no whole number, or above `LARGEST_ORDER`.
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
    return order  # of one below 2 `identify_driver` says that there is no such driver
