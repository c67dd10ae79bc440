"""Style of all pictures, and the figures that they are drawn on.

Lines differ in style as well as in colour, and points differ in shape, so that black and white
prints stay readable. The background is always white: a dark style of the reader would give dark
curves on a dark background.
"""

import dataclasses
import io
import os
import pathlib
import re
import textwrap
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from etid.printing import heading, rounded
from etid.recordings.replacing import replacing
from etid.results.data import AnyAxes, Size
from etid.results.driver import Driver
from etid.results.fit import Fit

NARROW = 2.0  # [inch] columns of panels that would be narrower stand below each other
NO_BREAK = "\u00a0"
EM = 0.55  # mean width of a character, relative to the size of the font
INK = "#1a1a1a"
BLUE = "#0b62a4"
ORANGE = "#e07b00"
RED = "#c0392b"  # of what cannot be used, and of nothing else
VIOLET = "#8e44ad"  # of what is approximate, and of nothing else
COLOURS = (BLUE, ORANGE, "#2e7d32", INK)
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
    "axes.formatter.useoffset": False,  # a tick of 185.82 is not 0.02 + 1.858e2
    "legend.frameon": False,
    "legend.fontsize": 8,
}

# A letter with an index, or a time constant: no part of a path or of another word.
_SYMBOL = re.compile(
    r"(?<![\w/.$\\])(?:[A-Za-z]_[A-Za-z0-9]{1,3}|tau(?:_\w)?|alpha(?:_\w)?)(?![\w/.])"
)


@dataclasses.dataclass(frozen=True, eq=False)
class Canvas:
    """Makes the axes of a picture, [row, column], or has those of the caller.

    Attributes:
        axes: Axes to draw on; without them, a figure is made.
        size: Width and height of this figure [inch], in place of the usual one.
        pyplot: As in `new_figure`.
    """

    axes: AnyAxes = None
    size: Size = None
    pyplot: bool = False

    @property
    def width(self) -> float:
        """Width of the figure [inch]; infinite if the picture chooses it."""
        return np.inf if self.size is None else self.size[0]

    def __call__(
        self, rows: int, columns: int, usual: tuple[float, float], **options: Any
    ) -> np.ndarray:
        """The axes; `options` as `new_figure` takes them.

        Raises:
            ValueError: The caller has another number of axes.
        """
        if self.axes is None:
            return new_figure(rows, columns, self.size or usual, pyplot=self.pyplot, **options)[1]
        given = np.asarray(self.axes, dtype=object)
        if given.size != rows * columns:
            raise ValueError(f"axes holds {given.size} Axes; this picture takes {rows * columns}")
        return given.reshape(rows, columns)

    def three(self, usual: tuple[float, float], *, wide: bool = False) -> np.ndarray:
        """Three axes: the first beside the two others and as tall, or above them and as `wide`."""
        if self.axes is not None or self.width < 2 * NARROW:
            return self(1, 3, usual).ravel()
        grid = self(2, 2, usual)
        whole = grid[0, 0].get_gridspec()
        grid[0, 0].set_subplotspec(whole[0, :] if wide else whole[:, 0])
        spare = grid[0, 1] if wide else grid[1, 0]
        spare.remove()
        return np.array([axis for axis in grid.flat if axis is not spare])


