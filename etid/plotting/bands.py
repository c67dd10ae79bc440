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

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import DELAY_WIDTH
from etid.estimators.lanes import Harmonics
from etid.numpy_tier.tiers import program
from etid.results.driver import ContinuousDriver, SourceImpedance
from etid.results.feed import MeasuredCurrent

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


def bands(
    lane: Harmonics, feed: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
) -> Bands:
    """The impedance that a recording measures, next to that of a circuit.

    Args:
        lane: Harmonics of the recording.
        feed: Driver with its covariance, or the measured current.
        circuit: Fitted circuit.
    """
    terms = _Terms.of(lane, feed, circuit)
    p = terms.fitted()
    gain, turned, z_th = terms.at(p)
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
    z = np.asarray(circuit.response(jax.device_put(centre)))
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


@program
def _source(
    source: SourceImpedance, frequency: Float[Array, " harmonic"]
) -> tuple[Complex[Array, " harmonic"], Complex[Array, "parameter harmonic"]]:
    """Z_th and its derivatives with respect to its parameters."""
    values, unflatten = ravel_pytree(source)

    def z_th(p: Float[Array, " parameter"]) -> Complex[Array, " harmonic"]:
        return unflatten(p).response(frequency)

    return z_th(values), jax.jacfwd(z_th)(values).T


@dataclasses.dataclass(frozen=True)
class _Terms:
    """The terms of a recording as a function of its delay and of the Z_th of its driver.

    The parameters are the delay [samples] and changes of Z_th in standard deviations.

    Attributes:
        lane: Harmonics of the recording.
        z: Impedance of the load [Ω].
        z_th: Source impedance [Ω]; None for a measured current.
        slopes: Derivatives of Z_th with respect to its changes [Ω].
    """

    lane: Harmonics
    z: Complex[np.ndarray, " harmonic"]
    z_th: Complex[np.ndarray, " harmonic"] | None
    slopes: Complex[np.ndarray, "change harmonic"]

    @classmethod
    def of(
        cls, lane: Harmonics, feed: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
    ) -> "_Terms":
        frequency = jax.device_put(lane.frequency)
        z = np.asarray(circuit.response(frequency))
        if isinstance(feed, MeasuredCurrent):
            return cls(lane, z, None, np.zeros((0, z.size), complex))
        z_th, slopes = map(np.asarray, _source(feed.source, frequency))
        size, turn = np.linalg.eigh(np.asarray(feed.later_cov()))
        root = turn * np.sqrt(np.maximum(size, 0.0))
        return cls(lane, z, z_th, root.T @ slopes)

    def at(
        self, p: Float[np.ndarray, " parameter"]
    ) -> tuple[
        Complex[np.ndarray, " harmonic"],
        Complex[np.ndarray, " harmonic"],
        Complex[np.ndarray, " harmonic"] | None,
    ]:
        """G, G e^(−jωτ) and Z_th."""
        z_th = None if self.z_th is None else self.z_th + p[1:] @ self.slopes
        gain = self.z if z_th is None else self.z / (self.z + z_th)
        return gain, gain * np.exp(-1j * p[0] * self._turn), z_th

    @property
    def _turn(self) -> Float[np.ndarray, " harmonic"]:
        return np.asarray(2 * np.pi * self.lane.frequency / self.lane.sample_rate)

    def _residual(
        self, p: Float[np.ndarray, " parameter"]
    ) -> tuple[Float[np.ndarray, " term"], Float[np.ndarray, "parameter term"]]:
        """Terms with the priors, and their derivatives without those of the variance."""
        lane = self.lane
        _, turned, z_th = self.at(p)
        var = lane.variance_y + np.abs(turned) ** 2 * lane.variance_x
        scale = np.where(lane.selected, np.sqrt(2 / var), 0.0)
        by_z_th = self.slopes if z_th is None else -self.slopes / (self.z + z_th)
        by = np.concatenate([-1j * self._turn[None], by_z_th]) * (turned * lane.x * -scale)
        rest = (lane.y - turned * lane.x) * scale
        prior = np.diag(np.append(1 / DELAY_WIDTH, np.ones(p.size - 1)))
        terms = np.concatenate([np.real(rest), np.imag(rest), prior @ p])
        return terms, np.concatenate([np.real(by), np.imag(by), prior], axis=1)

    def fitted(self) -> Float[np.ndarray, " parameter"]:
        """The parameters that fit the recording."""

        def cost(p: Float[np.ndarray, " parameter"]) -> float:
            return float(np.sum(self._residual(p)[0] ** 2))

        p = np.zeros(len(self.slopes) + 1)
        for _ in range(6):  # the terms are almost linear
            terms, slopes = self._residual(p)
            step = -np.linalg.lstsq(slopes.T, terms)[0]
            # Parts of a step, for circuits that are far from the data.
            p = min((p + part * step for part in (1.0, 0.3, 0.1, 0.03, 0.0)), key=cost)
        return p
