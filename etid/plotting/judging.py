"""Pictures that judge fits: impedances beside the measured one, and rival circuits."""

from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from etid.plotting.bands import CLEAR, Bands, bands, continuous, used
from etid.plotting.impedances import POINTS, Bode
from etid.plotting.style import (
    BLUE,
    COLOURS,
    DASHES,
    INK,
    MARKS,
    ORANGE,
    Canvas,
    judged,
    legend,
    listed,
    nth,
    without_elements,
)
from etid.printing import scaled
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.data import MeasuredImpedance
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.selection.selection import Candidate, Selection

SLOW = 1.0  # [Hz]; a spectrum that begins below is shown over Hz


def draw_impedance(
    canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None
) -> np.ndarray:
    """Nyquist and Bode diagrams: the impedance that the recording measures, and the fit."""
    if not listed(fit):
        axes = canvas.three((7.5, 4.6), wide=True)
        for axis in axes:
            without_elements(axis)
        judged(axes[0], recording.path, fit)
        return axes
    recording, known = continuous(recording, driver)
    lane = used(Inspected.of(recording), known, fit.circuit, fit.remarks)
    measured = bands(lane, known, fit.circuit)
    clear = measured.stderr <= CLEAR
    points = measured.frequency[clear], measured.z[clear], measured.stderr[clear]
    return _diagrams(canvas, fit, recording.path, *points)


def draw_measured(canvas: Canvas, fit: Fit | None, measured: MeasuredImpedance) -> np.ndarray:
    """Nyquist and Bode diagrams: the impedance that an instrument measured, and the fit if any."""
    error = None if measured.stderr is None else measured.stderr / np.abs(measured.z)
    return _diagrams(canvas, fit, "", measured.frequency, measured.z, error)


def _diagrams(
    canvas: Canvas,
    fit: Fit | None,
    path: str,
    frequency: Float[np.ndarray, " point"],
    z: Complex[np.ndarray, " point"],
    stderr: Float[np.ndarray, " point"] | None,
) -> np.ndarray:
    """Nyquist and Bode diagrams of measured points, with standard errors of ln Z, and of a fit."""
    nyquist, magnitude, phase = axes = canvas.three((7.5, 4.6), wide=True)
    unit, ohms = scaled("ohm", float(np.median(np.abs(z))))
    hertz = (1.0, "Hz") if frequency.min() < SLOW else (1e3, "kHz")
    bode = Bode(magnitude, phase, (unit, ohms), hertz)
    label = "measured" if stderr is None else "measured, ± 2 standard errors"
    point: Any = {"ms": 4, "lw": 0.8, "color": BLUE, "label": label}
    if fit is not None:
        line: Any = {"color": ORANGE, "lw": 1.3, "label": "fit"}
        smooth = np.geomspace(frequency.min() / 1.3, frequency.max() * 1.3, POINTS)
        fitted = np.asarray(fit.circuit.response(smooth))
        nyquist.plot(np.real(fitted) / unit, -np.imag(fitted) / unit, **line)
        bode.curve(smooth, fitted, **line)
        judged(nyquist, path, fit, *listed(fit))
    size = None if stderr is None else 2 * stderr * np.abs(z) / unit
    nyquist.errorbar(np.real(z) / unit, -np.imag(z) / unit, size, size, fmt="o", **point)
    nyquist.set(xlabel=f"Re Z [{ohms}]", ylabel=f"-Im Z [{ohms}]")
    (left, right), (low, high) = nyquist.get_xlim(), nyquist.get_ylim()
    nyquist.set_ylim(low, max(high, low + (right - left) / 3))  # of a resistor, too
    nyquist.set_xlim(left, max(right, left + (high - low) / 3))
    nyquist.set_aspect("equal", anchor="W")
    bode.points(frequency, z, stderr, **point)
    bode.frame(z)
    for axis in (magnitude, phase):
        axis.set(xlabel=f"frequency [{hertz[1]}]")
    legend(axes)
    return axes


