"""Style of all pictures, and the figures that they are drawn on.

Lines differ in style as well as in colour, and points differ in shape, so that black and white
prints stay readable. The background is always white: a dark style of the reader would give dark
curves on a dark background.
"""

import os
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from etid.circuits.display import heading
from etid.recordings.replacing import replacing

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

# A letter with an index, or a time constant: no part of a path or of another word.
_SYMBOL = re.compile(
    r"(?<![\w/.$\\])(?:[A-Za-z]_[A-Za-z0-9]{1,3}|tau(?:_\w)?|alpha(?:_\w)?)(?![\w/.])"
)

# Returns the axes of a picture, [row, column]. Its arguments are rows, columns, size [inch] and
# options of `Figure.subplots`.
Canvas = Callable[..., np.ndarray]


def new_figure(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, np.ndarray]:
    """A figure outside of `matplotlib.pyplot`, with a light grid, and its axes [row, column].

    Args:
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        size: Width and height [inch].
        **options: Options of `Figure.subplots`.
    """
    with mpl.rc_context(PAPER):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        return figure, _subplots(figure, rows, columns, options)


def on_pyplot(own: tuple[float, float] | None) -> Canvas:
    """A canvas on a new figure, of its own size, that a notebook or `pyplot.show` shows."""
    import matplotlib.pyplot as plt  # here, because it chooses a backend for the whole process

    def canvas(rows: int, columns: int, size: tuple[float, float], **options: Any) -> np.ndarray:
        with mpl.rc_context(PAPER):
            figure = plt.figure(figsize=own or size, layout="constrained")
            return _subplots(figure, rows, columns, options)

    return canvas


def on_axes(axes: Sequence[Axes] | np.ndarray) -> Canvas:
    """A canvas on given axes, used in their order.

    Raises:
        ValueError: The picture needs another number of axes. The canvas raises it when it draws.
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
        # matplotlib makes ticks later, and would then use the reader's style.
        axis.tick_params(which="both", colors=INK)
    return axes


def drawable(values: np.ndarray) -> np.ndarray:
    """Whether a logarithmic axis can show the values: beyond, the ends of the axis overflow."""
    values = np.asarray(values)
    return (values > 1e-100) & (values < 1e100)


def plain_ticks(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis with limits: 10, 20, 50 if it is short, else 0.1, 1, 10.

    An axis of more than six decades keeps its powers of ten.
    """
    low, high = sorted(axis.get_view_interval())
    if 0 < low and high < 1e6 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def symbol(name: str, unit: str) -> str:
    """Label of an element: its symbol as a formula, with the scaled unit.

    `r_s` becomes an R with the subscript s; a word such as `alpha` becomes a Greek letter.
    """
    letter, _, index = name.partition("_")
    if letter in ("alpha", "beta", "tau"):
        letter = rf"\{letter}"
    elif len(letter) > 1:
        return heading(name, unit)
    else:
        letter = letter.upper()
    subscript = rf"_\mathrm{{{index}}}" if index.isalnum() else ""
    return heading(f"${letter}{subscript}$", unit)


def typeset(text: str) -> str:
    """A text with its symbols as formulas: `r_s 33.4 kΩ` begins with an R with the subscript s."""
    return _SYMBOL.sub(lambda found: symbol(found[0], "1"), text)


def titled(axis: Axes, lines: Sequence[str], *, good: bool = True) -> None:
    """Set a title on the left; red if the picture does not show a valid result."""
    color = INK if good else RED
    axis.set_title(typeset("\n".join(filter(None, lines))), loc="left", fontsize=9, color=color)


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG or SVG without a date, so that equal figures give equal files."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise ValueError(f"{path}: use the suffix .png or .svg instead of {suffix or 'none'}")
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150, metadata={"Date": None} if suffix == ".svg" else {})
