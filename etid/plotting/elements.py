"""Pictures of elements: fits of a study, bounds of a scene, posteriors and profiles."""

import statistics
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from etid.circuits.display import DISPLAY
from etid.plotting.style import (
    BLUE,
    COLOURS,
    INK,
    MARKS,
    RED,
    Canvas,
    drawable,
    plain_ticks,
    symbol,
    titled,
)
from etid.recordings.fields import LABELS, check_names
from etid.results.fits import Fits
from etid.results.posterior import Posterior, Profile
from etid.simulation.bound import Bound

LEVEL = 0.95
FEW = 3  # the least number of fits that have a variation


def draw_fits(canvas: Canvas, fits: Fits, by: Sequence[str]) -> np.ndarray:
    """Elements of all fits by two labels, with standard errors; fits without success are hollow.

    A thick bar is the median of a group with the variation between its fits beyond their errors.

    Raises:
        ValueError: There are no fits, or `by` is not two labels.
        RecordingError: There is no such label.
    """
    if not len(fits):
        raise ValueError("there are no fits to draw")
    if isinstance(by, str) or len(by) != 2:
        raise ValueError(f"by is {by!r}, must be two labels, such as ('session', 'subject')")
    check_names(dict.fromkeys(by), LABELS, "label")
    units = fits.circuit.units()
    axes = canvas(len(units), 1, (7.5, 0.6 + 2.2 * len(units)), sharex=True).ravel()
    labels, second = (fits.labels[name].astype(str) for name in by)
    groups, place = np.unique(labels, return_inverse=True)
    series = np.unique(second).tolist()
    x = _side_by_side(place, second, series)
    summary = [one for one in fits.summary(*by) if one["successful"] >= FEW]
    middle = [
        groups.tolist().index(one[by[0]]) + _offset(series.index(one[by[1]]), len(series))
        for one in summary
    ]
    good = fits.verdicts == "successful"
    for axis, (name, unit) in zip(axes, units.items(), strict=True):
        scale = DISPLAY[unit][0]
        values = np.asarray(getattr(fits.circuit, name)) / scale
        errors = np.asarray(getattr(fits.stderr, name)) / scale
        known = drawable(values)
        for i, label in enumerate(series):
            of = known & (second == label)
            _points(axis, x, values, errors, of & good, i, label, hollow=False)
            _points(axis, x, values, errors, of & ~good, i, label, hollow=True)
        medians, between = (
            np.array([one[name + part] for one in summary]) / scale for part in ("", "_between")
        )
        axis.errorbar(middle, medians, between, fmt="_", ms=14, lw=2.5, color=INK, zorder=4)
        axis.set_yscale("log")
        shown = known
        if (good & known).any():  # an undetermined element may lie decades away
            low, high = values[good & known].min() / 2, values[good & known].max() * 2
            axis.set_ylim(low, high)
            shown = known & (values > low) & (values < high)
        plain_ticks(axis.yaxis)
        if not shown.all():
            axis.text(
                0.995, 0.97, f"{(~shown).sum()} without success outside", color=RED, fontsize=8,
                transform=axis.transAxes, ha="right", va="top",
            )  # fmt: skip
        if len(fits) <= 40:  # there is room for the names of the trials
            for row in np.flatnonzero(shown):
                axis.annotate(
                    str(fits.labels["trial"][row]), (x[row], values[row]), xytext=(4, 3),
                    textcoords="offset points", fontsize=7, color="0.35",
                )  # fmt: skip
        axis.set_ylabel(symbol(name, unit))
    names = [one or "-" for one in groups.tolist()]
    turned = sum(map(len, names)) > 60
    axes[-1].set_xticks(range(len(names)), names, rotation=90 if turned else 0)
    axes[-1].set_xlabel(by[0])
    _legend(axes[0], series, "" if good.all() else "without success")
    counted = ", ".join(f"{count} {name}" for name, count in fits.counts().items())
    lines = [f"{len(fits)} fits: {counted}; bars: one standard error"]
    if summary:
        lines.append("thick: medians, and the variation between fits beyond their errors")
    titled(axes[0], lines, good=bool(good.any()))
    return axes


def _offset(series: int, count: int) -> float:
    """Place of a series beside its group."""
    return (series + 0.5) * 0.8 / count - 0.4


