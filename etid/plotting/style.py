"""What all pictures have in common, and where they are drawn.

Lines differ in style as well as in colour and points in shape, so that they can be told apart in
black and white. Figures are white paper whatever the page around them or the reader's own style,
which would else set dark curves on a dark ground.
"""

import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

INK = "#1a1a1a"
BLUE = "#0b62a4"
RED = "#c0392b"
COLOURS = (BLUE, RED, "#2e7d32", INK)
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*")
PAPER: Any = {
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}

# Makes the axes of a picture, [row, column], from rows, columns, size [inch] and what else
# `Figure.subplots` takes.
Canvas = Callable[..., np.ndarray]


def new_figure(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, np.ndarray]:
    """A figure that belongs to no global state, with a light grid, and its axes [row, column].

    Args:
        rows: Of axes.
        columns: Of axes.
        size: Width and height [inch].
        **options: As `Figure.subplots` takes them.
    """
    with mpl.rc_context(PAPER):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        return figure, _subplots(figure, rows, columns, options)


def on_pyplot(rows: int, columns: int, size: tuple[float, float], **options: Any) -> np.ndarray:
    """A canvas: a figure that a notebook or `matplotlib.pyplot.show` shows."""
    import matplotlib.pyplot as plt  # chooses a backend for the process: only who wants it does

    with mpl.rc_context(PAPER):
        return _subplots(plt.figure(figsize=size, layout="constrained"), rows, columns, options)


def on_axes(axes: Sequence[Axes] | np.ndarray) -> Canvas:
    """A canvas: axes that exist, in the order in which they are drawn.

    Raises:
        ValueError: They are not as many as the picture has, once it is drawn.
    """
    given = np.asarray(axes, dtype=object).ravel()

    def canvas(rows: int, columns: int, size: tuple[float, float], **options: Any) -> np.ndarray:
        if given.size != rows * columns:
            raise ValueError(f"axes holds {given.size} Axes; this picture takes {rows * columns}")
        return given.reshape(rows, columns)

    return canvas


def _subplots(figure: Figure, rows: int, columns: int, options: dict[str, Any]) -> np.ndarray:
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(True, color="0.9", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(which="both", colors=INK)  # ticks are made late, in the reader's style
    return axes


def plain_ticks(axis: Axis) -> None:
    """Numbers at 1, 2 and 5 of each decade of a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def titled(axis: Axes, lines: Sequence[str], *, good: bool = True) -> None:
    """Set a title to the left; red and bold over what must not be taken for a result."""
    look: dict[str, Any] = {"color": INK} if good else {"color": RED, "fontweight": "bold"}
    axis.set_title("\n".join(filter(None, lines)), loc="left", fontsize=9, **look)


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG or SVG, without dates, so that equal figures are equal files."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise ValueError(f"{path}: figures are written as .png or .svg, not {suffix or 'nothing'}")
    figure.savefig(path, dpi=150, metadata={"Date": None} if suffix == ".svg" else {})
