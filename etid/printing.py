"""What people read: numbers with their units, plurals, and how objects are shown.

Inside etid all numbers are in SI units. Only text, tables and figures use the units of this module.

A class states its title, its table and its notes once, as an `Overview`. The forms in a terminal
(`print`, `repr`) and in a notebook come from this statement. No dependency of etid formats tables
for a terminal, so `Overview.text` does.
"""

import abc
import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import wadler_lindig as wl
from jaxtyping import Float

ROWS = 60  # of a table; more rows are counted only
# How a parameter is shown, by its SI unit: the usual power of ten and the symbol of the unit.
UNITS = {
    "ohm": (3, "Ω"),
    "farad": (-9, "F"),
    "henry": (-3, "H"),
    "ampere": (-3, "A"),
    "second": (-6, "s"),
    "volt": (0, "V"),
    "hertz": (0, "Hz"),
    "siemens second^alpha": (-9, "S·s^alpha"),
    "ohm second^-1/2": (3, "Ω·s^-1/2"),
    "second ohm^(1/alpha)": (-6, "s·Ω^(1/alpha)"),
    "1": (0, ""),
}
PREFIXES = {
    -15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"
}  # fmt: skip


def scaled(unit: str, value: float = np.nan, error: float = np.nan) -> tuple[float, str]:
    """Size [SI] and symbol of the unit in which a value is shown, or its error if this is larger.

    It is the usual one for numbers from 0.1 to 1000, else one with another prefix for numbers
    from 1 on. Below 1 it has no prefix where one is not needed: 200 Ω, but 0.12 nF.

    Args:
        unit: SI unit, a key of `UNITS`.
        value: The value in the SI unit.
        error: Its standard error in the SI unit; NaN if there is none.
    """
    size = max(abs(value), error) if np.isfinite(error) else abs(value)
    size /= 0.999  # 999.8 mΩ are 1 Ω
    power, symbol = UNITS[unit]
    usual = size / 10.0**power
    if symbol and np.isfinite(size) and size > 0:
        if not (1.0 if power > 0 else 0.1) <= usual < 1e3:
            power = int(np.clip(3 * np.floor(np.log10(size) / 3), min(PREFIXES), max(PREFIXES)))
    return 10.0**power, PREFIXES[power] + symbol


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
    digits = _decimals(error)
    return f"{value:10.{digits}f} ± {error:<9.{digits}f}"


def _decimals(size: float) -> int:
    """Decimals that show two significant digits of a size; 0.0998 is 0.10."""
    return min(max(1 - int(f"{size:.1e}".partition("e")[2]), 0), 9)


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
    """A part of 1 in per cent, such as `0.33 %`; a dash for none."""
    return f"{rounded(100 * part, digits)} %" if math.isfinite(part) else "-"


def between(low: float, high: float, unit: str) -> str:
    """Both ends of an interval in the scaled unit, such as `33.29 … 33.61 kΩ`.

    They are rounded to two significant digits of a quarter of the length.
    """
    scale, symbol = scaled(unit, (low + high) / 2)
    quarter = (high - low) / (4 * scale)
    if not (np.isfinite(quarter) and quarter > 0):
        return f"{low / scale:.4g} … {high / scale:.4g} {symbol}".rstrip()
    digits = _decimals(quarter)
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