def draw_selection(
    canvas: Canvas, selection: Selection, recording: Recording, driver: Driver | None
) -> np.ndarray:
    """Magnitude and phase with all candidates, and below them the deviation of each candidate."""
    ratios = {"height_ratios": [3, 1.6]}
    axes = canvas(2, 2, (7.5, 5.2), sharex=True, gridspec_kw=ratios).ravel()
    chosen = selection.candidates[0]
    fitted = [one for one in selection.candidates if listed(one.fit)]
    if chosen not in fitted:
        for axis in axes:
            without_elements(axis)
        judged(axes[0], recording.path, selection.fit)
        return axes
    recording, known = continuous(recording, driver)
    lane = used(Inspected.of(recording), known, chosen.fit.circuit, chosen.fit.remarks)
    found = [bands(lane, known, one.fit.circuit) for one in fitted]
    _measured_and_fitted(Bode(*axes[:2]), fitted, found[0])
    _deviations(axes[2], axes[3], found)
    legend(axes)
    judged(axes[0], recording.path, selection.fit, chosen.name, *listed(selection.fit))
    return axes


def _look(number: int) -> dict[str, Any]:
    """Look of a candidate; the first one is the chosen one."""
    # The bold line lies below the others, which it would hide.
    width, layer = (1.1, 2.5) if number else (2.2, 2.2)
    line = {"color": nth(COLOURS, number), "linestyle": nth(DASHES, number)}
    return line | {"lw": width, "zorder": layer}


def _measured_and_fitted(bode: Bode, fitted: list[Candidate], measured: Bands) -> None:
    """The measured impedance, pale where it is uncertain, and those of the candidates."""
    clear = measured.stderr <= CLEAR
    look: Any = {"color": INK, "ms": 3.5, "lw": 0.9, "capsize": 2.0}
    for some, label, alpha in (
        (clear, "measured", 1.0),
        (~clear & (measured.stderr <= 1.0), None, 0.3),
    ):
        of = measured.frequency[some], measured.z[some], measured.stderr[some]
        bode.points(*of, label=label, alpha=alpha, **look)
    frequency = np.geomspace(measured.frequency[0], measured.frequency[-1], POINTS)
    drawn = [measured.z[clear]]
    for number, one in enumerate(fitted):
        label = f"{one.name}, chosen"
        if number:
            verdict = "" if one.fit.verdict == "successful" else f", {one.fit.verdict}"
            label = f"{one.name}, 2 log evidence {one.evidence:+.0f}{verdict}"
        drawn.append(np.asarray(one.fit.circuit.response(frequency)))
        bode.curve(frequency, drawn[-1], label=label, **_look(number))
    bode.frame(np.concatenate(drawn))


def _deviations(magnitude: Axes, phase: Axes, found: list[Bands]) -> None:
    """Measured minus fitted, in standard errors: up to 4 to scale, beyond by logarithm."""
    plain = 4.0
    largest = max(plain, *(np.abs(of.deviation).max() for of in found))
    for part, (axis, name) in enumerate(((magnitude, "ln |Z|"), (phase, "phase"))):
        axis.axhspan(-2.0, 2.0, color="0.85", lw=0)
        axis.axhline(0.0, color="0.6", lw=0.6)
        for number, of in enumerate(found):
            look = _look(number) | {"marker": nth(MARKS, number), "ms": 3.0}
            axis.plot(of.frequency / 1e3, of.deviation[part], **look)
        axis.set(xlabel="frequency [kHz]", ylabel=f"{name} off\n[stderr]")
        axis.set_yscale("symlog", linthresh=plain, linscale=1.0)
        ticks = [tick for tick in (2.0, 10.0, 100.0, 1000.0, 10000.0) if tick <= largest]
        axis.yaxis.set_major_locator(FixedLocator([*(-t for t in ticks), 0.0, *ticks]))
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(-1.4 * largest, 1.4 * largest)
        axis.xaxis.set_major_formatter("{x:g}")
