"""Pictures of impedances over frequency, with bands of two standard errors."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatterMathtext

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


class Bode(NamedTuple):
    """Axes of magnitude and phase, and the sizes and symbols of their units; data are in SI.

    Attributes:
        magnitude: Axes of |Z|.
        phase: Axes of the phase [deg].
        z: Unit of |Z| [Ω].
        f: Unit of the frequency [Hz].
    """

    magnitude: Axes
    phase: Axes
    z: tuple[float, str] = (1e3, "kΩ")
    f: tuple[float, str] = (1e3, "kHz")

    def curve(
        self,
        frequency: Float[np.ndarray, " frequency"],
        z: Complex[np.ndarray, " frequency"],
        **look: Any,
    ) -> None:
        """Draw an impedance [Ω] over frequency [Hz]."""
        self.magnitude.plot(frequency / self.f[0], np.abs(z) / self.z[0], **look)
        self.phase.plot(frequency / self.f[0], np.degrees(np.unwrap(np.angle(z))), **look)

    def band(
        self,
        frequency: Float[np.ndarray, " frequency"],
        z: Complex[np.ndarray, " frequency"],
        stderr: Float[np.ndarray, "2 frequency"],
        **look: Any,
    ) -> None:
        """Draw two standard errors of ln |Z| and of the phase [rad]."""
        size, angle = np.abs(z) / self.z[0], np.unwrap(np.angle(z))
        factor = np.exp(np.minimum(2 * stderr[0], 50))  # it is finite beyond every axis
        look = {"alpha": 0.25, "linewidth": 0, **look}
        self.magnitude.fill_between(frequency / self.f[0], size / factor, size * factor, **look)
        ends = np.degrees([angle - 2 * stderr[1], angle + 2 * stderr[1]])
        self.phase.fill_between(frequency / self.f[0], *ends, **look)

    def points(
        self,
        frequency: Float[np.ndarray, " point"],
        z: Complex[np.ndarray, " point"],
        stderr: Float[np.ndarray, " point"] | None,
        **look: Any,
    ) -> None:
        """Draw measured impedances [Ω], with two standard errors of ln Z if they are known."""
        at, size, degrees = frequency / self.f[0], np.abs(z) / self.z[0], np.degrees(np.angle(z))
        ends = turn = None
        if stderr is not None:
            ends = size * (1 - np.exp(-2 * stderr)), size * (np.exp(2 * stderr) - 1)
            turn = np.degrees(2 * stderr)
        self.magnitude.errorbar(at, size, ends, fmt="o", **look)
        self.phase.errorbar(at, degrees, turn, fmt="o", **look)

    def frame(self, z: Complex[np.ndarray, " value"]) -> None:
        """Label the axes, with limits that show these impedances [Ω] even if the bands are wide."""
        self.magnitude.set(ylabel=f"|Z| [{self.z[1]}]", xscale="log", yscale="log")
        self.phase.set(ylabel="phase [deg]", xscale="log")
        sizes = np.abs(z[np.isfinite(z)]) / self.z[0]
        if sizes.size:
            self.magnitude.set_ylim(sizes.min() / 1.5, sizes.max() * 1.5)
        low, high = self.phase.get_ylim()
        self.phase.set_ylim(max(low, -180.0), min(high, 180.0))
        plain_ticks(self.magnitude.yaxis)
        for axis in (self.magnitude.xaxis, self.phase.xaxis):
            axis.set_major_formatter(LogFormatterMathtext() if self.f[0] == 1.0 else "{x:g}")


def draw_bode(canvas: Canvas, things: Mapping[str, Impedance]) -> np.ndarray:
    """Magnitude and phase of impedances (the paper's figure 9), with bands."""
    axes = canvas(2, 1, (6.0, 5.0), sharex=True).ravel()
    bode = Bode(*axes)
    # From the paper's pulse rate to half its sample rate.
    frequency = np.geomspace(60.0, 100e3, POINTS)
    drawn, banded, failed = [], False, []
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
        bode.curve(frequency, z, label=typeset(label), **look)
        drawn.append(z)
        if known:
            banded = True
            bode.band(frequency, z, errors, color=look["color"])
    bode.phase.set(xlabel="frequency [kHz]")
    bode.frame(np.concatenate(drawn))
    legend(axes)
    said = failed or ["bands: two standard errors" if banded else ""]
    titled(bode.magnitude, said, good=not failed)
    return axes


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