@dataclasses.dataclass(frozen=True)
class Overview:
    """A title, a table and notes.

    Attributes:
        title: The first line.
        rows: Cells of text; all rows have the same number of cells.
        heads: Headings of the columns; empty if the table needs none.
        notes: Sentences after the table.
        count: Number of all rows, if `rows` are only the first `ROWS` of them.
        then: Overviews that follow.
    """

    title: str
    rows: Sequence[Sequence[str]] = ()
    heads: Sequence[str] = ()
    notes: Sequence[str] = ()
    count: int = 0
    then: "Sequence[Overview]" = ()

    @property
    def shown(self) -> Sequence[Sequence[str]]:
        """The first `ROWS` rows."""
        return self.rows[:ROWS]

    @property
    def remaining(self) -> list[str]:
        """The notes; the first one says how many rows are not shown."""
        more = max(self.count, len(self.rows)) - len(self.shown)
        return [f"… and {more} more"] * (more > 0) + list(self.notes)

    def text(self) -> str:
        """The overview as lines of text."""
        columns = [_aligned(column) for column in zip(*self.shown, strict=True)]
        if self.heads and columns:
            columns = [[head, *cells] for head, cells in zip(self.heads, columns, strict=True)]
        widths = [max(map(len, column)) for column in columns]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in zip(*columns, strict=True)
        ]
        own = "\n  ".join([self.title, *lines, *self.remaining])
        return "\n".join([own, *(one.text() for one in self.then)])

    def html(self) -> str:
        """The overview as HTML; all texts are escaped."""
        rows = [_html_row("th", self.heads)] if self.heads and self.rows else []
        rows += [_html_row("td", row) for row in self.shown]
        table = f"<table>\n{''.join(rows)}</table>\n" if rows else ""
        notes = "".join(f"<p>{html.escape(note)}</p>\n" for note in self.remaining)
        own = f"<div>\n<p><b>{html.escape(self.title)}</b></p>\n{table}{notes}</div>\n"
        return own + "".join(one.html() for one in self.then)


def _html_row(tag: str, cells: Sequence[str]) -> str:
    written = (
        f'<{tag} style="text-align: left">{html.escape(one.strip())}</{tag}>' for one in cells
    )
    return f"<tr>{''.join(written)}</tr>\n"


def _aligned(cells: Sequence[str]) -> list[str]:
    """The cells without the margins that all of them have."""
    widest = max(map(len, cells))
    padded = [cell.ljust(widest) for cell in cells]
    filled = [cell for cell in padded if cell.strip()]
    left = min((len(cell) - len(cell.lstrip()) for cell in filled), default=0)
    return [cell[left:].rstrip() for cell in padded]


class Overviewed(abc.ABC):
    """A class whose objects appear as their `Overview`."""

    @abc.abstractmethod
    def _overview(self) -> Overview:
        """What to show."""

    def __str__(self) -> str:
        try:
            return self._overview().text()
        # JAX and equinox put tracers, shapes, None and anything else into the fields of a module. A
        # `repr` must not fail then, because messages of errors contain it.
        except Exception:
            return eqx.tree_pformat(self)

    def __repr__(self) -> str:
        return str(self)

    def __pdoc__(self, **_: Any) -> wl.AbstractDoc | None:
        """The title alone inside of another object, as in the `repr` of a bound method."""
        try:
            return wl.TextDoc(f"<{self._overview().title}>")
        except Exception:  # as above
            return None

    def _repr_html_(self) -> str | None:
        try:
            return self._overview().html()
        except Exception:  # as above; a notebook then shows the `repr`
            return None


@np.errstate(over="ignore")  # a fit that failed may hold any number
def element_rows(
    units: Mapping[str, str],
    values: Float[np.ndarray, "*lane element"],
    errors: Float[np.ndarray, "*lane element"] | None = None,
) -> list[tuple[str, str, str]]:
    """Name, value with standard error, and scaled unit of each element.

    Args:
        units: SI unit of each element, by name.
        values: Values [SI]. For a batch, the least and the largest value are shown.
        errors: Standard errors [SI].
    """
    rows = []
    for i, (name, unit) in enumerate(units.items()):
        if values.ndim == 1:
            value, error = float(values[i]), np.nan if errors is None else float(errors[i])
            scale, symbol = scaled(unit, value, error)
            text = plus_minus(value / scale, error / scale)
        else:
            scale, symbol = scaled(unit)
            finite = values[..., i][np.isfinite(values[..., i])] / scale
            text = f"{finite.min():.4g} … {finite.max():.4g}" if finite.size else "-"
        rows.append((name, text, symbol))
    return rows
