"""Units of voltage, current and time in the spellings of instrument files."""

import re
from typing import NamedTuple

from etid.recordings.errors import RecordingError

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]")

_SYMBOLS = {"V": "volt", "A": "ampere", "s": "second"}
_WORDS = {
    "volt": "volt",
    "volts": "volt",
    "ampere": "ampere",
    "amperes": "ampere",
    "amp": "ampere",
    "amps": "ampere",
    "second": "second",
    "seconds": "second",
    "sec": "second",
}
# "M" is missing, because "MV" can be a millivolt in capital letters or a megavolt.
_PREFIXES = {
    "": 1.0,
    "k": 1e3,
    "m": 1e-3,
    "u": 1e-6,
    "\N{MICRO SIGN}": 1e-6,
    "\N{GREEK SMALL LETTER MU}": 1e-6,
    "n": 1e-9,
    "p": 1e-12,
}
_LONG = {"": 1.0, "kilo": 1e3, "milli": 1e-3, "micro": 1e-6, "nano": 1e-9, "pico": 1e-12}

UNITS = {f"{prefix}{symbol}": (factor, unit)
         for symbol, unit in _SYMBOLS.items()
         for prefix, factor in _PREFIXES.items()}  # fmt: skip
UNITS |= {f"{prefix}{word}": (factor, unit)
          for word, unit in _WORDS.items()
          for prefix, factor in _LONG.items()}  # fmt: skip


class Unit(NamedTuple):
    """A unit of the values in a file.

    Attributes:
        factor: Size of the unit in its SI unit.
        si: SI unit: `volt`, `ampere` or `second`.
    """

    factor: float
    si: str


def parse_unit(text: str) -> Unit | None:
    """Unit of a text such as `mV` or `millivolts`; None if the text is not a known unit.

    Symbols are case-sensitive; words are not.
    """
    name = text.strip()
    found = UNITS.get(name) or UNITS.get(name.lower() if len(name) > 2 else name)
    return None if found is None else Unit(*found)


def with_unit(name: str) -> tuple[str, str]:
    """Name and unit of a channel, from `name [unit]` or `name (unit)`; the unit may be empty."""
    match = _WITH_UNIT.fullmatch(name)
    if match is None or not parse_unit(match["unit"]):
        return name, ""
    return match["name"], match["unit"].strip()


def one_unit(name: str, *said: str) -> str:
    """The unit of a channel that a file names in several places; empty if it names none.

    Raises:
        RecordingError: The places disagree.
    """
    found = {parse_unit(unit) or unit.strip(): unit.strip() for unit in said if unit.strip()}
    if len(found) > 1:
        raise RecordingError(
            f"the file says {' and '.join(map(repr, found.values()))} of channel {name!r}",
            remedy="Correct the one that is wrong in the file",
        )
    return next(iter(found.values()), "")
