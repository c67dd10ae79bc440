"""Figures of a whole study that stay clear with 100 000 fits, because they do not draw each fit.

`each_fit` is for small studies: it draws each fit. Every function returns SVG. The SVG is the same
for the same fits.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from etid.plotting import figure_of
from etid.plotting.layout import Layout
from etid.plotting.maps import BY, groups_of
from etid.plotting.style import (
    COLOURS,
    DASHES,
    INK,
    MARKS,
    PAPER,
    drawable,
    legend,
    new_figure,
    plain,
    plain_ticks,
    svg,
    symbol,
)
from etid.printing import scaled
from etid.recordings.labels import ranked
from etid.report.tables import Components, frequent
from etid.results.driver import Driver
from etid.results.fits import Fits

NARROW = 3.0  # ratio of the largest to the smallest value; above, an axis is logarithmic
CROWD = 120  # largest number of subjects in a figure
MAPS = 24  # largest number of maps of a display, for each element
SERIES = 4  # largest number of conditions in a figure


@mpl.rc_context(PAPER)
def distributions(fits: Fits) -> bytes:
    """Distribution functions of the usable fits, for each element and condition."""
    good, units = fits.usable(), fits.circuit.units()
    figure, axes = new_figure(1, len(units), (2.6 * len(units) + 0.8, 3.0), sharey=True)
    for axis, (name, unit) in zip(axes[0], units.items(), strict=True):
        for series, condition in enumerate(frequent(fits, SERIES)):
            values = _values(good.where(condition=condition), name, unit)
            values = np.sort(values[drawable(values)])
            if size := values.size:
                below = np.linspace(0, size, min(300, size) + 1).round().astype(int)  # of 100 000
                axis.step(
                    values[np.maximum(below - 1, 0)], 100 * below / size, ls=DASHES[series],
                    where="post", color=COLOURS[series], lw=1.3,
                    label=f"{plain(_short(condition)) or 'all'} ({size})",
                )  # fmt: skip
        axis.set(xlabel=symbol(name, unit))
        _widen(axis, *axis.dataLim.intervalx)
    axes[0, 0].set_ylabel("fits below [%]")
    legend(axes)
    return svg(figure)


def _values(fits: Fits, name: str, unit: str) -> Float[np.ndarray, " fit"]:
    """An element of all fits in its scaled unit."""
    return np.asarray(getattr(fits.circuit, name)) / scaled(unit)[0]


def _widen(axis: Axes, low: float, high: float) -> None:
    """Make the axis logarithmic if the values are far apart."""
    if 0 < NARROW * low < high:
        axis.set_xscale("log")
        plain_ticks(axis.xaxis)


def quality(chi2: Float[np.ndarray, " fit"], stderr: Float[np.ndarray, " fit"]) -> bytes:
    """Histograms of χ² and of the largest relative standard error."""
    figure, axes = new_figure(1, 2, (8.0, 2.6))
    left, right = axes[0]
    left.axvline(1.0, color=INK, lw=1.0, ls=":")
    left.set(xlabel="χ² per degree of freedom", ylabel="fits")
    right.set(xlabel="largest relative standard error [%]", ylabel="fits")
    for axis, values in ((left, chi2), (right, 100 * stderr)):
        known = values[drawable(values)]
        if known.size:
            low, high = known.min(), known.max()
            space = np.geomspace if NARROW * low < high else np.linspace
            bins = space(0.99 * low, 1.01 * high, min(40, 4 + 2 * round(np.sqrt(known.size))))
            axis.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
            axis.hist(known, bins=bins.tolist(), color=COLOURS[0], edgecolor="white", lw=0.3)
            _widen(axis, low, high)
    return svg(figure)


@mpl.rc_context(PAPER)
def by_subject(fits: Fits) -> bytes:
    """Median of each subject, with bars for the middle 50 % and the middle 90 % of the fits.

    If there are more than `CROWD` subjects, the figure shows `CROWD` of them, evenly spaced in the
    order of their medians.
    """
    good, units = fits.usable(), fits.circuit.units()
    subjects, place = ranked(good.labels["subject"].astype(str))
    named = subjects.size <= 30
    conditions = frequent(fits, SERIES)
    width = min(14.0, max(8.0, 0.35 * subjects.size))
    figure, axes = new_figure(len(units), 1, (width, 2.2 * len(units)), sharex=True)
    thin = 1.0 if subjects.size <= 60 else 0.5
    for axis, (name, unit) in zip(axes[:, 0], units.items(), strict=True):
        values = _values(good, name, unit)
        for series, condition in enumerate(conditions):
            chosen = good.labels["condition"] == condition
            where, quantiles = _quantiles(place[chosen], values[chosen])
            if subjects.size > CROWD:
                where, quantiles = _thinned(quantiles)
            where = where + (series + 0.5) / len(conditions) * 0.8 - 0.4
            colour = COLOURS[series]
            axis.vlines(where, quantiles[0], quantiles[4], color=colour, lw=0.8 * thin)
            axis.vlines(where, quantiles[1], quantiles[3], color=colour, lw=2.6 * thin)
            axis.plot(
                where, quantiles[2], MARKS[series], color=colour, ms=4.5 * thin,
                label=plain(_short(condition)) or "all",
            )  # fmt: skip
        axis.set(yscale="log", ylabel=symbol(name, unit))
        plain_ticks(axis.yaxis)
    last = axes[-1, 0]
    if named:
        names = [plain(_short(subject)) or "-" for subject in subjects]
        turned = sum(map(len, names)) > 10 * width
        last.set_xticks(range(subjects.size), names, rotation=90 if turned else 0)
    elif subjects.size > CROWD:
        last.set_xticks([])
    last.set_xlabel("subject" if named else "subjects")
    legend(axes)
    return svg(figure)


def _thinned(quantiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and quantiles of at most `CROWD` subjects, in the order of their medians."""
    order = np.argsort(quantiles[2], kind="stable")
    chosen = order[np.linspace(0, order.size - 1, min(CROWD, order.size)).round().astype(int)]
    return np.linspace(0.0, CROWD - 1.0, chosen.size), quantiles[:, chosen]


