"""Interactive pictures: the lines, points and bars of a picture of matplotlib, drawn by plotly.

The drawing code of a picture exists once. This module reads the finished figure.
"""

import importlib
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D

from etid.plotting import Shown, figure_of
from etid.recordings.recording import Recording
from etid.results.driver import Driver

MARKS = {
    "o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down",
    "P": "cross", "X": "x", ".": "circle",
}  # fmt: skip
DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
INCH = 100  # pixels


def interactive(
    x: Any,
    recording: Recording | None = None,
    driver: Driver | None = None,
    *,
    show: Shown = "pulse",
) -> Any:
    """The picture of `etid.plot` as a figure of plotly: zoom, hover, and `write_html`.

    Bands and annotations are left out.

    Args:
        x: As in `plot`.
        recording: As in `plot`.
        driver: As in `plot`.
        show: As in `plot`.

    Returns:
        A `plotly.graph_objects.Figure`.

    Raises:
        ImportError: plotly is not installed.
        TypeError: As in `plot`.
        ValueError: As in `plot`.
    """
    try:
        go = importlib.import_module("plotly.graph_objects")
        subplots = importlib.import_module("plotly.subplots")
    except ImportError as error:
        raise ImportError("interactive needs plotly: pip install 'etid[interactive]'") from error
    drawn = figure_of(x, recording, driver, show)
    shown = [axis for axis in drawn.axes if axis.get_visible()]
    places = [_place(axis) for axis in shown]
    rows, columns = (1 + max(place[i] for place in places) for i in (0, 1))
    figure = subplots.make_subplots(rows=rows, cols=columns)
    named: set[str] = set()
    for axis, (row, column) in zip(shown, places, strict=True):
        at = {"row": row + 1, "col": column + 1}
        for line in axis.lines:
            trace = _trace(line, named)
            if trace is not None:
                figure.add_trace(go.Scatter(**trace), **at)
        for bars in axis.collections:
            if isinstance(bars, LineCollection):
                figure.add_trace(go.Scatter(**_bars(bars)), **at)
        for update, of in ((figure.update_xaxes, axis.xaxis), (figure.update_yaxes, axis.yaxis)):
            scale = "log" if of.get_scale() == "log" else "linear"
            ticks: dict[str, Any] = {}
            texts = [tick.get_text() for tick in of.get_ticklabels()]
            if any(text and not _is_number(text) for text in texts):  # names, such as subjects
                ticks = {"tickvals": list(of.get_majorticklocs()), "ticktext": texts}
            update(title_text=plain(of.get_label_text()), type=scale, **ticks, **at)
    titles = [axis.get_title(loc="left") for axis in shown]
    width, height = drawn.get_size_inches() * INCH
    figure.update_layout(
        title=plain("<br>".join(filter(None, titles)).replace("\n", "<br>")),
        width=int(width), height=int(height) + INCH // 2, template="simple_white",
    )  # fmt: skip
    return figure


def plain(label: str) -> str:
    """A label with HTML subscripts in place of formulas, such as R<sub>s</sub>."""
    return (
        label.replace(r"_\mathrm{", "<sub>")
        .replace("}", "</sub>")
        .replace("$", "")
        .replace("\\", "")
    )


def _place(axis: Axes) -> tuple[int, int]:
    """Row and column of the axis in its figure."""
    spec = axis.get_subplotspec()
    return (0, 0) if spec is None else (spec.rowspan.start, spec.colspan.start)


def _is_number(text: str) -> bool:
    try:
        float(text.replace("\N{MINUS SIGN}", "-"))
    except ValueError:
        return text.startswith("$")  # a power of ten
    return True


def _trace(line: Line2D, named: set[str]) -> dict[str, Any] | None:
    """Arguments of a trace; None for a line without points."""
    x, y = (np.asarray(of) for of in line.get_data())
    axis = line.axes
    if x.size == 0 or axis is None or line.get_transform() != axis.transData:  # a line across
        return None
    colour, label, mark = to_hex(line.get_color()), str(line.get_label()), str(line.get_marker())
    style = line.get_linestyle()
    found: dict[str, Any] = {"x": x, "y": y, "mode": "lines", "showlegend": False}
    if mark in MARKS:
        found["mode"] = "markers" if style == "None" else "lines+markers"
        face = str(line.get_markerfacecolor())
        hollow = "-open" * (face == "white")
        found["marker"] = {"color": colour, "symbol": MARKS[mark] + hollow, "size": 7}
    found["line"] = {
        "color": colour, "width": float(line.get_linewidth()),
        "dash": DASHES.get(style if isinstance(style, str) else "", "solid"),
    }  # fmt: skip
    if not label.startswith("_"):
        found |= {"name": plain(label), "legendgroup": label, "showlegend": label not in named}
        named.add(label)
    return found


def _bars(bars: LineCollection) -> dict[str, Any]:
    """Arguments of a trace of all segments, with gaps between them."""
    parts = [np.vstack([segment, [np.nan, np.nan]]) for segment in bars.get_segments()]
    points = np.concatenate(parts) if parts else np.empty((0, 2))
    colour = to_hex(np.atleast_2d(bars.get_colors())[0])
    return {
        "x": points[:, 0], "y": points[:, 1], "mode": "lines", "showlegend": False,
        "hoverinfo": "skip", "line": {"color": colour, "width": 1},
    }  # fmt: skip
