"""What is given of the source of a load: the distribution of Z_th, or a measured current.

At the harmonics the calibrations of a driver give Z_th as nearly normal in W = log(Z_th + R),

    W = W₀ + Σ_i z_i ∂W/∂z_i,      z ~ N(z₀, 1)

(`etid.estimators.maximum_likelihood.given_driver` says why). A load is identified jointly with z.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from etid.signals.transfer import AnyArray, as_complex, combined, reciprocal


class Tolerances(NamedTuple):
    """Errors of the instrument with a tolerance, as functions of z.

    Attributes:
        faults: Gain, crosstalk and capacitance at z = 0.
        faults_by_z: Their derivatives.
        bend: ∂²W by a capacitance across the only known resistor; None if it is not needed.
        bending: This capacitance at z = 0 [its standard deviation].
        bending_by_z: Its derivatives.
    """

    faults: Float[AnyArray, "3"]
    faults_by_z: Float[AnyArray, "z 3"]
    bend: Complex[AnyArray, " bin"] | None
    bending: Float[AnyArray, ""]
    bending_by_z: Float[AnyArray, " z"]


class Errors(NamedTuple):
    """What errors of the instrument do, stated or not; they are those of `results.instrument`.

    Attributes:
        at: The errors at z = 0 [their standard deviations].
        by_z: Their derivatives; 0 for an error that nobody stated.
        unstated: Changes of z₀ by each error that nobody stated, of the size in `BUDGETED`; 0 for
            the others.
        direct: Sizes of gain, crosstalk and capacitance that nobody stated; 0 for the others.
        drift: Changes of z₀ by a drift of each parameter of Z_th that nobody stated, and by one
            standard deviation of a drift with a tolerance.
        stated: The tolerance of each error of `BUDGETED`; 0 without one.
    """

    at: Float[AnyArray, " error"]
    by_z: Float[AnyArray, "z error"]
    unstated: Float[AnyArray, "z error"]
    direct: Float[AnyArray, "3"]
    drift: Float[AnyArray, "z parameter"]
    stated: Float[AnyArray, " budgeted"]


class Source(NamedTuple):
    """The distribution of Z_th at the harmonics of a load.

    Attributes:
        frequency: The harmonics [Hz]. Those of a load may differ by a small common factor.
        loaded: Z_th + R [Ω] at W₀; None if the input is a measured current.
        w_slope: ∂W₀/∂ log f.
        by_z: ∂W/∂z.
        resistance: R [Ω], the mean of the known resistors.
        mean: z₀.
        cov: Covariance of z, from the noise in the residuals of the calibrations.
        delay_width: Prior standard deviation of the trigger delay of a load [samples].
        tolerances: Errors of the instrument that have tolerances; None without any.
        errors: What errors of the instrument do; None behind a measured current.
        decays: What a voltage of each of its states looks like, per unit of it; None if no record
            needs them.
        beyond: The same at the nodes of a hold (`etid.signals.hold`); None if no record needs
            them.
    """

    frequency: Float[AnyArray, " bin"]
    loaded: Complex[AnyArray, " bin"] | None
    w_slope: Complex[AnyArray, " bin"]
    by_z: Complex[AnyArray, "z bin"]
    resistance: Float[AnyArray, ""]
    mean: Float[AnyArray, " z"]
    cov: Float[AnyArray, "z z"]
    delay_width: Float[AnyArray, ""]
    tolerances: Tolerances | None = None
    errors: Errors | None = None
    decays: Complex[AnyArray, "decay bin"] | None = None
    beyond: "Source | None" = None

    def at(self, index: np.ndarray) -> "Source":
        """The same at some of the harmonics."""
        of = self.tolerances
        if of is not None and of.bend is not None:
            of = of._replace(bend=of.bend[index])
        return self._replace(
            frequency=self.frequency[index],
            loaded=None if self.loaded is None else self.loaded[index],
            w_slope=self.w_slope[index],
            by_z=self.by_z[:, index],
            tolerances=of,
            decays=None if self.decays is None else self.decays[:, index],
        )

    def w(
        self, z: Float[AnyArray, "*row z"], off: Float[AnyArray, "... 1"]
    ) -> Complex[AnyArray, "*row bin"]:
        """W − W₀, at frequencies whose logarithms are larger by `off`."""
        w = combined(z, self.by_z) + as_complex(off) * self.w_slope
        of = self.tolerances
        if of is None or of.bend is None:
            return w
        return w + as_complex(0.5 * self._bending(z) ** 2) * of.bend

    def w_by_z(self, z: Float[AnyArray, "*row z"]) -> Complex[AnyArray, "*row_or_not z bin"]:
        """∂W/∂z."""
        of = self.tolerances
        if of is None or of.bend is None:
            return self.by_z
        along = self._bending(z)[..., None] * of.bending_by_z[:, None]
        return self.by_z + as_complex(along) * of.bend

    def _bending(self, z: Float[AnyArray, "*row z"]) -> AnyArray:
        of = self.tolerances
        assert of is not None
        return (of.bending + z @ of.bending_by_z)[..., None]

    def z_loaded(self, w: Complex[AnyArray, "*row bin"]) -> Complex[AnyArray, "*row bin"]:
        """Z_th + R [Ω] at W₀ + w."""
        assert self.loaded is not None
        # (2, 2) Padé approximant of the exponential: error w⁵/720, a tenth of the time.
        square, half = 1 + w * w * (1 / 12), w * 0.5
        return self.loaded * (square + half) * reciprocal(square - half)
