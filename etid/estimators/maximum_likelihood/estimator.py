"""Maximum likelihood on the harmonics; each load is fitted jointly with its driver."""

import dataclasses
from collections.abc import Sequence

from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.circuits.directions import DIRECTIONS
from etid.estimators.element_limits import Limits, stated_limits
from etid.estimators.element_prior import ElementPrior, Known, stated
from etid.estimators.estimator import (
    BY_RESIDUALS,
    CHECKED,
    DETERMINED,
    HARMONICS,
    NOISE_BY_FREQUENCY,
    AbstractEstimator,
    Description,
    serving,
)
from etid.estimators.judgement import STRAINED
from etid.estimators.lanes import AbstractLane, Bins, Harmonics, HarmonicsWithCurrent, Held
from etid.estimators.maximum_likelihood import given_driver
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.rows import fit_lane, fit_rows
from etid.estimators.maximum_likelihood.verdict import ACCEPT
from etid.estimators.refined_driver import from_harmonics
from etid.likelihood.of_calibrations import MISSING_POLE
from etid.printing import per_cent
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.signals.transfer import AnyArray

NO_OTHER_CIRCUIT = (
    "score tests find no relaxation of the load that is spread over time constants (at most "
    f"{DIRECTIONS['spread'].limit:.2g} standard deviations) and no further relaxation (at most "
    f"{DIRECTIONS['relaxation'].limit:.2g})"
)
NO_OTHER_GAIN = (
    "a score test finds no difference between the gains of the two records (at most "
    f"{DIRECTIONS['gain'].limit:.2g} standard deviations)"
)
NO_FALL = (
    "a score test finds no resistance of the load that falls with its current (at most "
    f"{DIRECTIONS['falling'].limit:.2g} standard deviations)"
)

CITED = "kennedy2001", "patterson1971"  # in the text about circuits that are not exact


def what_is_accepted(accepted: str) -> str:
    """Sentences about circuits that leave more than noise, of which so much is accepted."""
    return (
        "A circuit whose smooth residual noise does not explain got an unknown relative error δ of "
        "its gain, a Gaussian process in ln f (Kennedy and O'Hagan, 2001): its size, its length "
        "and its growth with frequency were weighed by their restricted likelihood (Patterson and "
        "Thompson, 1971), and δ is in estimates, standard errors and tests. Such a fit counts as "
        "approximate, and was used like a successful one, if no test explains what it leaves "
        f"beyond the noise, and this is at most {accepted}."
    )


def description(
    words: str, estimated: str, unknowns: str, tests: tuple[str, ...], of_load: str = ""
) -> Description:
    """Text about fits by maximum likelihood, alone or jointly.

    Args:
        words: Name of the estimator in a sentence.
        estimated: What was estimated, as the start of the sentence about the residual.
        unknowns: Sentences about the unknowns of fits behind a driver.
        tests: Score tests that a successful fit has passed.
        of_load: Sentences about the unknowns of all fits.
    """
    # In a fit from a measured current the elements take up any gain.
    of_gain = tuple(one for one in tests if one == NO_OTHER_GAIN)
    return Description(
        words=words,
        text=f"{HARMONICS}{estimated} maximum likelihood with noise on both records (Pintelon and "
        "Schoukens, 2012, ch. 9): the residual Y - G exp(-jωτ) X of each loaded record Y and its "
        f"unloaded record X is weighted by its variance, var Y + |G|² var X. {of_load}",
        behind=unknowns,
        conditions=(*CHECKED, DETERMINED, *(one for one in tests if one not in of_gain)),
        behind_conditions=(
            *of_gain,
            "recording and calibrations agree about Z_th (the calibrations' sum of squares grows "
            f"by at most {STRAINED:g})",
        ),
        of_driver=(
            "it has to be passive",
            "its calibrations must not show one more section of Z_th (score test, χ² of at most "
            f"{MISSING_POLE:g} with two degrees of freedom)",
        ),
        errors=BY_RESIDUALS,
        refined=True,
        noise=NOISE_BY_FREQUENCY,
        cited=("pintelon2012", "optimistix2024", "white1980"),
    )


_BOTH = (
    " The measured current I = X / (Z_L + Z_th), with a delay of its own, was the second equation "
    "for each harmonic; the covariance of both residuals is that of the noise of the three records."
)


