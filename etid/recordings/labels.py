"""Labels of recordings: as text, checked, chosen and sorted."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from etid.recordings.errors import RecordingError, near_miss

Label = str | int | np.integer


def text(field: str, value: object) -> str:
    """A label as text; integers become their decimal digits."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        value = int(value)
    elif not isinstance(value, str):
        raise RecordingError(f"is {value!r}, must be text or an integer", field=field)
    label = str(value)
    if "\0" in label or any("\ud800" <= character <= "\udfff" for character in label):
        raise RecordingError(f"{label!r} cannot be stored as UTF-8 text", field=field)
    return label


def check_names(given: Mapping[str, Any], known: Sequence[str], what: str, of: str = "") -> None:
    """Raise an error if a name is not known.

    Args:
        given: Values by name.
        known: Known names.
        what: Word for these names in the error, such as "label".
        of: Text before the name in the error, such as "v_th.".
    """
    for name in given:
        if name not in known:
            near = near_miss(name, known)
            raise RecordingError(
                f"is no {what}{f', did you mean {near}?' if near else ''}",
                field=f"{of}{name}",
                remedy=f"Use one of {', '.join(known)}",
            )


def wanted_labels(given: Mapping[str, Any], known: Sequence[str]) -> dict[str, str]:
    """Labels for a choice of recordings or fits, as text; labels that are None are ignored."""
    check_names(given, known, "label")
    return {name: text(name, value) for name, value in given.items() if value is not None}


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key that orders digits by their number: 2 before 10."""
    parts = re.split(r"([0-9]+)", name)
    # Python does not convert numbers of more than 4300 digits.
    numbers = (part.isdecimal() and len(part) < 1000 for part in parts)
    return [(int(p), "") if whole else (-1, p) for p, whole in zip(parts, numbers, strict=True)]


def ranked(names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different names, 2 before 10, and for each name its place among them."""
    found, place = np.unique(names, return_inverse=True)
    order = np.array(sorted(range(found.size), key=lambda row: natural(str(found[row]))), int)
    return found[order], np.argsort(order)[place]
