"""Pictures for a paper: pulses with residuals, impedances, elements of a study.

Every function returns a `matplotlib.figure.Figure` that belongs to no global state: it shows itself
as the last expression of a notebook cell, and `save` writes it to a file. Lines differ in style as
well as in colour, so that they can be told apart in black and white.
"""

import os
import pathlib
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from etid.circuits import DISPLAY
from etid.recording import Recording
from etid.results import Fits, rrse

INK = "#1a1a1a"
BLUE = "#0b62a4"
RED = "#c0392b"
STYLES = ("-", "--", "-.", ":")
COLOURS = (BLUE, RED, "#2e7d32", INK)
BEFORE, AFTER = 0.15e-3, 1.2e-3  # [s] shown around the first edge of a pulse


@runtime_checkable
class HasResponse(Protocol):
    """Anything with an impedance: a circuit, a source impedance, a driver."""

    def response(self, frequency: Float[Array, "..."]) -> Complex[Array, "..."]:
        """Impedance [Ω] at real frequencies [Hz]."""
        ...


def new_figure(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, Any]:
    """A figure that belongs to no global state, with a light grid, and its axes [row, column].

    Args:
        rows: Of axes.
        columns: Of axes.
        size: Width and height [inch].
        **options: As `Figure.subplots` takes them.
    """
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(True, color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def pulse(recording: Recording) -> slice:
    """Samples around the first edge whose surroundings lie inside the record: one pulse."""
    v = recording.v_th
    steep = np.abs(np.diff(v))
    before = int(BEFORE * recording.sample_rate)
    after = int(AFTER * recording.sample_rate)
    rising = np.flatnonzero((steep > 0.5 * steep.max()) & (np.diff(v) > 0))
    inside = rising[(rising >= before) & (rising + after < v.size)]
    start = int(inside[0]) if inside.size else int(np.argmax(steep))
    return slice(max(0, start - before), min(v.size, start + after))


def plot_recording(recording: Recording) -> Figure:
    """Unloaded and loaded voltage: the whole record, and one pulse."""
    figure, axes = new_figure(1, 2, (9.0, 3.0))
    milliseconds = 1e3 * recording.time
    for axis, part in ((axes[0, 0], slice(None)), (axes[0, 1], pulse(recording))):
        axis.plot(milliseconds[part], recording.v_th[part], color=INK, lw=0.9, label="V_th")
        axis.plot(
            milliseconds[part], recording.v_out[part], "--", color=BLUE, lw=0.9, label="V_out"
        )
        axis.set(xlabel="time [ms]", ylabel="voltage [V]")
    axes[0, 1].legend(frameon=False)
    if recording.path:
        figure.suptitle(recording.path)
    return figure


def plot_fit(
    recording: Recording, predicted: Float[np.ndarray, " time"], *, title: str = ""
) -> Figure:
    """Measured and predicted pulse with the residual below (the paper's figures 7 and 8).

    Args:
        recording: What was measured.
        predicted: Terminal voltage [V] as from `etid.predict`; NaN where there is no prediction.
        title: Above the figure; the recording's path if not given.

    Raises:
        ValueError: `predicted` has another length than the recording.
    """
    if predicted.shape != recording.v_out.shape:
        raise ValueError(
            f"predicted has shape {predicted.shape}, the recording {recording.v_out.shape}"
        )
    figure, axes = new_figure(
        2, 1, (6.0, 4.5), sharex=True, gridspec_kw={"height_ratios": [3, 1.2]}
    )
    draw_fit(axes[0, 0], axes[1, 0], recording, predicted)
    figure.suptitle(title or recording.path)
    return figure


def draw_fit(
    upper: Axes, lower: Axes, recording: Recording, predicted: Float[np.ndarray, " time"]
) -> None:
    """What `plot_fit` shows, on the axes of another figure.

    Args:
        upper: Axes of the pulse.
        lower: Axes of the residual.
        recording: What was measured.
        predicted: Terminal voltage [V]; NaN where there is no prediction.
    """
    part = pulse(recording)
    milliseconds = 1e3 * recording.time[part]
    known = np.isfinite(predicted)
    error = float(rrse(jnp.asarray(predicted[known]), jnp.asarray(recording.v_out[known])))
    upper.plot(milliseconds, recording.v_th[part], ":", color="0.55", lw=1.0, label="V_th")
    upper.plot(milliseconds, recording.v_out[part], color=INK, lw=1.4, label="V_out measured")
    upper.plot(
        milliseconds, predicted[part], "--", color=RED, lw=1.2,
        label=f"predicted, RRSE {100 * error:.2g} %",
    )  # fmt: skip
    upper.set(ylabel="voltage [V]")
    upper.legend(frameon=False, fontsize=8)
    residual = 1e3 * (predicted - recording.v_out)
    lower.axhline(0.0, color="0.6", lw=0.6)
    lower.plot(milliseconds, residual[part], color=BLUE, lw=0.8)
    lower.set(xlabel="time [ms]", ylabel="residual [mV]")


def plot_impedance(
    impedances: Mapping[str, HasResponse],
    *,
    lowest: float = 60.0,
    highest: float = 100e3,
    stderr: Mapping[str, Float[np.ndarray, " frequency"]] | None = None,
) -> Figure:
    """Bode diagram of impedances (the paper's figure 9).

    Args:
        impedances: What to draw, by label.
        lowest: Lowest frequency [Hz].
        highest: Highest frequency [Hz].
        stderr: Standard error of the magnitude [Ω] at `bode_frequencies(lowest, highest)`, by
            label; a band of two of them is drawn.
    """
    figure, axes = new_figure(2, 1, (6.0, 5.0), sharex=True)
    magnitude, phase = axes[:, 0]
    frequency = bode_frequencies(lowest, highest)
    for i, (label, impedance) in enumerate(impedances.items()):
        z = np.asarray(impedance.response(jnp.asarray(frequency)))
        style = {"color": COLOURS[i % 4], "linestyle": STYLES[i % 4], "lw": 1.3}
        magnitude.loglog(frequency / 1e3, np.abs(z) / 1e3, label=label, **style)
        phase.semilogx(frequency / 1e3, np.degrees(np.angle(z)), **style)
        if stderr is not None and label in stderr:
            low = np.maximum(np.abs(z) - 2 * stderr[label], 1e-3 * np.abs(z))
            high = np.abs(z) + 2 * stderr[label]
            band = magnitude.fill_between(frequency / 1e3, low / 1e3, high / 1e3)
            band.set(color=COLOURS[i % 4], alpha=0.2, linewidth=0)
    magnitude.set(ylabel="|Z| [kΩ]")
    magnitude.legend(frameon=False, fontsize=8)
    phase.set(xlabel="frequency [kHz]", ylabel="phase [deg]")
    return figure


def bode_frequencies(
    lowest: float = 60.0, highest: float = 100e3
) -> Float[np.ndarray, " frequency"]:
    """Frequencies [Hz] at which `plot_impedance` evaluates."""
    return np.geomspace(lowest, highest, 300)


def plot_elements(fits: Fits) -> Figure:
    """Elements of all fits by subject, with standard errors; what did not succeed is hollow."""
    units = fits.circuit.units()
    figure, axes = new_figure(len(units), 1, (7.5, 2.3 * len(units)), sharex=True)
    good = fits.verdicts == "successful"
    subjects = sorted(set(fits.labels["subject"].tolist()))
    conditions = sorted(set(fits.labels["condition"].tolist()))
    for axis, (name, unit) in zip(axes[:, 0], units.items(), strict=True):
        scale, symbol = DISPLAY[unit]
        for j, condition in enumerate(conditions):
            _draw_elements(axis, fits, name, scale, subjects, condition, good, j, len(conditions))
        axis.set_yscale("log")
        if good.any():  # what was not determined may lie decades away
            values = np.asarray(getattr(fits.circuit, name))[good] / scale
            axis.set_ylim(values.min() / 2, values.max() * 2)
        axis.set_ylabel(f"{name} [{symbol}]")
    axes[-1, 0].set_xticks(range(len(subjects)), [subject or "-" for subject in subjects])
    axes[-1, 0].set_xlabel("subject")
    axes[0, 0].legend(frameon=False, fontsize=8, ncols=min(4, max(1, len(conditions))))
    return figure


def _draw_elements(
    axis: Axes,
    fits: Fits,
    name: str,
    scale: float,
    subjects: list[str],
    condition: str,
    good: np.ndarray,
    series: int,
    count: int,
) -> None:
    values = np.asarray(getattr(fits.circuit, name)) / scale
    errors = np.asarray(getattr(fits.stderr, name)) / scale
    chosen = (fits.labels["condition"] == condition) & np.isfinite(values) & (values > 0)
    place = np.array([subjects.index(subject) for subject in fits.labels["subject"]], float)
    width = 0.8 / count
    for i in range(len(subjects)):  # trials of one subject side by side
        rows = np.flatnonzero(chosen & (place == i))
        place[rows] += (series + 0.5) * width - 0.4 + np.linspace(-0.35, 0.35, rows.size) * width
    colour, marker = COLOURS[series % 4], "osD^"[series % 4]
    for part, face, label in ((good, colour, condition or "-"), (~good, "none", None)):
        rows = np.flatnonzero(chosen & part)
        if rows.size:
            error = np.where(np.isfinite(errors[rows]), errors[rows], 0.0)
            axis.errorbar(
                place[rows], values[rows], error, fmt=marker, ms=3.5, lw=0.7,
                color=colour, markerfacecolor=face, label=label,
            )  # fmt: skip


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as PNG or SVG, without dates, so that equal figures are equal files."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in (".png", ".svg"):
        raise ValueError(f"{path}: figures are written as .png or .svg, not {suffix or 'nothing'}")
    figure.savefig(path, dpi=150, metadata={"Date": None} if suffix == ".svg" else {})