def _side_by_side(place: np.ndarray, labels: np.ndarray, series: Sequence[str]) -> np.ndarray:
    """Horizontal position of each fit: series side by side, trials spread out."""
    width = 0.8 / len(series)
    x = place.astype(float)
    for i, label in enumerate(series):
        for group in range(place.max() + 1):
            rows = np.flatnonzero((labels == label) & (place == group))
            fan = np.linspace(-0.35, 0.35, rows.size) if rows.size > 1 else np.zeros(rows.size)
            x[rows] += _offset(i, len(series)) + fan * width
    return x


def _points(
    axis: Axes,
    x: np.ndarray,
    values: np.ndarray,
    errors: np.ndarray,
    rows: np.ndarray,
    series: int,
    label: str,
    *,
    hollow: bool,
) -> None:
    if not rows.any():
        return
    error = np.where(np.isfinite(errors[rows]), errors[rows], 0.0)
    colour = COLOURS[series % len(COLOURS)]
    axis.errorbar(
        x[rows], values[rows], error, fmt=MARKS[series % len(MARKS)], ms=4, lw=0.8, color=colour,
        markerfacecolor="white" if hollow else colour, label=label,
    )  # fmt: skip


def _legend(axis: Axes, series: Sequence[str], hollow: str, *, beside: bool = False) -> None:
    """A legend with one entry per series, and one entry that explains hollow points."""
    handles = [
        Line2D([], [], ls="", marker=MARKS[i % len(MARKS)], ms=4, color=COLOURS[i % len(COLOURS)],
               label=name)
        for i, name in enumerate(series) if name
    ]  # fmt: skip
    if hollow:
        handles.append(
            Line2D([], [], ls="", marker="o", ms=4, color=INK, mfc="white", label=hollow)
        )
    if handles:
        place = {"loc": "upper left", "bbox_to_anchor": (1, 1)} if beside else {"ncols": 4}
        axis.legend(handles=handles, frameon=False, fontsize=8, **place)


def draw_bounds(canvas: Canvas, bounds: Sequence[Bound]) -> np.ndarray:
    """Smallest relative standard errors by recording; undetermined elements are hollow."""
    height = 1.3 + 0.22 * len(bounds)
    (axis,) = axes = canvas(1, 1, (7.5, height)).ravel()
    names = list(dict.fromkeys(name for one in bounds for name in one.circuit.names()))
    known = [e for one in bounds for e in one.relative.values() if np.isfinite(e)]
    edge = 100 * max([1.0, *known])  # place of bounds that are not finite
    undetermined = []
    for i, name in enumerate(names):
        of = [(row, one) for row, one in enumerate(bounds) if name in one.relative]
        offset = 0.5 * ((i + 0.5) / len(names) - 0.5)  # so that equal errors do not overlap
        place = np.array([row + offset for row, _ in of])
        error = 100 * np.array([one.relative[name] for _, one in of])
        hollow = np.array([name in one.undetermined for _, one in of])
        colour, mark = COLOURS[i % len(COLOURS)], MARKS[i % len(MARKS)]
        for part, face in ((~hollow, colour), (hollow, "white")):
            at = np.where(np.isfinite(error), error, edge)[part]
            axis.plot(at, place[part], mark, ms=4.5, color=colour, mfc=face)
        undetermined += [one.path for (_, one), is_hollow in zip(of, hollow, strict=True)
                         if is_hollow]  # fmt: skip
    axis.set_xscale("log")
    if undetermined:
        axis.axvline(100, color=RED, lw=0.9, ls="--")  # see `Bound.undetermined`
    plain_ticks(axis.xaxis)
    axis.set_xlabel("smallest relative standard error [%]")
    axis.set_yticks(range(len(bounds)), [one.path or "-" for one in bounds])
    axis.set_ylim(len(bounds) - 0.5, -0.5)
    _legend(axis, names, "undetermined" if undetermined else "", beside=True)
    lines = []
    if undetermined:
        lines.append(
            f"{len(set(undetermined))} of {len(bounds)} recordings leave an element undetermined "
            "(100 % or more)"
        )
    titled(axis, lines, good=not undetermined)
    return axes


