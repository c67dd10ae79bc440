"""Numbers as people write them: 98800, 98.8e3, 98k8 (IEC 60062), 98.8k or 200kHz."""

import re

from etid.recordings.errors import RecordingError

_WRITTEN = re.compile(r"(\d+)([RKkM])(\d*)|(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)([RKkM]?)")
_FACTORS = {"": 1.0, "R": 1.0, "K": 1e3, "k": 1e3, "M": 1e6}


def quantity(text: str) -> float | None:
    """The number of a text such as 98k8, 98.8k or 200kHz; None if it is none.

    The letters are k, M, and R for the point of a resistance; ohm or Hz may follow.
    """
    match = _WRITTEN.fullmatch(re.sub(r"\s*(ohm|Hz)$", "", text.strip()))
    if match is None:
        return None
    whole, middle, rest, number, last = match.groups()
    factor = _FACTORS[last if middle is None else middle]
    return factor * float(number or f"{whole}.{rest or 0}")


def number(text: str) -> float:
    """The number of an option: as Python writes it, or a `quantity`; raises ValueError if none."""
    found = quantity(text)
    return float(text) if found is None else found


def resistance(text: str, field: str = "r_load") -> float:
    """Resistance [ohm] of a text; the only reader of resistances in names, tables and options.

    Args:
        text: The text, such as 98k8. The word ohm may follow it.
        field: Name of the field, for the error.

    Raises:
        RecordingError: The text is no resistance.
    """
    found = quantity(text)
    if found is None:
        raise RecordingError(
            f"is {text!r}, which is no resistance",
            field=field,
            remedy="Write it as 98800, 98k8 or 98.8k",
        )
    return found
