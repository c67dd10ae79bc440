"""Overviews: how objects appear in a terminal (`print`, `repr`) and in a notebook.

A class states its title, its table and its notes once. Both forms come from this statement. No
dependency of etid formats tables for a terminal, so `Overview.text` does.
"""

import abc
import dataclasses
import html
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import wadler_lindig as wl
from jaxtyping import Float

from etid.circuits.display import plus_minus, scaled

ROWS = 60  # of a table; more rows are counted only


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
