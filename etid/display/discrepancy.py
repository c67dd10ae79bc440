"""Circuits that are not exact, on-line: a smooth unknown error δ of the gain in all pulses.

The gain is G e^δ, with the δ of `etid.likelihood.discrepancy`: κ is the mean of its covariances
over lengths and powers, of a stated size. It is the same in every pulse, so that no number of
pulses lessens what it does to the elements: that is in `shared_cov`. In a pulse, the covariance of
the residual divided by the measured gain is that of noise and δ,

    C = D + κ,    D = 1 / (w |Ĝ|²),

equal for real and imaginary parts and independent between them, so that one real triangular matrix
makes parts of variance 1 of it. With the weights w alone, an error of 0.2 % of the gain makes
every pulse a misfit.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.display.gain_bands import Bands
from etid.likelihood.discrepancy import kernels, root_of, splines
from etid.precision import namespace
from etid.signals.transfer import AnyArray, as_complex, power


def functions(bands: Bands, size: float) -> Float[np.ndarray, "function band"]:
    """Functions of δ in the bands, whose coefficients are N(0, 1).

    Args:
        bands: The bands.
        size: Standard deviation of the real and of the imaginary part.
    """
    bins = bands.x.size
    centres = np.asarray(bands.frequency) * bands.samples / bands.sample_rate
    nearest = np.clip(np.round(centres).astype(int), 1, bins) - 1
    return size * root_of(kernels(bins).mean(0)).T @ splines(bins)[:, nearest]


class Smooth(NamedTuple):
    """What makes parts of variance 1 of noise and δ.

    Attributes:
        phase: e^(−j arg Ĝ).
        root: L of L Lᵀ = 1 + √D⁻¹ κ √D⁻¹.
        inverse: L⁻¹.
    """

    phase: Complex[AnyArray, "*row band"]
    root: Float[AnyArray, "*row band band"]
    inverse: Float[AnyArray, "*row band band"]

    @classmethod
    def of(
        cls,
        functions: Float[AnyArray, "function band"],
        gain: Complex[AnyArray, "*row band"],
        weight: Float[AnyArray, "*row band"],
    ) -> "Smooth":
        """That of a pulse.

        Args:
            functions: Those of δ.
            gain: Gain; where noise makes it uncertain, δ is far less than noise.
            weight: Weight of |Ĝ − G|².
        """
        xp = namespace(gain)
        size = xp.sqrt(power(gain))
        phase = xp.conj(gain) / as_complex(xp.where(size > 0, size, 1.0))
        each = functions * (xp.sqrt(weight) * size)[..., None, :]
        root = xp.linalg.cholesky(np.eye(size.shape[-1]) + each.swapaxes(-1, -2) @ each)
        return cls(phase, root, xp.linalg.inv(root))

    def __call__(
        self, values: Complex[AnyArray, "*row value band"]
    ) -> Complex[AnyArray, "*row value band"]:
        """Of values in standard deviations of the noise."""
        return (values * self.phase[..., None, :]) @ as_complex(self.inverse.swapaxes(-1, -2))

    def transposed(
        self, values: Complex[AnyArray, "*row value band"]
    ) -> Complex[AnyArray, "*row value band"]:
        """The transposed operation."""
        values = values @ as_complex(self.inverse)
        return values * namespace(values).conj(self.phase)[..., None, :]

    def undone(
        self, values: Complex[AnyArray, "*row value band"]
    ) -> Complex[AnyArray, "*row value band"]:
        """The values in standard deviations of the noise; the phase remains turned."""
        return values @ as_complex(self.root.swapaxes(-1, -2))
