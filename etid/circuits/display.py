"""Text for parameters: scaled units, and a value with its standard error.

Inside etid all numbers are in SI units. Only text, tables and figures use the units of this module.
"""

import math
from collections.abc import Sequence

import numpy as np

# Unit for the display of a parameter, by its SI unit: size in the SI unit, and symbol.
DISPLAY = {
    "ohm": (1e3, "kΩ"),
    "farad": (1e-9, "nF"),
    "henry": (1e-3, "mH"),
    "ampere": (1e-3, "mA"),
    "second": (1e-6, "µs"),
    "siemens second^alpha": (1e-9, "nS·s^alpha"),
    "ohm second^-1/2": (1e3, "kΩ·s^-1/2"),
    "second ohm^(1/alpha)": (1e-6, "µs·Ω^(1/alpha)"),
    "1": (1.0, ""),
}


SYMBOLS = {
    "ohm": "Ω",
    "farad": "F",
    "henry": "H",
    "second": "s",
    "ampere": "A",
    "volt": "V",
    "hertz": "Hz",
    "siemens second^alpha": "S·s^alpha",
    "ohm second^-1/2": "Ω·s^-1/2",
    "second ohm^(1/alpha)": "s·Ω^(1/alpha)",
}
PREFIXES = {
    -15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"
}  # fmt: skip


def scaled(unit: str, value: float = np.nan, error: float = np.nan) -> tuple[float, str]:
    """Size [SI] and symbol of the unit in which a value is shown, or its error if this is larger.

    It is that of `DISPLAY` for numbers from 0.1 to 1000, else one with another prefix for numbers
    from 1 on. Below 1 it has no prefix where one is not needed: 200 Ω, but 0.12 nF.

    Args:
        unit: SI unit, a key of `DISPLAY`.
        value: The value in the SI unit.
        error: Its standard error in the SI unit; NaN if there is none.
    """
    size = max(abs(value), error) if np.isfinite(error) else abs(value)
    size /= 0.999  # 999.8 mΩ are 1 Ω
    usual = DISPLAY[unit][0]
    known = np.isfinite(size) and size > 0 and unit in SYMBOLS
    if not known or (1.0 if usual > 1 else 0.1) <= size / usual < 1e3:
        return DISPLAY[unit]
    power = int(np.clip(3 * np.floor(np.log10(size) / 3), min(PREFIXES), max(PREFIXES)))
    return 10.0**power, PREFIXES[power] + SYMBOLS[unit]


def number(value: float, form: str) -> str:
    """A number in a format of Python such as `.3g`; a dash for what is not a finite number."""
    return format(value, form) if math.isfinite(value) else "-"


def as_symbol(name: str) -> str:
    """An element as people write it, such as `R_s` for `r_s`; a word such as `alpha` stays."""
    letter, _, index = name.partition("_")
    return name if len(letter) > 1 else "_".join(filter(None, (letter.upper(), index)))


def heading(name: str, unit: str, value: float = np.nan) -> str:
    """Name and scaled unit of a parameter of about this value [SI], such as `r_s [kΩ]`."""
    symbol = scaled(unit, value)[1]
    return f"{name} [{symbol}]" if symbol else name


def plus_minus(value: float, error: float) -> str:
    """A value with its standard error, padded for a column.

    Both are rounded to two significant digits of the error. Without an error, the value has four
    significant digits. The error of a fixed element, 1e-9 of it, is shown as 0. From 1e10 on, both
    are powers of ten. A value that is not a finite number is a dash.
    """
    if not math.isfinite(value):
        return f"{'-':>10}            "
    if not np.isfinite(error) or error <= 0:
        return f"{value:10.4g}            "
    if error < 1e-8 * abs(value):
        return f"{value:10.7g} ± {0:<9}"
    if max(abs(value), error) >= 1e10:
        return f"{value:10.4g} ± {error:<9.2g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 9))
    return f"{value:10.{digits}f} ± {error:<9.{digits}f}"


def significant(value: float, digits: int = 2) -> str:
    """A number with `digits` significant digits, such as `970`; empty if it is not finite.

    From 1e6 on and below 1e-6 it is a power of ten.
    """
    if not math.isfinite(value):
        return ""
    rounded = f"{value:.{digits - 1}e}"
    if abs(value) >= 1e6 or 0 < abs(value) < 1e-6:
        return rounded
    decimals = max(0, digits - 1 - int(rounded.partition("e")[2]))
    return f"{float(rounded):.{decimals}f}" if value else "0"


def rounded(value: float, digits: int = 2) -> str:
    """A number for a sentence: as `significant`, without zeros at the end; a dash for none."""
    text = significant(value, digits)
    if "e" in text:
        return f"{value:.{digits}g}"
    return (text.rstrip("0").rstrip(".") if "." in text else text) or "-"


def per_cent(part: float, digits: int = 2) -> str:
    """A part of 1 in per cent, such as `0.33 %`."""
    return f"{rounded(100 * part, digits)} %"


def between(low: float, high: float, unit: str) -> str:
    """Both ends of an interval in the scaled unit, such as `33.29 … 33.61 kΩ`.

    They are rounded to two significant digits of a quarter of the length.
    """
    scale, symbol = scaled(unit, (low + high) / 2)
    quarter = (high - low) / (4 * scale)
    if not (np.isfinite(quarter) and quarter > 0):
        return f"{low / scale:.4g} … {high / scale:.4g} {symbol}".rstrip()
    digits = int(np.clip(1 - np.floor(np.log10(quarter)), 0, 9))
    return f"{low / scale:.{digits}f} … {high / scale:.{digits}f} {symbol}".rstrip()


def quality(rrse: float, chi2: float = math.nan) -> str:
    """A root relative squared error, and χ² if it is finite.

    An estimate that diverges predicts nothing.
    """
    parts = [f"RRSE {per_cent(rrse, 3)}" if math.isfinite(rrse) else "no finite prediction"]
    return ", ".join([*parts, f"chi2 {rounded(chi2, 3)}"][: 1 + math.isfinite(chi2)])


def several(count: int | str, noun: str) -> str:
    """A number of things, such as `1 recording`, `2 recordings` or `3 frequencies`."""
    if str(count) == "1":
        return f"1 {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("cy") else f"{count} {noun}s"


def first_of(names: Sequence[str], most: int) -> str:
    """The first names of a list, and how many more it has."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def quantity(value: float, unit: str, error: float = np.nan) -> str:
    """A parameter in its scaled unit, such as `33.40 ± 0.10 kΩ`, or `33.4 kΩ` without an error."""
    scale, symbol = scaled(unit, value, error)
    return " ".join([*plus_minus(value / scale, error / scale).split(), symbol]).rstrip()
