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
BOUND = "largest bound of an element, %"  # which no method can be better than
Rows = Sequence[Mapping[str, Any]]


def _panel(axes: Axes, rows: Rows, down: list[str], across: list[str], title: str) -> None:
    """One method: failures in grey and in numbers, silent ones with a mark; or the bounds."""
    shades = np.full((len(down), len(across)), 0.0 if title == BOUND else np.nan)
    for row in rows:
        i, j = down.index(row["row"]), across.index(row["column"])
        if title == BOUND:
            texts = [(0.0, f"{100 * row['largest_bound']:.2g}", 7, "normal")]
        else:
            shades[i, j] = failed = row["wrong"] + row["refused"]
            silent = row["silent"] > 0
            texts = [(-0.22 * silent, f"{100 * failed:.0f}", 8, "normal")]
            if silent:
                digits = 0 if row["silent"] > 0.01 else 1
                texts.append((0.24, f"{SILENT} {100 * row['silent']:.{digits}f}", 7, "bold"))
        for lower, text, size, weight in texts:
            axes.text(j, i + lower, text, ha="center", va="center", fontsize=size, weight=weight,
                      color="white" if shades[i, j] > DARK else charts.INK)  # fmt: skip
    axes.imshow(shades, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=7)
    axes.set_xticks(range(len(across)), across)
    axes.set_yticks(range(len(down)), down)
    axes.set_title(title, fontsize=9)


def draw(rows: Rows, path: pathlib.Path) -> None:
    """Draw one map from its rows of the table, as SVG or PNG."""
    methods, down, across = (
        list(dict.fromkeys(row[name] for row in rows)) for name in ("method", "row", "column")
    )
    high = -(-(len(methods) + 1) // COLUMNS)
    size = COLUMNS * PANEL[0], high * PANEL[1] + 0.8
    figure, axes = charts.new_figure(high, COLUMNS, size, sharey=True)
    panels, of = list(axes.flat), {m: [row for row in rows if row["method"] == m] for m in methods}
    for panel, method in zip(panels, methods, strict=False):
        _panel(panel, of[method], down, across, method.replace("_", " "))
    _panel(panels[len(methods)], of[methods[0]], down, across, BOUND)
    for panel in panels[len(methods) + 1 :]:
        panel.set_visible(False)
    title = f"{rows[0]['map']}: % of answers that are wrong or refused; {SILENT} % that are wrong"
    figure.suptitle(f"{title} silently", fontsize=11)
    charts.save(figure, path)
