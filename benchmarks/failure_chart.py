"""One page per map: a panel per method, grey by how often it has no right answer."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from benchmarks import charts

COLUMNS = 4
PANEL = (3.9, 2.5)  # [inch]
SILENT = "▲"
DARK = 0.55  # rate above which print is white


def _labels(rows: Sequence[Mapping[str, Any]], name: str) -> list[str]:
    return list(dict.fromkeys(row[name] for row in rows))


def _grid(axes: Axes, down: Sequence[str], across: Sequence[str], shades: np.ndarray) -> None:
    axes.imshow(shades, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=7)
    axes.set_xticks(range(len(across)), across)
    axes.set_yticks(range(len(down)), down)


def _panel(
    axes: Axes, rows: Sequence[Mapping[str, Any]], down: list[str], across: list[str]
) -> None:
    """One method: failures in grey and in numbers, silent ones with a mark."""
    shades = np.full((len(down), len(across)), np.nan)
    for row in rows:
        i, j = down.index(row["row"]), across.index(row["column"])
        shades[i, j] = failed = row["wrong"] + row["refused"]
        ink = "white" if failed > DARK else charts.INK
        lower = 0.22 if row["silent"] > 0 else 0.0
        axes.text(
            j, i - lower, f"{100 * failed:.0f}", ha="center", va="center", color=ink, fontsize=8
        )
        if row["silent"] > 0:
            text = f"{SILENT} {100 * row['silent']:.{0 if row['silent'] > 0.01 else 1}f}"
            axes.text(
                j, i + 0.24, text, ha="center", va="center", color=ink, fontsize=7, weight="bold"
            )
    _grid(axes, down, across, shades)


def _bounds(
    axes: Axes, rows: Sequence[Mapping[str, Any]], down: list[str], across: list[str]
) -> None:
    """The largest bound of an element, which no method can be better than."""
    for row in rows:
        i, j = down.index(row["row"]), across.index(row["column"])
        text = f"{100 * row['largest_bound']:.2g}"
        axes.text(j, i, text, ha="center", va="center", color=charts.INK, fontsize=7)
    _grid(axes, down, across, np.zeros((len(down), len(across))))


def draw(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Draw one map.

    Args:
        rows: Its rows of the table.
        path: SVG or PNG to write.
    """
    methods, down, across = (_labels(rows, name) for name in ("method", "row", "column"))
    count = len(methods) + 1
    high = -(-count // COLUMNS)
    figure, axes = charts.new_figure(
        high, COLUMNS, (COLUMNS * PANEL[0], high * PANEL[1] + 0.8), sharey=True
    )
    panels = list(axes.flat)
    for panel, method in zip(panels, methods, strict=False):
        _panel(panel, [row for row in rows if row["method"] == method], down, across)
        panel.set_title(method.replace("_", " "), fontsize=9)
    once = [row for row in rows if row["method"] == methods[0]]
    _bounds(panels[len(methods)], once, down, across)
    panels[len(methods)].set_title("largest bound of an element, %", fontsize=9)
    for panel in panels[count:]:
        panel.set_visible(False)
    figure.suptitle(
        f"{rows[0]['map']}: % of answers that are wrong or refused; "
        f"{SILENT} % that are wrong silently",
        fontsize=11,
    )
    charts.save(figure, path)
