"""Pictures of impedances over frequency, with bands of two standard errors."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.axes import Axes

from etid.circuits.circuit import with_slopes
from etid.plotting import Impedance
from etid.plotting.style import (
    COLOURS,
    DASHES,
    RED,
    Canvas,
    legend,
    nth,
    plain_ticks,
    titled,
    typeset,
)
from etid.precision import array_function
from etid.results.driver import Driver
from etid.results.fit import Fit

POINTS = 300


def draw_bode(canvas: Canvas, things: Mapping[str, Impedance]) -> np.ndarray:
    """Magnitude and phase of impedances (the paper's figure 9), with bands."""
    magnitude, phase = axes = canvas(2, 1, (6.0, 5.0), sharex=True).ravel()
    # From the paper's pulse rate to half its sample rate.
    frequency = np.geomspace(60.0, 100e3, POINTS)
    kilohertz = frequency / 1e3
    sizes, banded, failed = [], False, []
    for i, (label, thing) in enumerate(things.items()):
        z, errors = _with_errors(thing, frequency)
        known = np.isfinite(errors).all()
        look = {"color": nth(COLOURS, i), "linestyle": nth(DASHES, i), "lw": 1.3}
        if isinstance(thing, Fit | Driver):
            if not thing.usable:
                failed.append(f"{label}: unusable: {thing.verdict}")
                look |= {"color": RED, "lw": 0.9}
            if thing.verdict == "approximate":
                label = f"{label}, approximate"
            label = label if known else f"{label}, no standard error"
        curve(magnitude, phase, frequency, z, label=typeset(label), **look)
        sizes.append(np.abs(z) / 1e3)
        if known:
            banded = True
            band = {"color": look["color"], "alpha": 0.25, "linewidth": 0}
            factor = np.exp(np.minimum(2 * errors[0], 50))  # it is finite beyond every axis
            magnitude.fill_between(kilohertz, sizes[-1] / factor, sizes[-1] * factor, **band)
            angle, turn = np.unwrap(np.angle(z)), 2 * errors[1]
            phase.fill_between(kilohertz, *np.degrees([angle - turn, angle + turn]), **band)
    phase.set(xlabel="frequency [kHz]")
    frame(magnitude, phase, np.concatenate(sizes))
    legend(axes)
    titled(magnitude, failed or ["bands: two standard errors" if banded else ""], good=not failed)
    return axes


def curve(
    magnitude: Axes,
    phase: Axes,
    frequency: Float[np.ndarray, " frequency"],
    z: Complex[np.ndarray, " frequency"],
    **look: Any,
) -> None:
    """Draw an impedance [Ω] over frequency [Hz], in kΩ and degrees over kHz."""
    kilohertz = frequency / 1e3
    magnitude.plot(kilohertz, np.abs(z) / 1e3, **look)
    phase.plot(kilohertz, np.degrees(np.unwrap(np.angle(z))), **look)


def points(
    magnitude: Axes,
    phase: Axes,
    frequency: Float[np.ndarray, " point"],
    z: Complex[np.ndarray, " point"],
    stderr: Float[np.ndarray, " point"] | None,
    **look: Any,
) -> None:
    """Draw measured impedances [Ω], with two standard errors of ln Z if they are known."""
    kilohertz, size, degrees = frequency / 1e3, np.abs(z) / 1e3, np.degrees(np.angle(z))
    ends = turn = None
    if stderr is not None:
        ends = size * (1 - np.exp(-2 * stderr)), size * (np.exp(2 * stderr) - 1)
        turn = np.degrees(2 * stderr)
    magnitude.errorbar(kilohertz, size, ends, fmt="o", **look)
    phase.errorbar(kilohertz, degrees, turn, fmt="o", **look)


def frame(magnitude: Axes, phase: Axes, sizes: Float[np.ndarray, " value"]) -> None:
    """Label the axes, with limits that show the curves even if the bands are wide."""
    magnitude.set(ylabel="|Z| [kΩ]", xscale="log", yscale="log")
    phase.set(ylabel="phase [deg]", xscale="log")
    sizes = sizes[np.isfinite(sizes)]
    if sizes.size:
        magnitude.set_ylim(sizes.min() / 1.5, sizes.max() * 1.5)
    low, high = phase.get_ylim()
    phase.set_ylim(max(low, -180.0), min(high, 180.0))
    plain_ticks(magnitude.yaxis)
    phase.xaxis.set_major_formatter("{x:g}")


def _with_errors(
    thing: Impedance, frequency: Float[np.ndarray, " frequency"]
) -> tuple[Complex[np.ndarray, " frequency"], Float[np.ndarray, "2 frequency"]]:
    """Z, and standard errors of ln |Z| and of the phase [rad]; NaN without a covariance."""
    if isinstance(thing, Fit):
        return _of_circuit(thing, frequency)
    if isinstance(thing, Driver):
        errors = np.asarray(thing.log_response_stderr(frequency))
        return np.asarray(thing.response(frequency)), errors
    return np.asarray(thing.response(frequency)), np.full((2, frequency.size), np.nan)


@array_function
def _of_circuit(
    fit: Fit, frequency: Float[np.ndarray, " frequency"]
) -> tuple[Complex[np.ndarray, " frequency"], Float[np.ndarray, "2 frequency"]]:
    """Z, and standard errors of ln |Z| and of the phase [rad], from the covariance of a fit.

    var = J cov Jᵀ,    J = ∂(ln |Z|, arg Z) / ∂ ln element
    """
    values, logs = np.asarray(fit.circuit.values()), np.asarray(fit.circuit.log_values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    z, slopes = with_slopes(fit.circuit, logs, frequency)
    parts = np.stack([(slopes / z).real, (slopes / z).imag])
    return z, np.sqrt((parts * (cov @ parts)).sum(1))