@dataclasses.dataclass(frozen=True)
class MaximumLikelihood(AbstractEstimator):
    """Maximum likelihood with noise on both records, for records of any length and start.

    It takes the harmonics of several whole pulse periods, and all bins of any other record, with
    the states at its ends.

    A driver is fitted to the bands of harmonics in which the pulse exceeds its noise
    (`etid.signals.knots.above_noise`), a load to all of them.

    Attributes:
        known_elements: Elements that are known: name, value and standard deviation [SI]; 0 fixes
            one.
        bounds: Bounds of elements: name, lower and upper bound [SI].
        accept: What a circuit may leave beyond the noise, relative to the signal.
        with_current: Whether the measured current is used together with the driver. The default
            method does so for recordings that have both.
    """

    known_elements: Known = ()
    bounds: Limits = ()
    accept: float = ACCEPT
    with_current: bool = False
    name = "maximum_likelihood"
    lane = Harmonics
    driver = HarmonicDriver
    current = True
    chooses = True

    def __post_init__(self) -> None:
        if self.with_current:
            object.__setattr__(self, "lane", HarmonicsWithCurrent)

    def lane_of(self, seen: Inspected) -> type[AbstractLane]:
        """The harmonics of whole periods, or the bins of any other record."""
        if seen.is_held:
            return Held
        return self.lane if seen.is_whole else Bins

    def lane_of_periods(self, periods: int) -> type[AbstractLane]:
        """Harmonics if there are several periods."""
        return self.lane if periods > 1 else Bins

    def fit_driver(
        self,
        records: Harmonics,
        r_load: Float[AnyArray, " record"],
        order: int,
        instrument: Instrument | None,
    ) -> Driver:
        """Identify a driver: Z_th and the trigger delays of its calibrations."""
        return from_harmonics(records, r_load, order, str(self), instrument, self.accept)

    def known(
        self,
        driver: ContinuousDriver | MeasuredCurrent,
        frequency: Float[AnyArray, " harmonic"],
        shared: bool,
    ) -> GivenDriver:
        """The distribution of Z_th at the harmonics, given the calibrations; or the current."""
        if isinstance(driver, MeasuredCurrent):
            return GivenDriver.measured(frequency)
        if isinstance(driver, HarmonicDriver):
            return given_driver.given(driver, frequency, shared)
        return given_driver.by_covariance(driver, frequency)

    def check_driver(self, driver: AbstractFeed, sample_rate: float) -> None:
        """Raise ValueError unless the driver is a measured current, or has a covariance."""
        del sample_rate
        if not isinstance(driver, MeasuredCurrent):
            serving(driver, ContinuousDriver, str(self))

    def fit_load(
        self,
        lane: Harmonics,
        driver: ContinuousDriver | MeasuredCurrent,
        known: GivenDriver,
        circuit: AbstractCircuit,
    ) -> Fit:
        """Refine from the best of several starts, jointly with the uncertain part of the driver.

        JAX can transform it; without JAX it is a fit of one row.
        """
        prior = ElementPrior.of(self.known_elements, circuit)
        of = known, circuit, str(self), prior, self.bounds, self.accept
        return fit_lane(lane, driver, *of)

    def fit_rows(
        self,
        lanes: Sequence[AbstractLane],
        driver: AbstractFeed,
        known: GivenDriver,
        circuit: AbstractCircuit,
    ) -> list[Fit]:
        """Fits of several recordings, stacked in parts."""
        prior = ElementPrior.of(self.known_elements, circuit)
        harmonics = [lane for lane in lanes if isinstance(lane, Harmonics)]
        of = known, circuit, str(self), prior, self.bounds, self.accept
        return fit_rows(harmonics, driver, *of)

    def describe(self) -> Description:
        """The text for a methods section."""
        found = description(
            "maximum likelihood",
            "the load was estimated by",
            "Each load was estimated jointly with Z_th and the trigger delays of the calibrations, "
            f"whose distribution the calibrations give.{_BOTH if self.with_current else ''}",
            (NO_OTHER_CIRCUIT, NO_OTHER_GAIN, NO_FALL),
            "The trigger delay τ of each recording is one more unknown. Records that are not "
            "several whole periods were fitted at all bins of their transforms, with the states at "
            "both ends as further unknowns."
            f"{stated(self.known_elements)}{stated_limits(self.bounds)}",
        )
        told = what_is_accepted(f"{per_cent(self.accept)} of the signal")
        return dataclasses.replace(found, inexact=told, cited=(*found.cited, *CITED))
