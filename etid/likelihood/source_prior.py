"""What is known of a driver and of trigger delays before any record: weak priors.

Without a prior, a pole that a noisy recording does not determine would diverge, for example to Q =
∞, and the search with it. At 60 dB a recording has at least 1e4 times the information of this
prior. Its centres, with one standard deviation as a factor, are:

- First section, the resonance: half the Nyquist frequency (e^3), a damping ratio of 0.7 (e^1.5).
- Further sections, an overdamped tail above the band: 1.5 times the Nyquist frequency (e^1.5), a
  damping ratio of 1.5 (e^0.5). If the trigger delay is fitted too, noise produces a second sharp
  resonance beside the first; this prior prevents it.
- Slow real pole: 1/500 of half the Nyquist frequency (e^3).
- Impedances: 0, with a standard deviation of 10 times the known resistor.

A transformer is passive, so Re Z_th ≥ 0 at all frequencies, inside the recorded band and above it.
Otherwise the loaded driver would oscillate with some skins. Each frequency with Re Z_th < 0 adds
the residual Re Z_th / (10⁻³ R_L).
"""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.precision import array_function, namespace
from etid.results.feed import SourceImpedance
from etid.results.instrument import Instrument
from etid.signals import modal
from etid.signals.transfer import AnyArray

PASSIVE_BAND = np.geomspace(1e-4, 10.0, 128)  # of the sample rate
# [samples] Standard deviation of the weak prior of a delay. A delay above one sample is a misfit.
DELAY_WIDTH = np.float64(0.5)
# [samples] Approximate standard deviation of the delay if the resistors differ.
KNOWN_DELAY = 1e-9
# Relative difference of resistors; with a smaller one, the delays of their records are unknown.
SAME_LOAD = 0.01


@dataclasses.dataclass(frozen=True)
class SourcePrior:
    """The weak prior of the modal parameters of Z_th, as further residuals.

    Attributes:
        sections: Number of sections of Z_th.
        centre: Centres of the parameters.
        width: Standard deviations of the parameters.
        frequency: Frequencies at which Re Z_th should not be negative [Hz].
        unit: Standard deviation of a negative Re Z_th [Ω].
    """

    sections: int
    centre: Float[AnyArray, " parameter"]
    width: Float[AnyArray, " parameter"]
    frequency: Float[AnyArray, " bin"]
    unit: Float[AnyArray, ""] | float

    @classmethod
    def of(
        cls,
        source: SourceImpedance,
        sample_rate: Float[AnyArray, ""],
        r_load: Float[AnyArray, ""],
    ) -> "SourcePrior":
        """The prior of sources of this order."""
        pairs, xp = source.log_omega.shape[0], namespace(sample_rate, r_load)
        level, rate, fixed, gain, rest = _shape(pairs, source.log_omega_real.shape[0])
        centre = xp.log(0.01 * r_load) * level + xp.log(0.5 * np.pi * sample_rate) * rate + fixed
        width = 10 * r_load * gain + rest
        return cls(pairs, centre, width, PASSIVE_BAND * sample_rate, 1e-3 * r_load)

    @array_function
    def __call__(self, parameters: Float[AnyArray, "*row parameter"]) -> AnyArray:
        """The residuals (*row term)."""
        z_th = modal.impedance(parameters, self.sections, self.frequency)
        return self._terms(parameters, z_th)

    @array_function
    def with_slopes(
        self, parameters: Float[AnyArray, "*row parameter"]
    ) -> tuple[Float[AnyArray, "*row term"], Float[AnyArray, "*row parameter term"]]:
        """The residuals and their derivatives."""
        xp = namespace(parameters)
        z_th, slopes = modal.with_slopes(parameters, self.sections, self.frequency)
        by_z = xp.where(z_th.real[..., None, :] < 0, slopes.real, 0.0) / self.unit
        own = np.eye(self.width.shape[0]) / self.width + xp.zeros((*parameters.shape, 1))
        return self._terms(parameters, z_th), xp.concatenate([own, by_z], -1)

    def _terms(
        self, parameters: Float[AnyArray, "*row parameter"], z_th: Complex[AnyArray, "*row bin"]
    ) -> Float[AnyArray, "*row term"]:
        xp = namespace(parameters)
        active = xp.minimum(z_th.real, 0.0) / self.unit
        return xp.concatenate([(parameters - self.centre) / self.width, active], -1)


@functools.lru_cache(maxsize=16)
def _shape(pairs: int, reals: int) -> tuple[Float[np.ndarray, " parameter"], ...]:
    """Which centres follow the resistor, and the rate; the rest; the same of the widths."""
    first, slow = np.arange(pairs) == 0, np.arange(reals) == 0

    def flat(
        resistance: float, omega: Any, zeta: Any, gain: float, real: Any
    ) -> Float[np.ndarray, " parameter"]:
        """Numbers in field order."""
        of_pairs = [np.broadcast_to(one, pairs) for one in (omega, zeta, gain, gain)]
        of_reals = [np.broadcast_to(one, reals) for one in (real, gain)]
        return np.concatenate([[resistance], *of_pairs, *of_reals])

    zeta, real = np.log(np.where(first, 0.7, 1.5)), np.where(slow, -math.log(500.0), 0.0)
    return (
        flat(1.0, 0.0, 0.0, 0.0, 0.0),
        flat(0.0, 1.0, 0.0, 0.0, 1.0),
        flat(0.0, np.where(first, 0.0, math.log(3.0)), zeta, 0.0, real),
        flat(0.0, 0.0, 0.0, 1.0, 0.0),
        flat(3.0, np.where(first, 3.0, 1.5), np.where(first, 1.5, 0.5), 0.0, 3.0),
    )


def delay_width(
    instrument: Instrument | None, sample_rate: Float[AnyArray, ""]
) -> Float[AnyArray, ""]:
    """Standard deviation of the prior of a delay behind this instrument [samples]."""
    delay = None if instrument is None else instrument.delay
    xp = namespace(sample_rate, *([] if delay is None else [delay]))
    if delay is None:
        return DELAY_WIDTH
    return xp.minimum(delay * sample_rate, DELAY_WIDTH)


def same_load(r_load: Float[AnyArray, " record"]) -> Bool[AnyArray, ""]:
    """Whether calibrations have the same resistor."""
    return r_load.max() - r_load.min() < SAME_LOAD * r_load.mean()


def delay_std(r_load: Float[AnyArray, " record"]) -> Float[AnyArray, ""]:
    """Standard deviation of the delay of calibrations with these resistors [samples].

    Records with the same resistor do not determine their delay. Different resistors determine it.
    """
    return namespace(r_load).where(same_load(r_load), DELAY_WIDTH, KNOWN_DELAY)
