"""Resistances as people write them: 98800, 98.8e3, 98k8 (IEC 60062) or 98.8k."""

import re

from etid.recordings.errors import RecordingError

_WRITTEN = re.compile(r"(\d+)([RKkM])(\d*)|(\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)([RKkM]?)")
_FACTORS = {"": 1.0, "R": 1.0, "K": 1e3, "k": 1e3, "M": 1e6}


def resistance(text: str, field: str = "r_load") -> float:
    """Resistance [ohm] of a text; the only reader of resistances in names, tables and options.

    Args:
        text: The text, such as 98k8. The word ohm may follow it.
        field: Name of the field, for the error.

    Raises:
        RecordingError: The text is no resistance.
    """
    match = _WRITTEN.fullmatch(text.strip().removesuffix("ohm").rstrip())
    if match is None:
        raise RecordingError(
            f"is {text!r}, which is no resistance",
            field=field,
            remedy="Write it as 98800, 98k8 or 98.8k",
        )
    whole, middle, rest, number, last = match.groups()
    factor = _FACTORS[last if middle is None else middle]
    return factor * float(number or f"{whole}.{rest or 0}")
