"""Values of fields as Python text and numbers, from a file or from a caller.

A wrong value of a caller is a `RecordingError`. A wrong value in a file is a ValueError here,
because only the reader knows the name of the file.
"""

import math
from typing import Any, Literal

import numpy as np

from etid.recordings.errors import RecordingError

Type = Literal["text", "paths", "label", "number", "range", "samples"]


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


def real(field: str, value: object) -> float:
    """A finite real number; text and booleans are an error."""
    number = isinstance(value, int | float | np.integer | np.floating) or (
        getattr(value, "shape", None) == () and getattr(value, "dtype", np.dtype("O")).kind in "iuf"
    )
    if not number or isinstance(value, bool) or not math.isfinite(float(value)):  # type: ignore[arg-type]  # checked on this line
        raise RecordingError(f"is {value!r}, must be a finite real number", field=field)
    return float(value)  # type: ignore[arg-type]  # checked above


def several(field: str, value: object) -> list[Any]:
    """The items of a sequence; a text is one item."""
    if isinstance(value, str):
        return [value]
    try:
        return list(value)  # type: ignore[call-overload]  # other types raise TypeError
    except TypeError:
        raise RecordingError(f"is {value!r}, must be a sequence", field=field) from None


def stored(item: Any, kind: Type) -> str | float:
    """One element of an attribute of a file, in the Python type of its field.

    Raises:
        ValueError: The element has another type; the text describes the element.
    """
    if kind in ("number", "range"):
        if not isinstance(item, int | float | np.integer | np.floating) or isinstance(item, bool):
            raise ValueError(f"is {_shown(item)}, must be a number")
        return float(item)
    if isinstance(item, bytes):
        try:
            item = item.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"is {item!r}, which is not UTF-8 text") from None
    if kind == "label" and isinstance(item, int | np.integer) and not isinstance(item, bool):
        return str(int(item))
    if not isinstance(item, str):
        what = "text or an integer" if kind == "label" else "text"
        raise ValueError(f"is {_shown(item)}, must be {what}")
    return str(item)


def _shown(item: Any) -> str:
    kind = "text " if isinstance(item, str | bytes) else ""
    return f"{kind}{item.item() if isinstance(item, np.generic) else item!r}"
