"""What the harmonics of a recording say about an impedance, averaged in bands of frequency.

The deviation of the measured gain from that of a circuit, e = Y − G X, is a relative deviation of
its impedance,

    u = e / (G X (1 − G)),      because  ∂ ln G/∂ ln Z = 1 − G  for  G = Z / (Z + Z_th).

Its real part belongs to ln |Z|, its imaginary part to the phase. In a band the harmonics k are
averaged with the weights 2 |G X (1 − G)|² / var e, the reciprocal variance of each part. X is
estimated from both records, (σ_y² X + σ_x² G* Y) / (σ_y² + |G|² σ_x²): its noise is independent of
that of e, so that noise does not bias the average.

With a measured current G = Z, and 1 takes the place of 1 − G. As in the fit, the trigger delay is
free, and the parameters of Z_th move within their covariance.
"""

import dataclasses
from typing import Any

import numpy as np
import scipy
from jaxtyping import Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import serving
from etid.estimators.lanes import Harmonics
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import fed
from etid.likelihood.source_prior import delay_width
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import AbstractFeed, MeasuredCurrent

CLEAR = 0.3  # relative standard error up to which the impedance of a band is drawn as a clear point


@dataclasses.dataclass(frozen=True)
class Bands:
    """An impedance as measured in bands, relative to that of a circuit.

    Attributes:
        frequency: Weighted mean of each band [Hz].
        z: Impedance [Ω].
        stderr: Standard error of ln |Z|, and of the phase [rad].
        deviation: ln |Z| and phase, minus those of the circuit [standard errors].
    """

    frequency: Float[np.ndarray, " band"]
    z: Complex[np.ndarray, " band"]
    stderr: Float[np.ndarray, " band"]
    deviation: Float[np.ndarray, "2 band"]


def continuous(
    recording: Recording, driver: Driver | None
) -> tuple[Recording, ContinuousDriver | MeasuredCurrent]:
    """A recording and its feed, in continuous time.

    Raises:
        ValueError: The driver has no continuous source impedance.
        RecordingError: The recording lacks what its feed needs.
    """
    recording, feed = fed(recording, driver)
    if isinstance(feed, MeasuredCurrent):
        return recording, feed
    return recording, serving(feed, ContinuousDriver, MAXIMUM_LIKELIHOOD.name)


def used(
    seen: Inspected, feed: AbstractFeed, circuit: AbstractCircuit, remarks: Int[Any, ""]
) -> Harmonics:
    """Harmonics of a recording as a fit with these remarks used them."""
    lane = Harmonics.of(seen)
    lane = lane.realigned(lane.late_by(circuit, feed))
    hums = int(remarks) & Remark.mains_hum
    return (lane.without_mains() if hums else None) or lane


def bands(
    lane: Harmonics, feed: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
) -> Bands:
    """The impedance that a recording measures, next to that of a circuit.

    Args:
        lane: Harmonics of the recording.
        feed: Driver with its covariance, or the measured current.
        circuit: Fitted circuit.
    """
    gain, turned, z_th = fitted(lane, feed, circuit)
    var = lane.variance_y + np.abs(turned) ** 2 * lane.variance_x
    x = (lane.variance_y * lane.x + lane.variance_x * np.conj(turned) * lane.y) / var
    by_load = np.ones_like(gain) if z_th is None else 1 - gain  # ∂ ln G/∂ ln Z
    slope = turned * x * by_load
    weight = np.where(lane.selected, 2 * np.abs(slope) ** 2 / var, 0.0)
    rest = lane.y - turned * lane.x
    score = np.where(lane.selected, 2 * rest * np.conj(slope) / var, 0.0)

    frequency = np.asarray(lane.frequency)
    number = np.round(6 * np.log10(frequency / frequency[0])).astype(int)  # six bands a decade
    total = np.bincount(number, weight)
    kept = total > 0
    total = total[kept]

    def mean(values: Float[np.ndarray, " harmonic"]) -> Float[np.ndarray, " band"]:
        return np.bincount(number, values)[kept] / total

    centre = np.exp(mean(weight * np.log(frequency)))
    off = mean(np.real(score)) + 1j * mean(np.imag(score))
    z = np.asarray(circuit.response(centre))
    if z_th is None:
        impedance = z * (1 + off)
    else:
        source = np.interp(centre, frequency, z_th)
        # Large deviations are exact for the gain, not for the impedance.
        at = z / (z + source)
        measured = at * (1 + off * (1 - at))
        impedance = source * measured / (1 - measured)
    return Bands(
        centre,
        impedance,
        1 / np.sqrt(total),
        np.stack([off.real, off.imag]) * np.sqrt(total),
    )


def fitted(
    lane: Harmonics, feed: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
) -> tuple[
    Complex[np.ndarray, " harmonic"],
    Complex[np.ndarray, " harmonic"],
    Complex[np.ndarray, " harmonic"] | None,
]:
    """G, G e^(−jωτ) and Z_th at the delay τ and the changes of Z_th that fit the recording.

    Z_th is None for a measured current. Its changes are in standard deviations.
    """
    z = np.asarray(circuit.response(lane.frequency))
    turn = np.asarray(2 * np.pi * lane.frequency / lane.sample_rate)
    source, changes = None, np.zeros((0, z.size), complex)
    if not isinstance(feed, MeasuredCurrent):
        source, slopes = map(np.asarray, feed.source.with_slopes(lane.frequency))
        cov = np.asarray(feed.later_cov())
        if not np.isfinite(cov).all():  # a driver that failed is taken as it is
            cov = np.zeros_like(cov)
        size, vectors = np.linalg.eigh(cov)
        changes = (vectors * np.sqrt(np.maximum(size, 0.0))).T @ slopes
    instrument = None if isinstance(feed, MeasuredCurrent) else feed.instrument
    width = np.asarray(delay_width(instrument, np.asarray(lane.sample_rate)))
    deviations, start = np.append(width, np.ones(len(changes))), np.zeros(1 + len(changes))

    def at(p: Float[np.ndarray, " parameter"]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        z_th = None if source is None else source + p[1:] @ changes
        gain = z if z_th is None else z / (z + z_th)
        return gain, gain * np.exp(-1j * p[0] * turn), z_th

    if not np.isfinite(at(start)[0]).all():
        return at(start)
    variance = lane.variance_y + np.abs(at(start)[0]) ** 2 * lane.variance_x
    scale = np.where(lane.selected, np.sqrt(2 / variance), 0.0)

    def terms(p: Float[np.ndarray, " parameter"]) -> Float[np.ndarray, " term"]:
        rest = (lane.y - at(p)[1] * lane.x) * scale
        return np.concatenate([np.real(rest), np.imag(rest), p / deviations])

    return at(scipy.optimize.least_squares(terms, start, method="lm").x)
