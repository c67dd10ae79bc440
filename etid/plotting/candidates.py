"""Picture of the choice between circuits: what a recording measures, and each candidate."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from etid.estimators.lanes import Harmonics
from etid.plotting.bands import CLEAR, Bands, bands
from etid.plotting.impedances import POINTS, frame
from etid.plotting.judging import in_bands
from etid.plotting.pulses import headline
from etid.plotting.style import COLOURS, DASHES, INK, MARKS, RED, Canvas, titled
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver
from etid.selection.selection import Candidate, Selection


def draw_selection(
    canvas: Canvas, selection: Selection, recording: Recording, driver: Driver | None
) -> np.ndarray:
    """Magnitude and phase with all candidates, and below them the deviation of each candidate."""
    ratios = {"height_ratios": [3, 1.6]}
    axes = canvas(2, 2, (9.0, 5.2), sharex=True, gridspec_kw=ratios).ravel()
    chosen = selection.candidates[0]
    good = chosen.fit.verdict == "successful"
    lines = [
        headline(recording.path, selection.fit),
        chosen.name,
        ",  ".join(selection.fit.elements),
    ]
    fitted = [one for one in selection.candidates if _has_elements(one)]
    if not fitted or fitted[0] is not chosen:
        axes[0].text(0.5, 0.5, "no elements", color=RED, transform=axes[0].transAxes, ha="center")
        titled(axes[0], lines[:1], good=False)
        return axes
    recording, known = in_bands(recording, driver)
    lane = Harmonics.of(Inspected(recording))
    lane = lane.realigned(lane.late_by(chosen.fit.circuit, known))
    if int(chosen.fit.remarks) & Remark.mains_hum:
        lane = lane.without_mains() or lane
    found = [bands(lane, known, one.fit.circuit) for one in fitted]
    _points(axes[0], axes[1], found[0])
    _lines(axes[0], axes[1], fitted, found[0])
    _deviations(axes[2], axes[3], found)
    titled(axes[0], lines, good=good)
    return axes


def _has_elements(candidate: Candidate) -> bool:
    return bool(np.isfinite(np.asarray(candidate.fit.circuit.values())).all())


def _look(number: int) -> dict[str, Any]:
    """Look of a candidate; the first one is the chosen one."""
    colour, dash = COLOURS[number % len(COLOURS)], DASHES[number % len(DASHES)]
    # The bold line lies below the others, which it would hide.
    width, layer = (1.1, 2.5) if number else (2.2, 2.2)
    return {"color": colour, "linestyle": dash, "lw": width, "zorder": layer}


def _points(magnitude: Axes, phase: Axes, measured: Bands) -> None:
    """The measured impedance with two standard errors; uncertain points are pale."""
    kilohertz, degrees = measured.frequency / 1e3, np.degrees(np.angle(measured.z))
    kilohms = np.abs(measured.z) / 1e3
    for some, alpha in (
        (measured.stderr <= CLEAR, 1.0),
        ((measured.stderr > CLEAR) & (measured.stderr <= 1.0), 0.3),
    ):
        look = {"color": INK, "fmt": "o", "ms": 3.5, "lw": 0.9, "capsize": 2.0, "alpha": alpha}
        error = 2 * measured.stderr[some]
        size = kilohms[some]
        ends = size * (1 - np.exp(-error)), size * (np.exp(error) - 1)
        label = "measured" if alpha == 1.0 else None
        magnitude.errorbar(kilohertz[some], size, ends, label=label, **look)
        phase.errorbar(kilohertz[some], degrees[some], np.degrees(error), **look)


def _lines(magnitude: Axes, phase: Axes, fitted: list[Candidate], measured: Bands) -> None:
    """The impedances of the candidates."""
    frequency = jnp.geomspace(measured.frequency[0], measured.frequency[-1], POINTS)
    kilohertz, sizes = np.asarray(frequency) / 1e3, []
    for number, one in enumerate(fitted):
        z = np.asarray(one.fit.circuit.response(frequency))
        sizes.append(np.abs(z) / 1e3)
        look = _look(number)
        magnitude.plot(kilohertz, sizes[-1], label=_label(number, one), **look)
        phase.plot(kilohertz, np.degrees(np.angle(z)), **look)
    magnitude.set(ylabel="|Z| [kΩ]", xscale="log", yscale="log")
    phase.set(ylabel="phase [deg]")
    clear = measured.stderr <= CLEAR
    frame(magnitude, phase, np.concatenate([*sizes, np.abs(measured.z[clear]) / 1e3]))
    magnitude.legend(frameon=False, fontsize=8, loc="lower left")


def _label(number: int, one: Candidate) -> str:
    if number == 0:
        return f"{one.name}, chosen"
    verdict = "" if one.fit.verdict == "successful" else f", {one.fit.verdict}"
    return f"{one.name}, 2 log evidence {one.evidence:+.0f}{verdict}"


def _deviations(magnitude: Axes, phase: Axes, found: list[Bands]) -> None:
    """Measured minus fitted, in standard errors: up to 4 to scale, beyond by logarithm."""
    plain = 4.0
    largest = max(plain, *(np.abs(of.deviation).max() for of in found))
    for part, (axis, name) in enumerate(((magnitude, "ln |Z|"), (phase, "phase"))):
        axis.axhspan(-2.0, 2.0, color="0.85", lw=0)
        axis.axhline(0.0, color="0.6", lw=0.6)
        for number, of in enumerate(found):
            mark = {"marker": MARKS[number % len(MARKS)], "ms": 3.0}
            axis.plot(of.frequency / 1e3, of.deviation[part], **_look(number), **mark)
        axis.set(xlabel="frequency [kHz]", ylabel=f"measured - fitted\n{name} [stderr]")
        axis.set_yscale("symlog", linthresh=plain, linscale=1.0)
        ticks = [tick for tick in (2.0, 10.0, 100.0, 1000.0, 10000.0) if tick <= largest]
        axis.yaxis.set_major_locator(FixedLocator([*(-t for t in ticks), 0.0, *ticks]))
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(-1.4 * largest, 1.4 * largest)
        axis.xaxis.set_major_formatter("{x:g}")
