"""Pictures of the distribution of the elements, and of the profile of one element."""

import statistics

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from etid.circuits.display import DISPLAY
from etid.plotting.style import BLUE, INK, RED, Canvas, symbol, titled
from etid.results.posterior import Posterior, Profile

LEVEL = 0.95


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
