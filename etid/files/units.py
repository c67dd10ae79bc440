"""Units of voltage, current and time in the spellings of instrument files."""

import re
from typing import NamedTuple

from etid.recordings.errors import RecordingError


class Unit(NamedTuple):
    """A unit of the values in a file.

    Attributes:
        factor: Size of the unit in its SI unit.
        si: SI unit: `volt`, `ampere` or `second`.
    """

    factor: float
    si: str


def _units() -> dict[str, Unit]:
    """All units by their spelling: symbols with short prefixes, words with long ones."""
    micro = "u", "\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"
    # "M" is missing, because "MV" can be a millivolt in capital letters or a megavolt.
    short = {"": 1.0, "k": 1e3, "m": 1e-3, **dict.fromkeys(micro, 1e-6), "n": 1e-9, "p": 1e-12}
    long = {"": 1.0, "kilo": 1e3, "milli": 1e-3, "micro": 1e-6, "nano": 1e-9, "pico": 1e-12}
    spellings = {
        "volt": ("V", "volt", "volts"),
        "ampere": ("A", "ampere", "amperes", "amp", "amps"),
        "second": ("s", "second", "seconds", "sec"),
    }
    return {
        prefix + name: Unit(factor, unit)
        for unit, (symbol, *words) in spellings.items()
        for names, prefixes in (([symbol], short), (words, long))
        for name in names
        for prefix, factor in prefixes.items()
    }


UNITS = _units()


def parse_unit(text: str) -> Unit | None:
    """Unit of a text such as `mV` or `millivolts`; None if the text is not a known unit.

    Symbols are case-sensitive; words are not.
    """
    name = text.strip()
    return UNITS.get(name) or UNITS.get(name.lower() if len(name) > 2 else name)


def with_unit(name: str) -> tuple[str, str]:
    """Name and unit of a channel, from `name [unit]` or `name (unit)`; the unit may be empty."""
    match = re.fullmatch(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]+)[\])]", name)
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