def _short(name: str, length: int = 16) -> str:
    return name if len(name) <= length else name[: length - 1] + "…"


def _quantiles(place: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places that occur, and quantiles of the values at each place.

    They are those of the middle 90 % and 50 %, and the median.
    """
    order = np.argsort(place, kind="stable")
    where, starts = np.unique(place[order], return_index=True)
    levels = (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = [np.quantile(part, levels) for part in np.split(values[order], starts[1:])]
    return where.astype(float), np.array(quantiles).reshape(where.size, 5).T


@mpl.rc_context(PAPER)
def components(found: Sequence[Components], conditions: Sequence[str]) -> bytes:
    """Variations and errors of each element, side by side on one scale."""
    names = list(dict.fromkeys(one.name for one in found))
    parts = list(found[0].parts)
    figure, axes = new_figure(1, len(names), (2.4 * len(names) + 1.4, 2.6), sharey=True)
    for axis, name in zip(axes[0], names, strict=True):
        # Before the first point: an axis that has none would keep the limits of a linear one.
        axis.set(xscale="log", xlabel=f"{symbol(name, '1')} [% of the median]")
    for one in found:
        if one.condition not in conditions:
            continue
        series = conditions.index(one.condition)
        sizes = 100 * np.array(list(one.parts.values()))
        shown = drawable(sizes)
        place = np.arange(len(parts)) + 0.15 * (series - (len(conditions) - 1) / 2)
        axes[0, names.index(one.name)].plot(
            sizes[shown], place[shown], MARKS[series], color=COLOURS[series], ms=6,
            label=plain(_short(one.condition)) or "all",
        )  # fmt: skip
    for axis in axes[0]:
        low, high = axis.dataLim.intervalx
        if 0 < low <= high < np.inf:
            axis.set_xlim(low / NARROW, high * NARROW)
        plain_ticks(axis.xaxis)
    axes[0, 0].set_yticks(range(len(parts)), parts)
    axes[0, 0].set_ylim(len(parts) - 0.5, -0.5)
    legend(axes)
    return svg(figure)


def each_fit(fits: Fits) -> bytes:
    """Each fit with its standard error, by subject."""
    return svg(figure_of(_shortened(fits, ("subject", "condition", "electrode", "trial"))))


def mapped(fits: Fits) -> tuple[Fits, int]:
    """The fits of the first `MAPS` maps of a display, and the number of all maps."""
    of = fits.take(fits.labels["electrode"] != "")
    keys = groups_of(of)
    first = sorted(set(keys))
    return of.take(np.array([key in first[:MAPS] for key in keys])), len(first)


def electrodes(fits: Fits, element: str, layout: Layout) -> bytes:
    """An element at each electrode of a display, on one scale for all maps."""
    return svg(figure_of(_shortened(fits, BY), map=element, layout=layout))


def _shortened(fits: Fits, names: Sequence[str]) -> Fits:
    labels = {name: np.array([_short(str(one)) for one in fits.labels[name]]) for name in names}
    return dataclasses.replace(fits, labels={**fits.labels, **labels})


def drivers(found: Mapping[str, Driver]) -> bytes:
    """Z_th of drivers, with bands of two standard errors."""
    return svg(figure_of({plain(_short(name, 60)): driver for name, driver in found.items()}))
