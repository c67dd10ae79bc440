"""The picture of a residual: in time, by frequency, and its correlations by lag."""

import numpy as np
import scipy.special
from matplotlib.axes import Axes

from etid.plotting.by_frequency import band_of
from etid.plotting.style import BLUE, INK, Canvas, legend, plain_ticks, titled
from etid.results.residual import Correlation, Residual


def draw_residual(canvas: Canvas, found: Residual) -> np.ndarray:
    """Time and frequency above, the correlations with itself and with the input below.

    The residual of an impedance has a frequency and a correlation alone.
    """
    whole = found.with_input is not None
    axes = canvas(2 if whole else 1, 2, (7.5, 5.0 if whole else 2.9)).ravel()
    by_frequency, own = (axes[1], axes[2]) if whole else axes
    if whole:
        axes[0].plot(1e3 * found.time, 1e3 * found.in_time, color=BLUE, lw=0.5)
        axes[0].set(xlabel="time [ms]", ylabel="residual [mV]")
        _correlation(own, found.own, 1e3, "lag [ms]", "autocorrelation")
    else:
        _correlation(own, found.own, 1.0, "lag [frequencies]", "correlation\nof neighbours")
    if found.with_input is not None:
        _correlation(
            axes[3], found.with_input, 1e3, "lag [ms]", "correlation\nwith the earlier input"
        )
    _by_frequency(by_frequency, found)
    titled(axes[0], [found.title, found.note])
    handles = by_frequency.get_legend_handles_labels()[0] + own.get_legend_handles_labels()[0]
    legend(axes, handles)
    return axes


def _by_frequency(axis: Axes, found: Residual) -> None:
    """The size in bands of frequency, and where 95 % of such bands of noise lie."""
    number = band_of(found.frequency.size)
    count = np.bincount(number)
    at = np.exp(np.bincount(number, np.log(found.frequency)) / count) / 1e3
    low, high = (np.sqrt(scipy.special.gammaincinv(count, p) / count) for p in (0.025, 0.975))
    axis.fill_between(at, low, high, color="0.85", lw=0, label="95 % of noise, by frequency")
    size = np.sqrt(np.bincount(number, np.abs(found.whitened) ** 2) / count)
    axis.plot(at, size, "o", ms=3.5, color=BLUE, zorder=3)
    axis.axhline(1.0, color=INK, lw=0.8)
    axis.set(xscale="log", yscale="log", xlabel="frequency [kHz]", ylabel="residual / noise")
    bottom, top = axis.get_ylim()
    axis.set_ylim(min(bottom, 0.25), max(top, 4.0))  # else noise looks large
    plain_ticks(axis.xaxis)
    plain_ticks(axis.yaxis, short=50.0)


def _correlation(axis: Axes, of: Correlation, unit: float, xlabel: str, ylabel: str) -> None:
    """Correlation coefficients by lag, and where 99 % of those of noise lie."""
    lag = unit * of.lag
    label = "99 % of noise, by lag"
    axis.fill_between(lag, -of.band, of.band, color="0.85", lw=0, label=label)
    axis.axhline(0.0, color="0.6", lw=0.6)
    axis.vlines(lag, 0.0, of.values, color=INK, lw=0.9)
    axis.set(xlabel=xlabel, ylabel=ylabel)
    most = 2 * of.band.max()
    bottom, top = axis.get_ylim()
    axis.set_ylim(min(bottom, -most), max(top, most))  # else noise looks large
