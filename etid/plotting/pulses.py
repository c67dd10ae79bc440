"""Pictures over time: a record, one pulse, and the residual of a predicted pulse."""

import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.identify.predict import predict
from etid.plotting.bands import continuous
from etid.plotting.by_frequency import by_frequency, draw_by_frequency, sample_std
from etid.plotting.style import (
    BLUE,
    INK,
    NO_BREAK,
    ORANGE,
    Canvas,
    judged,
    legend,
    listed,
    plain,
    titled,
    typeset,
    without_elements,
)
from etid.printing import heading, quantity, scaled
from etid.recordings.fields import LABELS
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.driver import Driver
from etid.results.fit import Fit


def pulse(recording: Recording) -> slice:
    """Samples of one pulse: from 0.15 ms before its first edge to 1.2 ms after it.

    The pulse is one that is far enough from both ends of the record, if there is one.
    """
    cause = recording.samples[recording.cause].values
    step, size = np.nan_to_num(np.diff(cause)), cause.size  # a missing sample must not hide an edge
    before = int(0.15e-3 * recording.sample_rate)
    after = int(1.2e-3 * recording.sample_rate)
    # The edges of a biphasic pulse are half of that between its phases.
    edges = np.flatnonzero(np.abs(step) > 0.3 * np.abs(step).max(initial=0.0))
    # The rest before a pulse is longer than its phases. A record may begin in a pulse.
    rest = np.diff(edges, prepend=0)
    first = edges[rest > 0.5 * rest.max(initial=0)]
    inside = first[(first >= before) & (first + after < size)]
    start = int(inside[0]) if inside.size else int(np.argmax(np.append(np.abs(step), 0.0)))
    return slice(max(0, start - before), min(size, start + after))


def draw_recording(canvas: Canvas, recording: Recording) -> np.ndarray:
    """Voltages, and the current if there is one: the whole record, and one pulse."""
    current = recording.samples.get("current")
    rows, share = (1, "none") if current is None else (2, "col")
    axes = canvas(rows, 2, (7.5, 3.0 if rows == 1 else 4.8), sharex=share).reshape(rows, 2)
    milliseconds = 1e3 * recording.time
    for column, part in enumerate((slice(None), pulse(recording))):
        time, axis = milliseconds[part], axes[0, column]
        both = recording.cause == "v_th"
        if both:
            axis.plot(time, recording.v_th[part], color=INK, lw=0.9, label=typeset("V_th"))
        style = "--" if both else "-"
        axis.plot(time, recording.v_out[part], style, color=BLUE, lw=1.1, label=typeset("V_out"))
        axis.set(ylabel="voltage [V]")
        if current is not None:
            finite = current.values[np.isfinite(current.values)]
            size, _ = scaled("ampere", largest := float(np.abs(finite).max(initial=0.0)))
            axes[1, column].plot(time, current.values[part] / size, color=INK, lw=0.9)
            axes[1, column].set(ylabel=heading("current", "ampere", largest))
        axes[-1, column].set(xlabel="time [ms]")
    labels = [f"{name}{NO_BREAK}{value}" for name in LABELS if (value := getattr(recording, name))]
    if recording.r_load is not None:
        labels.append(f"calibration with {quantity(recording.r_load, 'ohm')}")
    titled(axes[0, 0], [plain(recording.path), plain(", ".join(labels))], beside=True)
    titled(axes[0, 1], ["one pulse"], beside=True)
    legend(axes)
    return axes.ravel()


def draw_fit(canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None) -> np.ndarray:
    """Measured and predicted pulse, the residual, and the verdict of the fit as title."""
    elements = listed(fit)
    axes = _pulse_and_residual(canvas, fit, recording, driver, fit.circuit if elements else None)
    judged(axes[0], recording.path, fit, *elements)
    return axes


def draw_calibration(canvas: Canvas, driver: Driver, recording: Recording) -> np.ndarray:
    """Pulse on a known resistor, its prediction, and the verdict of the driver as title."""
    if recording.r_load is None:
        raise TypeError(
            "a driver is drawn with a calibration, but this recording has no r_load; draw the "
            "fit of this recording, plot(fit, recording, driver)"
        )
    load = Resistor(recording.r_load)
    axes = _pulse_and_residual(canvas, driver, recording, driver, load)
    about = f"driver of order {driver.order}, known load {quantity(recording.r_load, 'ohm')}"
    judged(axes[0], recording.path, driver, about)
    return axes


def _pulse_and_residual(
    canvas: Canvas,
    found: Fit | Driver,
    recording: Recording,
    driver: Driver | None,
    load: AbstractCircuit | None,
) -> np.ndarray:
    """One pulse, measured and predicted, and the residual in time and by frequency.

    A record of no whole periods, or with a missing sample, has no harmonics to show. Without a load
    nothing is predicted.
    """
    if load is None:
        axes = _panels(canvas, 2)
        _draw_measured(axes, recording)
        without_elements(axes[1], "no elements, nothing predicted")
        legend(axes, axes[0].get_legend_handles_labels()[0])
        return axes
    predicted = predict(recording, driver, load)
    of, feed = continuous(recording, driver)
    seen = Inspected.of(of)
    axes = _panels(canvas, 3 if seen.is_periodic and np.isfinite(seen.spans).all() else 2)
    part, time = _draw_measured(axes, recording)
    upper, lower = axes[:2]
    upper.plot(time, predicted[part], "--", color=ORANGE, lw=1.2, label="predicted")
    sigma = 1e3 * sample_std(seen, feed, load)
    # Above 0.4 of the sample rate, aliases of the edges are neither noise nor predicted.
    label = "95 % of the noise (edges: aliases)"
    lower.axhspan(-2 * sigma, 2 * sigma, color="0.85", lw=0, label=label)
    lower.axhline(0.0, color="0.6", lw=0.6)
    lower.plot(time, 1e3 * (predicted - recording.v_out)[part], color=BLUE, lw=0.8)
    for axis in axes[2:]:
        if np.isfinite(sigma):
            draw_by_frequency(axis, by_frequency(seen, feed, load, found))
        else:
            without_elements(axis, "nothing predicted")
    legend(axes, [one for axis in axes for one in axis.get_legend_handles_labels()[0]])
    return axes


def _panels(canvas: Canvas, count: int) -> np.ndarray:
    """Two panels over one time, and one over frequency if there are three."""
    height, *ratios = {2: (4.8, 3, 1.2), 3: (6.6, 2.6, 1.2, 1.7)}[count]
    axes = canvas(count, 1, (6.0, height), gridspec_kw={"height_ratios": ratios}).ravel()
    if canvas.axes is None:
        axes[0].sharex(axes[1])
        axes[0].tick_params(labelbottom=False)
    return axes


def _draw_measured(
    axes: np.ndarray, recording: Recording
) -> tuple[slice, Float[np.ndarray, " time"]]:
    """Draw one pulse as it was measured; its samples and their time [ms]."""
    part = pulse(recording)
    time = 1e3 * recording.time[part]
    upper, lower = axes[:2]
    if recording.cause == "v_th":
        upper.plot(time, recording.v_th[part], ":", color="0.55", lw=1.0, label=typeset("V_th"))
    measured = typeset("V_out measured")
    upper.plot(time, recording.v_out[part], color=INK, lw=1.4, label=measured)
    upper.set(ylabel="voltage [V]")
    lower.set(xlabel="time [ms]", ylabel="residual [mV]")
    return part, time
