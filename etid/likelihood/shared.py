"""The unloaded voltage of loads that share their unloaded record with calibrations.

The calibrations know X better than the unloaded record alone, and their estimate depends on z.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.likelihood.profile import Records
from etid.precision import namespace
from etid.signals.transfer import AnyArray, as_complex, power


class Calibrated(NamedTuple):
    """Calibrations that may share their unloaded record with a load.

    Attributes:
        x: Coefficients of their inputs.
        y: Coefficients of their outputs.
        variance_y: E|noise|² of these.
        used: Harmonics that are used.
        gains: Their gains at z = 0.
        gains_by_z: Derivatives of these.
    """

    x: Complex[AnyArray, "calibration bin"]
    y: Complex[AnyArray, "calibration bin"]
    variance_y: Float[AnyArray, "calibration bin"]
    used: Bool[AnyArray, "calibration bin"]
    gains: Complex[AnyArray, "calibration bin"]
    gains_by_z: Complex[AnyArray, "z calibration bin"]


class Unloaded(NamedTuple):
    """The X of loads that the calibrations estimate, as a function of z.

    Attributes:
        x: X at z = 0.
        variance: Its variance there.
        x_by_z: Derivatives of X.
        log_variance_by_z: Derivatives of the logarithm of the variance.
    """

    x: Complex[AnyArray, "*row bin"]
    variance: Float[AnyArray, "*row bin"]
    x_by_z: Complex[AnyArray, "*row z bin"]
    log_variance_by_z: Float[AnyArray, "*row z bin"]

    @classmethod
    def by(
        cls, known: Calibrated, records: Records, same: Bool[AnyArray, "*row calibration"]
    ) -> "Unloaded":
        """X of records that share it with the calibrations of which `same` says so.

        1/v = 1/σ_x² + Σ |g|²/σ_y²,      X̂ = v (x/σ_x² + Σ conj(g) y/σ_y²)
        """
        xp = namespace(records.x)
        weight = xp.where(known.used & same[..., None], 1 / known.variance_y, 0.0)
        told = 1 / records.variance_x + (weight * power(known.gains)).sum(-2)
        back = (as_complex(weight) * xp.conj(known.gains) * known.y).sum(-2)
        variance = 1 / told
        x = as_complex(variance) * (records.x * as_complex(1 / records.variance_x) + back)
        by_z, weight = known.gains_by_z, weight[..., None, :, :]
        grows = 2 * (weight * (xp.conj(known.gains) * by_z).real).sum(-2)
        log_variance = -variance[..., None, :] * grows
        moved = (as_complex(weight) * xp.conj(by_z) * known.y).sum(-2)
        moved = as_complex(variance)[..., None, :] * moved
        return cls(x, variance, moved + as_complex(log_variance) * x[..., None, :], log_variance)

    def of(self, rows: np.ndarray) -> "Unloaded":
        """Those of some of the rows."""
        return Unloaded(*(each[rows] for each in self))

    def at(
        self, z: Float[AnyArray, "*row z"]
    ) -> tuple[Complex[AnyArray, "*row bin"], Float[AnyArray, "*row bin"]]:
        """X and its variance."""
        xp = namespace(z)
        x = self.x + (as_complex(z)[..., None] * self.x_by_z).sum(-2)
        growth = xp.exp((z[..., None] * self.log_variance_by_z).sum(-2))
        return x, self.variance * growth