def new_figure(
    rows: int,
    columns: int,
    size: tuple[float, float],
    *,
    pyplot: bool = False,
    matrix: bool = False,
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """A figure with a light grid, and its axes [row, column].

    In a narrow figure, as for the column of a paper, the columns of panels stand below each other.

    Args:
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        size: Width and height [inch].
        pyplot: Whether `matplotlib.pyplot` knows the figure, so that a notebook shows it.
        matrix: Whether the panels keep their places in a narrow figure, too.
        **options: Options of `Figure.subplots`.
    """
    make: Callable[..., Figure] = Figure
    if pyplot:
        import matplotlib.pyplot as plt  # here, because it chooses a backend for the whole process

        make = plt.figure
    with mpl.rc_context(PAPER):
        figure = make(figsize=size, layout="constrained")
        if matrix or size[0] >= NARROW * columns:
            axes = figure.subplots(rows, columns, squeeze=False, **options)
        else:
            axes = _stacked(figure, rows, columns, **options)
            columns = 1
        for axis in axes.flat:
            # 1.3 ticks over an inch: five digits have room between two.
            axis.locator_params(axis="x", nbins=int(np.clip(1.3 * size[0] / columns, 2, 9)))
            # matplotlib makes ticks later, and would then use the reader's style.
            axis.grid(True, color="0.9", linewidth=0.6)
            axis.tick_params(which="both", colors=INK)
    return figure, axes


def _stacked(
    figure: Figure, rows: int, columns: int, *, sharex: str | bool = False, **options: Any
) -> np.ndarray:
    """Panels below each other, a column after another, as axes [row, column]."""
    ratios = options.pop("gridspec_kw", {}).get("height_ratios", [1.0] * rows)
    axes = figure.subplots(rows * columns, 1, height_ratios=[*ratios] * columns, **options)
    axes = axes.reshape(columns, rows).T
    if sharex in (True, "all", "col"):
        for *above, last in axes.T:
            for axis in above:
                axis.sharex(last)
                axis.tick_params(labelbottom=False)
    return axes


def legend(axes: np.ndarray, handles: Sequence[Any] | None = None) -> None:
    """A legend below a picture, with as many columns as have room.

    On axes of the caller, whose figure may hold more or have no room, it is a frame in the first.

    Args:
        axes: All axes of the picture.
        handles: Entries of the legend; if not given, those of the first axes.
    """
    first = axes.flat[0]
    figure, size = first.figure, float(mpl.rcParams["legend.fontsize"])
    handles = first.get_legend_handles_labels()[0] if handles is None else handles
    if not handles:
        return
    own = isinstance(figure, Figure) and len(figure.axes) == axes.size
    if not own or not isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
        first.legend(handles=handles, frameon=True)
        return
    room, beside = figure.get_figwidth(), 5 * size / 72  # [inch] an entry has a mark and spaces
    labels = [wrapped(str(one.get_label()), room - beside, size) for one in handles]
    lengths = [max(map(len, _unset(label).split("\n"))) for label in labels]
    widths = EM * size / 72 * np.array(lengths) + beside

    def has_room(columns: int) -> bool:
        return bool(sum(map(max, np.array_split(widths, columns))) <= room)

    columns = next(filter(has_room, range(len(handles), 1, -1)), 1)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def _unset(text: str) -> str:
    """About what is seen of a text with formulas."""
    return re.sub(r"\\[A-Za-z]+|[${}_]", "", text)


def wrapped(text: str, inches: float, size: float) -> str:
    """A text whose lines are broken where letters of this size [points] leave the room."""
    count = max(8, int(72 * inches / (EM * size)))
    lines = []
    for line in text.split("\n"):
        held = max(map(len, line.split(" "))) <= count  # else what belongs together is broken, too
        free = line if held else line.replace(NO_BREAK, " ")
        lines += textwrap.wrap(free, count, break_on_hyphens=not held)
    return "\n".join(lines).replace(NO_BREAK, " ")


def without_elements(axis: Axes, text: str = "no elements") -> None:
    """Say in an empty panel why it is empty."""
    axis.text(0.5, 0.5, text, color=RED, transform=axis.transAxes, ha="center", va="center")
    axis.set(xticks=[], yticks=[])


def nth(looks: Sequence[Any], number: int) -> Any:
    """A colour, mark or dash for a series; after the last one they begin again."""
    return looks[number % len(looks)]


def key(label: str, mark: str, colour: str = INK, *, hollow: bool = False) -> Line2D:
    """An entry of a legend: a mark with its meaning."""
    face = "white" if hollow else colour
    return Line2D([], [], ls="", marker=mark, ms=4, color=colour, mfc=face, label=label)


def drawable(values: np.ndarray) -> np.ndarray:
    """Whether a logarithmic axis can show the values: beyond, the ends of the axis overflow."""
    values = np.asarray(values)
    return (values > 1e-100) & (values < 1e100)


def plain_ticks(axis: Axis, short: float = 1e3) -> None:
    """Plain numbers on a logarithmic axis with limits: 10, 20, 50 if it is short, else 0.1, 1, 10.

    An axis of more than six decades keeps its powers of ten.

    Args:
        axis: The axis.
        short: Upper over lower limit of the longest axis with 20 and 50.
    """
    low, high = sorted(axis.get_view_interval())
    if 0 < low and high < 1e6 * low:
        steps = LogLocator(subs=(1.0, 2.0, 5.0) if high < short * low else (1.0,))
        few = sum(low <= tick <= high for tick in steps.tick_values(low, high)) < 2
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]) if few else steps)
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


def titled(axis: Axes, lines: Sequence[str], *, good: bool = True, beside: bool = False) -> None:
    """Set a title on the left; red if the picture does not show a valid result.

    Args:
        axis: The first axes of the picture.
        lines: Lines of the title; they are broken at the edge of the figure.
        good: Whether the result is valid.
        beside: Whether axes on the right have titles too, so that lines are broken before them.
    """
    panel, whole, dpi = axis.bbox, axis.figure.bbox, axis.figure.dpi
    # Axes with labels have about 0.75 inch on the left.
    room = panel.width if beside else min(whole.x1 - panel.x0, whole.width - 0.75 * dpi)
    text = wrapped("\n".join(filter(None, lines)), room / dpi, size := 9.0)
    axis.set_title(typeset(text), loc="left", fontsize=size, color=INK if good else RED)


def listed(fit: Fit) -> list[str]:
    """The elements of a fit as a line of a title; empty if it has none."""
    if not np.isfinite(np.asarray(fit.circuit.values())).all():
        return []
    return [",  ".join(one.replace(" ", NO_BREAK) for one in fit.elements)]


def judged(axis: Axes, path: str, found: Fit | Driver, *more: str) -> None:
    """Set a title of the path of the recording, the verdict, χ² and RRSE, and more lines."""
    good = found.usable
    words = [found.verdict if good else f"unusable: {found.verdict}"]
    if np.isfinite(chi2 := float(found.chi2)):
        words.append(f"χ² {rounded(chi2, 3)}")
    if np.isfinite(rrse := float(found.rrse)):
        words.append(f"RRSE {rounded(100 * rrse, 3)} %")
    words = [one.replace(" ", NO_BREAK) for one in words]
    headline = ": ".join(filter(None, [plain(path), ", ".join(words)]))
    titled(axis, [headline, *more], good=good)


def svg(figure: Figure) -> bytes:
    """A figure as SVG without dates and random names, so that equal figures give equal files."""
    buffer, dpi = io.BytesIO(), figure.dpi
    usual: Any = {"svg.hashsalt": "etid"}
    with mpl.rc_context(usual), warnings.catch_warnings():
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
