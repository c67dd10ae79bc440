"""Maps of a display: the value of an element at each electrode."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import LogNorm

from etid.plotting.layout import Layout
from etid.plotting.style import (
    INK,
    MARKS,
    NO_BREAK,
    VIOLET,
    Canvas,
    drawable,
    key,
    legend,
    nth,
    plain,
    plain_ticks,
    symbol,
    titled,
)
from etid.printing import scaled, several
from etid.results.fits import Fits
from etid.results.verdicts import USABLE

COLOURS = "cividis"  # readers with and without red-green blindness see it alike
BY = ("subject", "session", "site", "condition")  # a map for each combination
LEAST = 1.5  # [inch] width of a map


def draw_map(canvas: Canvas, fits: Fits, element: str, layout: Layout) -> np.ndarray:
    """An element at each electrode, a map for each subject, session, site and condition.

    The colour is the median of the usable trials of an electrode, on one logarithmic scale for
    all maps. An electrode without a usable trial has a mark of its own for each verdict;
    one with an approximate trial has a ring.

    Args:
        canvas: Makes the axes; a narrow figure has fewer maps in a row.
        fits: The fits.
        element: Name of the element.
        layout: Places of the electrodes.

    Raises:
        ValueError: There is no such element, or an electrode has no place.
    """
    units = fits.circuit.units()
    if element not in units:
        raise ValueError(f"map is {element!r}, must be one of {', '.join(map(repr, units))}")
    place = layout.place(fits.labels["electrode"])
    keys = groups_of(fits)
    groups = sorted(set(keys))
    values = np.asarray(getattr(fits.circuit, element)) / scaled(units[element])[0]
    good = fits.fit.usable & drawable(values)
    norm = LogNorm(*(_round(values[good]) if good.any() else (1.0, 10.0)))
    bad = sorted({str(verdict) for verdict in fits.verdicts[~good]} - {*USABLE})
    marks = {verdict: nth(MARKS[1:], number) for number, verdict in enumerate(bad)}
    columns = min(len(groups), max(1, int(min(canvas.width / LEAST, 6))))
    rows = -(-len(groups) // columns)
    width, height = np.ptp(layout.x), np.ptp(layout.y)
    tall = 1.7 * min(max(height / max(width, 1e-9), 0.5), 4.0)
    size = (2.0 * columns + 1.4, (tall + 0.9) * rows + 0.4)
    # Titles are broken before the layout is made, which leaves 0.55 inch for labels, 0.6 for a bar.
    inch = 1 / min(max(canvas.width, LEAST), size[0])
    room = {"left": 0.55 * inch, "right": 1 - 0.6 * inch}
    axes = canvas(rows, columns, size, matrix=True, sharex=True, sharey=True, gridspec_kw=room)
    for axis, group in zip(axes.flat, groups, strict=False):
        of = np.array([one == group for one in keys])
        shown = np.unique(place[of & good])
        failed = np.setdiff1d(place[of], shown)
        medians = np.array([np.median(values[of & good & (place == one)]) for one in shown])
        inexact = np.isin(shown, place[of & (fits.verdicts == "approximate")])
        _electrodes(axis, layout, shown, medians, norm, inexact)
        for one in failed:
            verdict = str(fits.verdicts[of & (place == one)][0])
            at, mark = (1e3 * layout.x[one], 1e3 * layout.y[one]), marks.get(verdict, "x")
            axis.plot(*at, mark, ms=6, color=INK, mfc="white")
        count = f"{shown.size} of {several(shown.size + failed.size, 'electrode')}"
        name = ", ".join(plain(one).replace(" ", NO_BREAK) for one in group if one)
        titled(axis, [name, count], beside=True)
    for axis in axes.flat[len(groups) :]:
        axis.set_axis_off()
    for axis in axes.flat[max(0, len(groups) - columns) : len(groups)]:  # the last of each column
        axis.set_xlabel("x [mm]")
        axis.tick_params(labelbottom=True)
    for axis in axes[:, 0]:
        axis.set_ylabel("y [mm]")
    entries = [key(name, mark, hollow=True) for name, mark in marks.items()]
    if (good & (fits.verdicts == "approximate")).any():
        entries.append(key("approximate", "o", VIOLET, hollow=True))
    legend(axes, entries)
    figure = axes.flat[0].figure
    colours = ScalarMappable(norm, COLOURS)
    bar = figure.colorbar(colours, ax=axes, shrink=0.6, pad=0.02, panchor=(0.0, 0.5))
    bar.set_label(symbol(element, units[element]))
    plain_ticks(bar.ax.yaxis)
    return axes.ravel()


def groups_of(fits: Fits) -> list[tuple[str, ...]]:
    """Labels `BY` of each fit: those of one map are equal."""
    return list(zip(*(fits.labels[name].astype(str) for name in BY), strict=True))


def _round(values: np.ndarray) -> tuple[float, float]:
    """Limits of a scale: at least a factor of 1.2 apart."""
    middle = np.sqrt(values.min() * values.max())
    return min(values.min(), middle / 1.1), max(values.max(), middle * 1.1)


def _electrodes(
    axis: Axes,
    layout: Layout,
    shown: np.ndarray,
    values: np.ndarray,
    norm: LogNorm,
    inexact: np.ndarray,
) -> None:
    """Draw the electrodes with a value, `inexact` ones with a ring; other places are dots."""
    x, y = 1e3 * layout.x, 1e3 * layout.y
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    pitch = np.min(apart + np.where(apart > 0, 0.0, np.inf), initial=10.0)
    axis.set(xlim=(x.min() - pitch, x.max() + pitch), ylim=(y.min() - pitch, y.max() + pitch))
    axis.set_aspect("equal")
    axis.grid(False)
    axis.plot(x, y, ".", ms=2, color="0.75", zorder=1)
    size = [0.9 * pitch]  # neighbours do not touch each other
    dots = EllipseCollection(
        size, size, [0.0], units="x", cmap=COLOURS, norm=norm, array=values,
        offsets=np.column_stack([x[shown], y[shown]]), offset_transform=axis.transData,
        edgecolors=[VIOLET if one else "none" for one in inexact], linewidths=1.5, zorder=2,
    )  # fmt: skip
    axis.add_collection(dots)
