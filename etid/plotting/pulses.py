"""Pictures over time: a record, one pulse, and the residual of a predicted pulse."""

import jax
import numpy as np

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.circuits.display import heading, scaled
from etid.identify.arguments import fed
from etid.identify.predict import predict
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
from etid.recordings.fields import LABELS
from etid.recordings.recording import Recording
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.signals.noise import noise


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
        labels.append(f"calibration with {recording.r_load / 1e3:g} kΩ")
    titled(axes[0, 0], [plain(recording.path), plain(", ".join(labels))], beside=True)
    titled(axes[0, 1], ["one pulse"], beside=True)
    legend(axes)
    return axes.ravel()


def draw_fit(canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None) -> np.ndarray:
    """Measured and predicted pulse, the residual, and the verdict of the fit as title."""
    elements = listed(fit)
    axes = _pulse_and_residual(canvas, recording, driver, fit.circuit if elements else None)
    judged(axes[0], recording.path, fit, *elements)
    return axes


def draw_calibration(canvas: Canvas, driver: Driver, recording: Recording) -> np.ndarray:
    """Pulse on a known resistor, its prediction, and the verdict of the driver as title."""
    if recording.r_load is None:
        raise TypeError(
            "a driver is drawn with a calibration, but this recording has no r_load; draw the "
            "fit of this recording, plot(fit, recording, driver)"
        )
    axes = _pulse_and_residual(canvas, recording, driver, Resistor(recording.r_load))
    about = f"driver of order {driver.order}, known load {recording.r_load / 1e3:g} kΩ"
    judged(axes[0], recording.path, driver, about)
    return axes


def _pulse_and_residual(
    canvas: Canvas, recording: Recording, driver: Driver | None, load: AbstractCircuit | None
) -> np.ndarray:
    """One pulse, measured and predicted, and the residual with ±2σ of the noise.

    Without a load nothing is predicted.
    """
    ratios = {"height_ratios": [3, 1.2]}
    upper, lower = axes = canvas(2, 1, (6.0, 4.8), sharex=True, gridspec_kw=ratios).ravel()
    part = pulse(recording)
    time = 1e3 * recording.time[part]
    if recording.cause == "v_th":
        upper.plot(time, recording.v_th[part], ":", color="0.55", lw=1.0, label=typeset("V_th"))
    measured = typeset("V_out measured")
    upper.plot(time, recording.v_out[part], color=INK, lw=1.4, label=measured)
    upper.set(ylabel="voltage [V]")
    lower.set(xlabel="time [ms]", ylabel="residual [mV]")
    if load is None:
        without_elements(lower, "no elements, nothing predicted")
    else:
        predicted = predict(recording, driver, load)
        upper.plot(time, predicted[part], "--", color=ORANGE, lw=1.2, label="predicted")
        sigma = 1e3 * residual_std(recording, driver, load)
        # Above 0.4 of the sample rate, aliases of the edges are neither noise nor predicted.
        label = r"$\pm2\,\sigma$ of the noise (edges: aliases)"
        lower.axhspan(-2 * sigma, 2 * sigma, color="0.85", lw=0, label=label)
        lower.axhline(0.0, color="0.6", lw=0.6)
        lower.plot(time, 1e3 * (predicted - recording.v_out)[part], color=BLUE, lw=0.8)
    legend(axes, [one for axis in axes for one in axis.get_legend_handles_labels()[0]])
    return axes


def residual_std(recording: Recording, driver: Driver | None, circuit: AbstractCircuit) -> float:
    """Standard deviation of predicted − measured voltage if only noise is left [V].

    The noise of V_th reaches the residual through the loaded driver G = Z_L / (Z_L + Z_th), that of
    a measured current through G = Z_L,

        σ² = σ_out² + σ_th² mean |G|²,    the mean from 0 to half the sample rate (Parseval).
    """
    half = recording.sample_rate / 2
    # Features of G are wider than a thousandth of the band.
    frequency = jax.device_put((np.arange(2048) + 0.5) * half / 2048)
    recording, feed = fed(recording, driver)
    size = np.abs(np.asarray(feed.gain(circuit.response(frequency), frequency)))
    gain = np.mean(size**2)
    both = (recording.samples[name] for name in (recording.cause, "v_out"))
    sigma_th, sigma_out = (
        float(noise(one.values, np.asarray(one.resolution or 0.0))) for one in both
    )
    return float(np.sqrt(sigma_out**2 + sigma_th**2 * gain))
