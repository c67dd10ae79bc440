"""Pictures of elements: fits of a study, bounds of a scene, posteriors and profiles."""

import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from etid.plotting.style import (
    BLUE,
    COLOURS,
    INK,
    MARKS,
    NARROW,
    ORANGE,
    RED,
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
from etid.printing import per_cent, scaled, several
from etid.recordings.fields import LABELS
from etid.recordings.labels import check_names, ranked
from etid.results.fits import Fits
from etid.results.posterior import Posterior, Profile
from etid.results.verdicts import counted
from etid.simulation.bound import Bound

LEVEL = 0.95


def draw_fits(canvas: Canvas, fits: Fits, by: Sequence[str]) -> np.ndarray:
    """Elements of all fits by two labels, with standard errors; unusable fits are hollow.

    Approximate fits have a colour of their own.
    A thick bar is the median of a group with the variation between its fits beyond their errors.

    Raises:
        ValueError: `by` is not two labels.
        RecordingError: There is no such label.
    """
    if isinstance(by, str) or len(by) != 2:
        raise ValueError(f"by is {by!r}, must be two labels, such as ('session', 'subject')")
    check_names(dict.fromkeys(by), LABELS, "label")
    units = fits.circuit.units()
    axes = canvas(len(units), 1, (7.5, 0.6 + 2.2 * len(units)), sharex=True).ravel()
    labels, second = (fits.labels[name].astype(str) for name in by)
    groups, place = ranked(labels)
    series = np.unique(second).tolist()
    width = 0.8 / len(series)
    beside = {label: (i + 0.5) * width - 0.4 for i, label in enumerate(series)}
    x = place + np.array([beside[label] for label in second.tolist()])
    has = np.isfinite(np.asarray(fits.circuit.values())).all(-1)
    for label in series:
        for group in range(groups.size):
            (trials,) = np.nonzero((second == label) & (place == group) & has)
            if trials.size > 1:
                x[trials] += width * np.linspace(-0.35, 0.35, trials.size)
    # Fewer fits have no variation.
    summary = [one for one in fits.summary(*by) if one["usable"] >= 3]
    middle = [groups.tolist().index(one[by[0]]) + beside[one[by[1]]] for one in summary]
    good, inexact = fits.fit.usable, fits.verdicts == "approximate"
    room = len(fits) <= 40 and axes[0].figure.get_figwidth() > 5
    beside_points = _distinct(fits, by) if room else ""
    hollow = False
    for axis, (name, unit) in zip(axes, units.items(), strict=True):
        scale = scaled(unit)[0]
        values = np.asarray(getattr(fits.circuit, name)) / scale
        errors = np.asarray(getattr(fits.stderr, name)) / scale
        errors = np.where(np.isfinite(errors), errors, 0.0)
        known = drawable(values)
        for i, label in enumerate(series):
            colour, mark = nth(COLOURS, i), nth(MARKS, i)
            for of, face in ((good & ~inexact, colour), (inexact, VIOLET), (~good, "white")):
                some = known & (second == label) & of
                axis.errorbar(
                    x[some], values[some], errors[some], fmt=mark, ms=4, lw=0.8, color=colour,
                    markerfacecolor=face,
                )  # fmt: skip
        medians, between = (
            np.array([one[name + part] for one in summary]) / scale for part in ("", "_between")
        )
        axis.errorbar(middle, medians, between, fmt="_", ms=14, lw=2.5, color=INK, zorder=4)
        axis.set_yscale("log")
        axis.set_xlim(-0.5, groups.size - 0.5)
        shown = known
        if (good & known).any():  # an undetermined element may lie decades away
            low, high = values[good & known].min() / 1.4, values[good & known].max() * 1.4
            high *= (high / low) ** 0.2  # room for the texts above the points
            axis.set_ylim(low, high)
            shown = known & (values > low) & (values < high)
        plain_ticks(axis.yaxis)
        hollow |= bool((shown & ~good).any())
        hidden = {"unusable outside": known & ~shown, "without elements": ~known}
        told = [f"{of.sum()} {where}" for where, of in hidden.items() if of.any()]
        sizes = (errors / values)[good & known & (errors > 0)]
        if sizes.size:  # on an axis of decades the bars of small errors are hidden by their points
            axis.text(
                0.005, 0.97, f"median error {per_cent(float(np.median(sizes)))}", color="0.35",
                fontsize=8, transform=axis.transAxes, va="top",
            )  # fmt: skip
        axis.text(
            0.995, 0.97, ", ".join(told), color=RED, fontsize=8, transform=axis.transAxes,
            ha="right", va="top",
        )  # fmt: skip
        if beside_points:
            for row in np.flatnonzero(shown):
                told_apart = plain(str(fits.labels[beside_points][row]))
                axis.annotate(
                    told_apart, (x[row], values[row]), xytext=(4, 3), textcoords="offset points",
                    fontsize=7, color="0.35",
                )  # fmt: skip
        axis.set_ylabel(symbol(name, unit))
    names = [plain(one) or "-" for one in groups.tolist()]
    turned = sum(map(len, names)) > 8 * axes[-1].figure.get_figwidth()
    axes[-1].set_xticks(range(len(names)), names, rotation=90 if turned else 0)
    axes[-1].set_xlabel(by[0])
    entries = _series(list(map(plain, series)))
    if inexact.any():
        entries.append(key("approximate", "o", VIOLET))
    if hollow:
        entries.append(key("unusable", "o", hollow=True))
    legend(axes, entries)
    bars = "bars: one standard error"
    if summary:
        bars += "; thick: medians, and the variation between fits beyond their errors"
    lines = [f"{several(len(fits), 'fit')}: {counted(fits.verdicts)}", bars]
    if beside_points:
        lines.append(f"beside the points: {beside_points}")
    if pooled := fits.pooled(*by):
        lines.append(f"pooled: {', '.join(f'{name}s' for name in pooled)}")
    titled(axes[0], lines, good=bool(good.any()))
    return axes


def _distinct(fits: Fits, by: Sequence[str]) -> str:
    """The label that tells most fits of a group from each other; empty if none does."""
    groups = list(zip(*(fits.labels[name].tolist() for name in by), strict=True))

    def different(name: str) -> int:
        return len(set(zip(groups, fits.labels[name].tolist(), strict=True)))

    best = max((name for name in ("trial", "electrode", "session", "site")), key=different)
    return best if different(best) > len(set(groups)) else ""


def _series(names: Sequence[str]) -> list[Any]:
    """An entry of a legend for each series."""
    return [key(name, nth(MARKS, i), nth(COLOURS, i)) for i, name in enumerate(names) if name]


def draw_bounds(canvas: Canvas, bounds: Sequence[Bound]) -> np.ndarray:
    """Smallest relative standard errors by recording; undetermined elements are hollow."""
    (axis,) = axes = canvas(1, 1, (7.5, 1.3 + 0.22 * len(bounds))).ravel()
    names = list(dict.fromkeys(name for one in bounds for name in one.circuit.names()))
    known = [e for one in bounds for e in one.relative.values() if np.isfinite(e)]
    edge = 100 * max([1.0, *known])  # place of bounds that are not finite
    for i, name in enumerate(names):
        offset = 0.5 * ((i + 0.5) / len(names) - 0.5)  # so that equal errors do not overlap
        for row, one in enumerate(bounds):
            if name in one.relative:
                error, hollow = 100 * one.relative[name], name in one.undetermined
                axis.plot(
                    error if np.isfinite(error) else edge, row + offset, nth(MARKS, i), ms=4.5,
                    color=nth(COLOURS, i), mfc="white" if hollow else nth(COLOURS, i),
                )  # fmt: skip
    axis.set_xscale("log")
    undetermined = {one.path for one in bounds if one.undetermined}
    lines = []
    if undetermined:
        axis.axvline(100, color=RED, lw=0.9, ls="--")  # see `Bound.undetermined`
        lines.append(
            f"undetermined elements (100 % or more) in {len(undetermined)} of "
            f"{several(len(bounds), 'recording')}"
        )
    plain_ticks(axis.xaxis)
    axis.set_xlabel("smallest standard error [%]")
    axis.set_yticks(range(len(bounds)), [plain(one.path) or "-" for one in bounds])
    axis.set_ylim(len(bounds) - 0.5, -0.5)
    named = [symbol(name, "1") for name in names]
    hollow = [key("undetermined", "o", hollow=True)] if undetermined else []
    legend(axes, [*_series(named), *hollow])
    titled(axis, lines, good=not undetermined)
    return axes


def draw_posterior(canvas: Canvas, posterior: Posterior) -> np.ndarray:
    """Histograms of the elements, diagrams of each two, and the normal distribution of the fit."""
    units = posterior.circuit.units()
    count = len(units)
    grid = canvas(count, count, (2.4 * count + 0.6, 2.2 * count + 0.4), matrix=True)
    narrow = grid[0, 0].figure.get_figwidth() < NARROW * count
    scales = np.array([scaled(unit)[0] for unit in units.values()])
    labels = [symbol(name, unit) for name, unit in units.items()]
    draws = np.asarray(posterior.draws.values()).T / scales[:, None]
    centre = np.asarray(posterior.circuit.values()) / scales
    cov = posterior.cov / np.outer(scales, scales)
    ends = np.array(list(posterior.intervals(LEVEL).values())) / scales[:, None]
    random = np.random.default_rng(0)
    some = random.choice(posterior.weights.size, 2000, p=posterior.weights)
    low, high = np.quantile(draws[:, some], [0.002, 0.998], axis=1)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    for row in range(count):
        for column in range(count):
            axis = grid[row, column]
            if column > row:
                axis.set_visible(False)
                continue
            axis.set_xlim(low[column], high[column])
            axis.locator_params(axis="x", nbins=4)
            axis.tick_params(axis="x", labelrotation=90 if narrow else 0)
            if column == row:
                bins = np.linspace(low[row], high[row], 30).tolist()
                look = {"density": True, "color": BLUE, "alpha": 0.7}
                axis.hist(draws[row], bins=bins, weights=posterior.weights, **look)
                x = np.linspace(low[row], high[row], 200)
                normal = statistics.NormalDist(centre[row], np.sqrt(cov[row, row]))
                axis.plot(x, [normal.pdf(one) for one in x], color=ORANGE, lw=1.2)
                axis.axvspan(*ends[row], color="0.85", lw=0, zorder=0)
                axis.set_yticks([])
            else:
                axis.plot(draws[column][some], draws[row][some], ".", ms=1.5, color=BLUE, alpha=0.4)
                pick = np.ix_([column, row], [column, row])
                axis.plot(*_ellipse(centre[[column, row]], cov[pick]), color=ORANGE, lw=1.2)
                axis.set_ylim(low[row], high[row])
                axis.locator_params(axis="y", nbins=5)
            if 0 == column < row:
                axis.set_ylabel(labels[row])
            axis.tick_params(labelbottom=row == count - 1, labelleft=column == 0)
            if row == count - 1:
                axis.set_xlabel(labels[column])
    grid[0, 0].plot([], [], color=ORANGE, lw=1.2, label="errors of the fit\n(ellipses: 95 %)")
    grid[0, 0].legend(loc="upper left", bbox_to_anchor=(1.02, 1)).set_in_layout(False)
    title = (
        f"{several(posterior.weights.size, 'draw')}, worth {posterior.effective:.0f}; shaded: 95 %"
    )
    titled(grid[0, 0], [title])
    return grid.ravel()


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
    (axis,) = axes = canvas(1, 1, (5.2, 3.6)).ravel()
    scale = scaled(profile.unit)[0]
    values = profile.values / scale
    limit = statistics.NormalDist().inv_cdf((1 + LEVEL) / 2) ** 2
    axis.plot(values, profile.deviance, color=BLUE, lw=1.5, label="other parameters fitted again")
    parabola = ((profile.values - profile.value) / profile.stderr) ** 2
    axis.plot(values, parabola, "--", color=ORANGE, lw=1.2, label="fit ± standard error")
    axis.axhline(limit, color=INK, lw=0.8, ls=":")
    axis.annotate(
        "95 %", (1, limit), xycoords=("axes fraction", "data"), xytext=(-2, 2),
        textcoords="offset points", ha="right", va="bottom", fontsize=8,
    )  # fmt: skip
    low, high = np.clip(np.array(profile.interval(LEVEL)) / scale, values[0], values[-1])
    axis.axvspan(low, high, color="0.85", lw=0, zorder=0)
    axis.set(
        xlabel=symbol(profile.name, profile.unit), ylabel="deviance", ylim=(0.0, 10.0),
        xlim=(values[0], values[-1]),
    )  # fmt: skip
    legend(axes)
    return axes
