"""Pictures of impedances over frequency, with bands of two standard errors."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Complex, Float
from matplotlib.axes import Axes

from etid.circuits.circuit import AbstractCircuit
from etid.numpy_tier.tiers import program
from etid.plotting.style import COLOURS, DASHES, Canvas, plain_ticks, titled, typeset
from etid.results.driver import Driver, SourceImpedance
from etid.results.fit import Fit
from etid.solvers.matrices import log_stderr

LOWEST, HIGHEST = 60.0, 100e3  # [Hz] the paper's pulse rate and half its sample rate
POINTS = 300


def draw_bode(
    canvas: Canvas, things: Mapping[str, Driver | Fit | AbstractCircuit | SourceImpedance]
) -> np.ndarray:
    """Magnitude and phase of impedances (the paper's figure 9), with bands."""
    magnitude, phase = axes = canvas(2, 1, (6.0, 5.0), sharex=True).ravel()
    frequency = jax.device_put(np.geomspace(LOWEST, HIGHEST, POINTS))
    kilohertz = np.asarray(frequency) / 1e3
    sizes, banded, failed = [], False, []
    for i, (label, thing) in enumerate(things.items()):
        z = np.asarray(impedance(thing).response(frequency))
        errors = np.asarray(stderr(thing, frequency))
        known = bool(np.isfinite(errors).all())
        if isinstance(thing, Fit | Driver):
            if thing.verdict != "successful":
                failed.append(f"{label}: no success: {thing.verdict}")
            label = label if known else f"{label}, no standard error"
        colour, dash = COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]
        curve(
            magnitude,
            phase,
            frequency,
            z,
            label=typeset(label),
            color=colour,
            linestyle=dash,
            lw=1.3,
        )
        sizes.append(np.abs(z) / 1e3)
        if known:
            banded = True
            band = {"color": colour, "alpha": 0.25, "linewidth": 0}
            factor = np.exp(np.minimum(2 * errors[0], 50))  # it is finite beyond every axis
            magnitude.fill_between(kilohertz, sizes[-1] / factor, sizes[-1] * factor, **band)
            angle, turn = np.unwrap(np.angle(z)), 2 * errors[1]
            phase.fill_between(kilohertz, *np.degrees([angle - turn, angle + turn]), **band)
    phase.set(xlabel="frequency [kHz]")
    frame(magnitude, phase, np.concatenate(sizes))
    magnitude.legend(frameon=False, fontsize=8)
    titled(magnitude, failed or ["bands: two standard errors" if banded else ""], good=not failed)
    return axes


def curve(
    magnitude: Axes,
    phase: Axes,
    frequency: Float[Array | np.ndarray, " frequency"],
    z: Complex[np.ndarray, " frequency"],
    **look: Any,
) -> None:
    """Draw an impedance [Ω] over frequency [Hz], in kΩ and degrees over kHz."""
    kilohertz = np.asarray(frequency) / 1e3
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


def impedance(
    thing: Driver | Fit | AbstractCircuit | SourceImpedance,
) -> Driver | AbstractCircuit | SourceImpedance:
    """The object with an impedance: the circuit of a fit, otherwise `thing` itself."""
    if not isinstance(thing, Fit):
        return thing
    if np.ndim(thing.rrse):
        raise TypeError(f"this is a batch of {np.shape(thing.rrse)} fits; draw one fit, fits[i]")
    return thing.circuit


def stderr(
    thing: Driver | Fit | AbstractCircuit | SourceImpedance,
    frequency: Float[Array, " frequency"],
) -> Float[Array | np.ndarray, "2 frequency"]:
    """Standard errors of ln |Z| and of the phase [rad]; NaN where there is no covariance."""
    if isinstance(thing, Driver):
        return thing.log_response_stderr(frequency)
    if isinstance(thing, Fit):
        return _of_circuit(thing.circuit, jax.device_put(thing.cov), frequency)
    return np.full((2, frequency.size), np.nan)


@program
def _of_circuit(
    circuit: AbstractCircuit,
    cov: Float[Array, "parameter parameter"],
    frequency: Float[Array, " frequency"],
) -> Float[Array, "2 frequency"]:
    """`stderr` of a circuit with the covariance of its parameters."""
    kind, names = type(circuit), circuit.names()

    def response(values: Float[Array, " parameter"]) -> Complex[Array, " frequency"]:
        return kind(**{name: values[i] for i, name in enumerate(names)}).response(frequency)

    return log_stderr(response, circuit.values(), cov)
