"""Pictures over time: a record, one pulse, and the residual of a predicted pulse."""

import jax
import numpy as np
from matplotlib.axes import Axes

from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.circuits.display import heading, scaled
from etid.identify.arguments import fed
from etid.identify.predict import predict
from etid.plotting.style import BLUE, INK, RED, Canvas, titled, typeset
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
    rows = 1 if current is None else 2
    axes = canvas(rows, 2, (9.0, 3.2 if rows == 1 else 4.8), sharex="col")
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
    labels = [f"{name} {value}" for name in LABELS if (value := getattr(recording, name))]
    if recording.r_load is not None:
        labels.append(f"calibration with {recording.r_load / 1e3:g} kΩ")
    titled(axes[0, 0], [recording.path, ", ".join(labels)])
    titled(axes[0, 1], ["one pulse"])
    axes[0, 1].legend(frameon=False)
    return axes.ravel()


def draw_fit(canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None) -> np.ndarray:
    """Measured and predicted pulse, the residual, and the verdict of the fit as title."""
    if np.ndim(fit.rrse):
        raise TypeError(
            f"this is a batch of {np.shape(fit.rrse)} fits; draw one fit, fits[i], or all of "
            "them, plot(fits)"
        )
    axes = _pulse_and_residual(canvas)
    good = fit.verdict == "successful"
    if not np.isfinite(np.asarray(fit.circuit.values())).all():
        _unpredicted(axes[0], axes[1], recording)
        titled(axes[0], [headline(recording.path, fit)], good=good)
        return axes
    draw_pulse(axes[0], axes[1], recording, driver, fit.circuit)
    titled(axes[0], [headline(recording.path, fit), ",  ".join(fit.elements)], good=good)
    return axes


def draw_calibration(canvas: Canvas, driver: Driver, recording: Recording) -> np.ndarray:
    """Pulse on a known resistor, its prediction, and the verdict of the driver as title."""
    if recording.r_load is None:
        raise TypeError(
            "a driver is drawn with a calibration, but this recording has no r_load; draw the "
            "fit of this recording, plot(fit, recording, driver)"
        )
    axes = _pulse_and_residual(canvas)
    draw_pulse(axes[0], axes[1], recording, driver, Resistor(recording.r_load))
    lines = [headline(recording.path, driver), f"driver of order {driver.order}, "]
    lines[1] += f"known load {recording.r_load / 1e3:g} kΩ"
    titled(axes[0], lines, good=driver.verdict == "successful")
    return axes


def _pulse_and_residual(canvas: Canvas) -> np.ndarray:
    ratios = {"height_ratios": [3, 1.2]}
    return canvas(2, 1, (6.0, 4.8), sharex=True, gridspec_kw=ratios).ravel()


def headline(path: str, found: Fit | Driver) -> str:
    """Path of the recording if it has one, verdict, χ² and RRSE, for a title."""
    verdict = found.verdict
    verdict = verdict if verdict == "successful" else f"no success: {verdict}"
    quality = f"chi2 {float(found.chi2):.3g}" if np.isfinite(float(found.chi2)) else ""
    error = f"RRSE {100 * float(found.rrse):.3g} %" if np.isfinite(float(found.rrse)) else ""
    where = f"{path}: " if path else ""
    return where + ", ".join(filter(None, (verdict, quality, error)))


def draw_pulse(
    upper: Axes, lower: Axes, recording: Recording, driver: Driver | None, circuit: AbstractCircuit
) -> None:
    """Draw one pulse, measured and predicted, and the residual with ±2σ of the noise.

    Args:
        upper: Axes of the pulse.
        lower: Axes of the residual.
        recording: The measured voltages.
        driver: Driver with a continuous source impedance; None for a measured current.
        circuit: The load.
    """
    predicted = predict(recording, driver, circuit)
    part = _measured(upper, recording)
    milliseconds = 1e3 * recording.time[part]
    upper.plot(milliseconds, predicted[part], "--", color=RED, lw=1.2, label="predicted")
    upper.legend(frameon=False, fontsize=8)
    sigma = 1e3 * residual_std(recording, driver, circuit)
    residual = 1e3 * (predicted - recording.v_out)
    # Above 0.4 of the sample rate, aliases of the edges are neither noise nor predicted.
    label = r"$\pm2\,\sigma$ of the noise (edges: aliases)"
    lower.axhspan(-2 * sigma, 2 * sigma, color="0.85", lw=0, label=label)
    lower.axhline(0.0, color="0.6", lw=0.6)
    lower.plot(milliseconds, residual[part], color=BLUE, lw=0.8)
    lower.set(xlabel="time [ms]", ylabel="residual [mV]")
    # Noise fills these axes, so the legend is above them.
    lower.legend(
        frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0
    )


def _measured(upper: Axes, recording: Recording) -> slice:
    part = pulse(recording)
    milliseconds = 1e3 * recording.time[part]
    if recording.cause == "v_th":
        upper.plot(
            milliseconds, recording.v_th[part], ":", color="0.55", lw=1.0, label=typeset("V_th")
        )
    upper.plot(
        milliseconds, recording.v_out[part], color=INK, lw=1.4, label=typeset("V_out measured")
    )
    upper.set(ylabel="voltage [V]")
    return part


def _unpredicted(upper: Axes, lower: Axes, recording: Recording) -> None:
    _measured(upper, recording)
    upper.legend(frameon=False, fontsize=8)
    lower.text(
        0.5, 0.5, "no elements, nothing predicted", color=RED, transform=lower.transAxes,
        ha="center", va="center",
    )  # fmt: skip
    lower.set(xlabel="time [ms]", ylabel="residual [mV]", yticks=[])


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
