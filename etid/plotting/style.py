"""Style of all pictures, and the figures that they are drawn on.

Lines differ in style as well as in colour, and points differ in shape, so that black and white
prints stay readable. The background is always white: a dark style of the reader would give dark
curves on a dark background.
"""

import io
import os
import pathlib
import re
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from etid.circuits.display import heading
from etid.recordings.replacing import replacing
from etid.results.driver import Driver
from etid.results.fit import Fit

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
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
}
SVG: Any = {"svg.hashsalt": "etid"}

# A letter with an index, or a time constant: no part of a path or of another word.
_SYMBOL = re.compile(
    r"(?<![\w/.$\\])(?:[A-Za-z]_[A-Za-z0-9]{1,3}|tau(?:_\w)?|alpha(?:_\w)?)(?![\w/.])"
)

# Returns the axes of a picture, [row, column]. Its arguments are rows, columns, size [inch] and
# options of `Figure.subplots`.
Canvas = Callable[..., np.ndarray]


def new_figure(
    rows: int, columns: int, size: tuple[float, float], *, pyplot: bool = False, **options: Any
) -> tuple[Figure, np.ndarray]:
    """A figure with a light grid, and its axes [row, column].

    Args:
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        size: Width and height [inch].
        pyplot: Whether `matplotlib.pyplot` knows the figure, so that a notebook shows it.
        **options: Options of `Figure.subplots`.
    """
    make: Callable[..., Figure] = Figure
    if pyplot:
        import matplotlib.pyplot as plt  # here, because it chooses a backend for the whole process

        make = plt.figure
    with mpl.rc_context(PAPER):
        figure = make(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options)
        for axis in axes.flat:
            # matplotlib makes ticks later, and would then use the reader's style.
            axis.grid(True, color="0.9", linewidth=0.6)
            axis.tick_params(which="both", colors=INK)
    return figure, axes


def nth(looks: Sequence[Any], number: int) -> Any:
    """A colour, mark or dash for a series; after the last one they begin again."""
    return looks[number % len(looks)]


def key(label: str, mark: str, colour: str = INK, *, hollow: bool = False) -> Line2D:
    """An entry of a legend: a mark with its meaning."""
    face = "white" if hollow else colour
    return Line2D([], [], ls="", marker=mark, ms=4, color=colour, mfc=face, label=plain(label))


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


def plain(text: str) -> str:
    """A name from a file, in which matplotlib must see no formula: dollar signs are escaped."""
    return text.replace("$", r"\$")


def typeset(text: str) -> str:
    """A text with its symbols as formulas: `r_s 33.4 kΩ` begins with an R with the subscript s."""
    return _SYMBOL.sub(lambda found: symbol(found[0], "1"), text)


def titled(axis: Axes, lines: Sequence[str], *, good: bool = True) -> None:
    """Set a title on the left; red if the picture does not show a valid result."""
    color = INK if good else RED
    axis.set_title(typeset("\n".join(filter(None, lines))), loc="left", fontsize=9, color=color)


def judged(axis: Axes, path: str, found: Fit | Driver, *more: str) -> None:
    """Set a title of the path of the recording, the verdict, χ² and RRSE, and more lines."""
    good = found.verdict == "successful"
    words = [found.verdict if good else f"no success: {found.verdict}"]
    if np.isfinite(chi2 := float(found.chi2)):
        words.append(f"chi2 {chi2:.3g}")
    if np.isfinite(rrse := float(found.rrse)):
        words.append(f"RRSE {100 * rrse:.3g} %")
    headline = ": ".join(filter(None, [plain(path), ", ".join(words)]))
    titled(axis, [headline, *more], good=good)


def svg(figure: Figure) -> bytes:
    """A figure as SVG without dates and random names, so that equal figures give equal files."""
    buffer, dpi = io.BytesIO(), figure.dpi
    with mpl.rc_context(SVG), warnings.catch_warnings():
        # Names in a foreign script stand in the tables, too.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        # `savefig` would draw a figure twice, the first time for its layout alone.
        FigureCanvasSVG(figure)
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
            figure.set_layout_engine("none")
        figure.set_dpi(dpi)  # the layout was made with the dots of an SVG
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG or SVG; equal figures give equal files."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise ValueError(f"{path}: use the suffix .png or .svg instead of {suffix or 'none'}")
    with replacing(path) as partial:
        if suffix == ".svg":
            pathlib.Path(partial).write_bytes(svg(figure))
        else:
            figure.savefig(partial, dpi=150)