def draw_posterior(canvas: Canvas, posterior: Posterior) -> np.ndarray:
    """Histograms of the elements, diagrams of each two, and the normal distribution of the fit."""
    units = posterior.circuit.units()
    count = len(units)
    grid = canvas(count, count, (2.4 * count + 0.6, 2.2 * count + 0.4))
    scales = np.array([DISPLAY[unit][0] for unit in units.values()])
    draws = (
        np.stack([np.asarray(getattr(posterior.draws, name)) for name in units]) / scales[:, None]
    )
    centre = np.asarray(posterior.circuit.values()) / scales
    cov = posterior.cov / np.outer(scales, scales)
    random = np.random.default_rng(0)
    some = random.choice(posterior.weights.size, 2000, p=posterior.weights)
    ranges = [_range(values[some]) for values in draws]
    intervals = list(posterior.intervals(LEVEL).values())
    for row, (name, unit) in enumerate(units.items()):
        for column in range(count):
            axis = grid[row, column]
            if column > row:
                axis.set_visible(False)
                continue
            axis.set_xlim(ranges[column])
            axis.locator_params(axis="x", nbins=4)
            if column == row:
                ends = np.array(intervals[row]) / scales[row]
                _histogram(axis, draws[row], posterior.weights, ends, centre[row], cov[row, row])
            else:
                axis.plot(draws[column][some], draws[row][some], ".", ms=1.5, color=BLUE, alpha=0.4)
                pick = np.ix_([column, row], [column, row])
                axis.plot(*_ellipse(centre[[column, row]], cov[pick]), color=RED, lw=1.2)
                axis.set_ylim(ranges[row])
                axis.locator_params(axis="y", nbins=5)
                if column == 0:
                    axis.set_ylabel(symbol(name, unit))
            if row == count - 1:
                axis.set_xlabel(symbol(list(units)[column], list(units.values())[column]))
            else:
                axis.tick_params(labelbottom=False)
            if 0 < column < row:
                axis.tick_params(labelleft=False)
    grid[0, 0].plot([], [], color=RED, lw=1.2, label="fit ± standard error")
    place = {"loc": "upper left", "bbox_to_anchor": (1.02, 1)}
    grid[0, 0].legend(frameon=False, fontsize=8, **place).set_in_layout(False)
    title = f"{posterior.weights.size} draws, worth {posterior.effective:.0f}; shaded: 95 %"
    titled(grid[0, 0], [title])
    return grid.ravel()


def _range(values: Float[np.ndarray, " draw"]) -> tuple[float, float]:
    low, high = np.quantile(values, [0.002, 0.998])
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _histogram(
    axis: Axes,
    values: Float[np.ndarray, " draw"],
    weights: Float[np.ndarray, " draw"],
    ends: Float[np.ndarray, " end"],
    centre: float,
    variance: float,
) -> None:
    """The histogram of one element, its interval, and the normal distribution of the fit."""
    low, high = axis.get_xlim()
    bins = np.linspace(low, high, 30).tolist()
    axis.hist(values, bins=bins, weights=weights, density=True, color=BLUE, alpha=0.7)
    x = np.linspace(low, high, 200)
    normal = np.exp(-((x - centre) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    axis.plot(x, normal, color=RED, lw=1.2)
    axis.axvspan(*ends, color="0.85", lw=0, zorder=0)
    axis.set_yticks([])


def _ellipse(
    centre: Float[np.ndarray, "2"], cov: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "2 point"]:
    """The ellipse that holds 95 % of a normal distribution of two elements."""
    radius = np.sqrt(-2 * np.log(1 - LEVEL))
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return centre[:, None] + radius * np.linalg.cholesky(cov) @ circle


def draw_profile(canvas: Canvas, profile: Profile) -> np.ndarray:
    """The deviance over the values of an element, and the parabola of the standard error."""
    axes = canvas(1, 1, (5.2, 3.6)).ravel()
    axis = axes[0]
    scale = DISPLAY[profile.unit][0]
    values = profile.values / scale
    z = statistics.NormalDist().inv_cdf((1 + LEVEL) / 2)
    axis.plot(values, profile.deviance, color=BLUE, lw=1.5, label="other parameters fitted again")
    parabola = ((profile.values - profile.value) / profile.stderr) ** 2
    axis.plot(values, parabola, "--", color=RED, lw=1.2, label="fit ± standard error")
    axis.axhline(z**2, color=INK, lw=0.8, ls=":")
    axis.annotate(
        "95 %", (1, z**2), xycoords=("axes fraction", "data"), xytext=(-2, 2),
        textcoords="offset points", ha="right", va="bottom", fontsize=8,
    )  # fmt: skip
    low, high = np.clip(np.array(profile.interval(LEVEL)) / scale, values[0], values[-1])
    axis.axvspan(low, high, color="0.85", lw=0, zorder=0)
    axis.set(
        xlabel=symbol(profile.name, profile.unit), ylabel="deviance", ylim=(0.0, 10.0),
        xlim=(values[0], values[-1]),
    )  # fmt: skip
    axis.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return axes
