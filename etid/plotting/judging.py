"""Pictures that judge a fit: its impedance beside the measured one, and its residual."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from matplotlib.axes import Axes

from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import fed
from etid.identify.predict import predict
from etid.plotting.bands import CLEAR, bands
from etid.plotting.impedances import POINTS, frame
from etid.plotting.pulses import headline
from etid.plotting.style import BLUE, INK, RED, Canvas, titled
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.results.data import MeasuredImpedance
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import MeasuredCurrent
from etid.results.fit import Fit


def draw_impedance(
    canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None
) -> np.ndarray:
    """Nyquist and Bode diagrams: the impedance that the recording measures, and the fit."""
    recording, known = in_bands(recording, driver)
    measured = bands(Harmonics.of(Inspected(recording)), known, fit.circuit)
    clear = measured.stderr <= CLEAR
    points = measured.frequency[clear], measured.z[clear], measured.stderr[clear]
    return _diagrams(canvas, fit, headline(recording.path, fit), *points)


def draw_measured(canvas: Canvas, fit: Fit, measured: MeasuredImpedance) -> np.ndarray:
    """Nyquist and Bode diagrams: the impedance that an instrument measured, and the fit."""
    error = None if measured.stderr is None else measured.stderr / np.abs(measured.z)
    return _diagrams(canvas, fit, headline("", fit), measured.frequency, measured.z, error)


def _diagrams(
    canvas: Canvas,
    fit: Fit,
    title: str,
    frequency: Float[np.ndarray, " point"],
    z: Complex[np.ndarray, " point"],
    stderr: Float[np.ndarray, " point"] | None,
) -> np.ndarray:
    """Nyquist and Bode diagrams of measured points, with standard errors of ln Z, and of a fit."""
    nyquist, magnitude, phase = axes = canvas(1, 3, (12.0, 3.8)).ravel()
    kilohertz, kiloohm = frequency / 1e3, z / 1e3
    smooth = np.geomspace(kilohertz.min() / 1.3, kilohertz.max() * 1.3, POINTS)
    fitted = np.asarray(fit.circuit.response(jnp.asarray(1e3 * smooth))) / 1e3
    curve = {"color": RED, "lw": 1.3, "label": "fit"}
    label = "measured" if stderr is None else "measured, ± 2 standard errors"
    point = {"fmt": "o", "ms": 4, "lw": 0.8, "color": BLUE, "label": label}
    turn = None if stderr is None else 2 * stderr
    size = None if turn is None else turn * np.abs(kiloohm)
    nyquist.plot(np.real(fitted), -np.imag(fitted), **curve)
    nyquist.errorbar(np.real(kiloohm), -np.imag(kiloohm), yerr=size, xerr=size, **point)
    nyquist.set(xlabel="Re Z [kΩ]", ylabel="-Im Z [kΩ]")
    nyquist.set_aspect("equal", adjustable="datalim")
    magnitude.plot(smooth, np.abs(fitted), **curve)
    magnitude.errorbar(kilohertz, np.abs(kiloohm), size, **point)
    magnitude.set(xlabel="frequency [kHz]", ylabel="|Z| [kΩ]", xscale="log", yscale="log")
    phase.plot(smooth, np.degrees(np.angle(fitted)), **curve)
    phase.errorbar(
        kilohertz, np.degrees(np.angle(z)), None if turn is None else np.degrees(turn), **point
    )
    phase.set(xlabel="frequency [kHz]", ylabel="phase [deg]", xscale="log")
    frame(magnitude, phase, np.abs(kiloohm))
    magnitude.xaxis.set_major_formatter("{x:g}")
    magnitude.legend(frameon=False, fontsize=8)
    good = fit.verdict == "successful"
    titled(nyquist, [title], good=good)
    titled(magnitude, [",  ".join(fit.elements)], good=good)
    return axes


def in_bands(
    recording: Recording, driver: Driver | None
) -> tuple[Recording, ContinuousDriver | MeasuredCurrent]:
    """A recording and its feed, for the impedance that it measures.

    Raises:
        ValueError: The driver has no continuous source impedance.
        RecordingError: The recording lacks what its feed needs.
    """
    recording, feed = fed(recording, driver)
    if isinstance(feed, MeasuredCurrent):
        return recording, feed
    return recording, serving(feed, ContinuousDriver, MAXIMUM_LIKELIHOOD.name)


def draw_residual(
    canvas: Canvas, fit: Fit, recording: Recording, driver: Driver | None
) -> np.ndarray:
    """The residual, its autocorrelation, and its cross-correlation with V_th or the current.

    A residual of white noise has correlations within the band at 99 % of the lags.
    """
    whole, own, with_input = axes = canvas(1, 3, (12.0, 3.4)).ravel()
    residual = predict(recording, driver, fit.circuit) - recording.v_out
    known = np.isfinite(residual)
    whole.plot(1e3 * recording.time, 1e3 * residual, color=BLUE, lw=0.5)
    whole.set(xlabel="time [ms]", ylabel="residual [mV]")
    cause = fed(recording, driver)[0].cause
    clean, cause_known = residual[known], recording.samples[cause].values[known]
    _correlation(own, clean, clean, "autocorrelation of the residual")
    name = "V_th" if cause == "v_th" else "current"
    _correlation(with_input, clean, cause_known, f"correlation with earlier {name}")
    titled(whole, [headline(recording.path, fit)], good=fit.verdict == "successful")
    titled(own, ["band: 99 % of white noise"])
    return axes


def _correlation(
    axis: Axes, one: Float[np.ndarray, " time"], other: Float[np.ndarray, " time"], label: str
) -> None:
    """Correlation coefficients of `one` with `other` at earlier times, over the lag.

    99 % of white noise does not exceed 2.58 standard deviations.
    """
    one, other = one - one.mean(), other - other.mean()
    lags = np.arange(-60, 61)
    norm = np.sqrt(np.sum(one**2) * np.sum(other**2))
    size = one.size
    products = [
        np.dot(one[max(lag, 0) : size + min(lag, 0)], other[max(-lag, 0) : size - max(lag, 0)])
        for lag in lags
    ]
    band = 2.58 / np.sqrt(size)
    axis.axhspan(-band, band, color="0.85", lw=0)
    axis.vlines(lags, 0.0, np.array(products) / norm, color=INK, lw=0.9)
    axis.set(xlabel="lag [samples]", ylabel=label)
