"""Output error: all bins of a record, weighted by the noise of its output alone.

The sum of squares over the bins is that of the samples: the difference of V_out and of what the
loaded driver makes of V_th, from a state at the start that is fitted (Ljung, *System
Identification*, 1999). V_th is taken for exact and the noise for white. Its part that comes from
V_th adds to that of V_out as if the gain were the same at all frequencies.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from etid.estimators.element_limits import stated_limits
from etid.estimators.element_prior import stated
from etid.estimators.estimator import (
    BY_RESIDUALS,
    CHECKED,
    DETERMINED,
    NOISE,
    AbstractEstimator,
    Description,
)
from etid.estimators.lanes import Bins
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.precision import namespace
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver
from etid.results.feed import MeasuredCurrent
from etid.signals.noise import Measurement
from etid.signals.transfer import AnyArray, power


class OutputBins(Bins):
    """The bins of a record whose input is taken for exact, and whose noise is white."""

    exact_input = True

    @staticmethod
    def _fields(seen: Inspected) -> tuple[np.ndarray, ...]:
        """The fields of a lane, in their order."""
        of = seen.bins.fields, np.asarray(seen.trusted), seen.aligned[0].size
        return *_weighted(*of), np.asarray(seen.recording.sample_rate)

    @classmethod
    def of_first(cls, seen: Inspected, samples: int) -> "OutputBins":
        """The lane of the first samples of the overlap."""
        of = seen.bins_of_first(samples).fields, np.asarray(seen.trusted), samples
        return cls(*[*_weighted(*of), np.asarray(seen.recording.sample_rate)])

    @classmethod
    def of_samples(cls, m: Measurement, periods: tuple[int, int]) -> "OutputBins":
        """The bins of bare arrays."""
        *fields, rate = jax.tree.leaves(Bins.of_samples(m, periods))
        sigma = namespace(m.v_out).stack([m.sigma_th, m.sigma_out])
        return cls(*[*_weighted(fields, sigma, m.v_out.shape[-1]), rate])


def _weighted(
    fields: Sequence[AnyArray], sigma: Float[AnyArray, "2 *lane"], samples: int
) -> tuple[AnyArray, ...]:
    """The fields of a `Spectrum`, weighted by this noise of a sample of both records."""
    frequency, x, y, variance_x, variance_y, selected = fields
    xp = namespace(x)
    of_x, of_y = (xp.where(selected, power(of), 0.0).sum(-1) for of in (x, y))
    noise = ((sigma[1] ** 2 + of_y / of_x * sigma[0] ** 2) / samples)[..., None]
    return frequency, x, y, variance_x, noise + 0 * variance_y, selected


@dataclasses.dataclass(frozen=True)
class OutputError(MaximumLikelihood):
    """Output error in continuous time, for records of any length.

    Attributes:
        known_elements: As in `MaximumLikelihood`.
        bounds: As in `MaximumLikelihood`.
    """

    with_current: bool = dataclasses.field(default=False, init=False)
    name = "output_error"
    lane = OutputBins

    # The bins of any record, of whole periods or not.
    lane_of = AbstractEstimator.lane_of
    lane_of_periods = AbstractEstimator.lane_of_periods

    def known(
        self,
        driver: ContinuousDriver | MeasuredCurrent,
        frequency: Float[AnyArray, " harmonic"],
        shared: bool,
    ) -> GivenDriver:
        """The distribution of Z_th at the bins. Calibrations tell nothing of an exact V_th."""
        del shared
        return dataclasses.replace(super().known(driver, frequency, False), shape=None)

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="output error",
            text="The load was estimated by output error (Ljung, 1999): the difference of V_out "
            "and of what the model predicts from its input, in continuous time and at all bins of "
            "the record, weighted by white noise of V_out. The states at both ends of the record, "
            "an offset and the trigger delay were estimated with the load."
            f"{stated(self.known_elements)}{stated_limits(self.bounds)}",
            conditions=(*CHECKED, DETERMINED),
            errors=BY_RESIDUALS,
            refined=True,
            noise=NOISE,
            cited=("ljung1999", "optimistix2024", "white1980"),
        )
