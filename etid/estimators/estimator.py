"""Base class of the estimators; the fields of an estimator are its options.

An estimator states what it needs from a recording and from a driver. It fits both, and it describes
itself for a paper. Your own estimator is a subclass; `etid.estimators.registry.register` adds it.
"""

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit, SkinRC
from etid.estimators import judgement
from etid.estimators.lanes import AbstractLane, stacked
from etid.likelihood.noise import MISFIT_CHI2, MISFIT_RRSE
from etid.recordings.preflight import Inspected
from etid.results.driver import ContinuousDriver, Driver
from etid.results.feed import AbstractFeed, MeasuredCurrent
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.signals.transfer import AnyArray

CHECKED = (
    "the records passed the checks for flat, clipped, missing and misplaced samples",
    "the iteration converged",
    "all elements are positive",
    f"the residual does not exceed the noise (χ² per degree of freedom of at most "
    f"{MISFIT_CHI2:g}, or an unexplained part of at most "
    f"{100 * MISFIT_RRSE:g} % of the signal)",
)
DETERMINED = "the trigger delay is at most one sample, every relative standard error below 1"
NEAR_MINIMUM = (
    f"the estimate is within {math.sqrt(judgement.BIASED):g} standard errors of the minimum of its "
    "own model"
)
NOISE = (
    "The noise of samples was taken for white, with the variance that each record shows between "
    "1/128 and 1/8 of the sample rate."
)
NOISE_BY_FREQUENCY = (
    "The variance of the noise at each harmonic was measured in each record: in the bins of the "
    "Fourier transform between the harmonics, where repeated pulses leave nothing (Pintelon and "
    "Schoukens, 2012, ch. 2), or in the quiet part of a single period. A record that is never "
    "quiet was taken to have white noise if its periods end between samples."
)
BY_RESIDUALS = (
    "were made with the variance that the residuals have around each harmonic where that exceeds "
    "the noise (White, 1980)"
)
_Kind = TypeVar("_Kind", bound=Driver)
HARMONICS = (
    "At the harmonics of the pulse rate, in the periodic steady state and in continuous time, "
)


def serving(driver: AbstractFeed, kind: type[_Kind], method: str) -> _Kind:
    """The driver, with the type that `method` needs.

    Raises:
        ValueError: The driver has another type and lacks what the method needs.
    """
    if isinstance(driver, kind):
        return driver
    if not isinstance(driver, Driver):
        raise ValueError(
            f"method {method!r} identifies loads of an identified driver only, not from a measured "
            "current; use the method maximum_likelihood or output_error"
        )
    if not isinstance(driver, ContinuousDriver):
        raise ValueError(
            f"this driver was identified by {driver.method}, which gives no continuous source "
            f"impedance; identify it with the method {method}"
        )
    raise ValueError(
        f"this driver was identified by {driver.method}, which keeps no harmonics of its "
        "calibrations; identify it with the method maximum_likelihood"
    )


@dataclasses.dataclass(frozen=True)
class Description:
    """Text about an estimator for the methods section of a paper.

    Attributes:
        words: Name of the estimator in a sentence.
        text: Sentences that state what was estimated, and how.
        behind: Further sentences about loads behind a driver, not those from a measured current.
        conditions: Conditions that a successful fit meets.
        behind_conditions: Further conditions that a successful fit behind a driver meets.
        of_driver: Further conditions that an identified driver meets.
        errors: How the standard errors were computed, as the end of a sentence; empty without
            standard errors.
        inexact: Sentences on circuits that leave more than noise, and what is accepted of them;
            empty if nothing is.
        refined: Whether Levenberg-Marquardt found the minima from several starts.
        noise: Sentence that states how the noise of the records was estimated.
        cited: Keys of the references in these texts.
    """

    words: str
    text: str
    behind: str = ""
    conditions: tuple[str, ...] = CHECKED
    behind_conditions: tuple[str, ...] = ()
    of_driver: tuple[str, ...] = ()
    errors: str = ""
    inexact: str = ""
    refined: bool = False
    noise: str = NOISE
    cited: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class AbstractEstimator(abc.ABC):
    """An estimator of drivers and loads. Its fields are its options.

    Two instances are equal if their fields are equal. Equal instances share a compiled function.

    Attributes:
        name: Name of the estimator with its default options.
        lane: The data of a recording that are fitted: samples, or harmonics. Harmonics need whole
            periods.
        driver: The type of driver that the estimator needs. A discrete driver must have the sample
            rate of the recording.
        current: Whether the estimator identifies loads from a measured current, without a driver.
        any_circuit: Whether the estimator identifies circuits other than `SkinRC`.
        chooses: Whether its fits have a `support`, by which circuits can be compared.
    """

    name: ClassVar[str]
    lane: ClassVar[type[AbstractLane]]
    driver: ClassVar[type[Driver]]
    current: ClassVar[bool] = False
    any_circuit: ClassVar[bool] = True
    chooses: ClassVar[bool] = False

    def lane_of(self, seen: Inspected) -> type[AbstractLane]:
        """The data of a recording that has passed the preflight checks."""
        del seen
        return self.lane

    def lane_of_periods(self, periods: int) -> type[AbstractLane]:
        """The data of bare arrays with so many whole periods."""
        del periods
        return self.lane

    @abc.abstractmethod
    def fit_driver(
        self,
        records: Any,
        r_load: Float[AnyArray, " record"],
        order: int,
        instrument: Instrument | None,
    ) -> Driver:
        """Identify a driver.

        Args:
            records: Calibrations, stacked along a leading axis: their `Harmonics` if the lanes of
                this estimator are `periodic`, else their `Measurement`.
            r_load: Resistor of each calibration [Ω].
            order: Number of poles of Z_th.
            instrument: Tolerances of the instrument, for the fits of loads; None if it has none.
        """

    @abc.abstractmethod
    def fit_load(self, lane: Any, driver: Any, known: Any, circuit: AbstractCircuit) -> Fit:
        """Identify a load. JAX can transform the function.

        Args:
            lane: Data of one recording.
            driver: Driver of the recording.
            known: The value that `known` returned for this driver.
            circuit: Structure of the load and its typical values.
        """

    def fit_rows(
        self, lanes: Sequence[AbstractLane], driver: Any, known: Any, circuit: AbstractCircuit
    ) -> list[Fit]:
        """Identify the loads of several recordings.

        Args:
            lanes: Data of the recordings.
            driver: Their driver.
            known: The value that `known` returned for this driver.
            circuit: Structure of the loads and its typical values.

        Returns:
            The fits, stacked in parts.
        """
        of = driver, known, circuit
        return [stacked(jax.device_get([self.fit_load(lane, *of) for lane in lanes]))]

    @abc.abstractmethod
    def describe(self) -> Description:
        """The text for a methods section, including the options."""

    def known(
        self, driver: Any, frequency: Float[Array | np.ndarray, " harmonic"], shared: bool
    ) -> Any:
        """Data that all loads of a driver with the same harmonics share; computed once.

        Args:
            driver: The driver.
            frequency: Harmonics of the loads [Hz].
            shared: Whether the unloaded record of a load may be that of a calibration.
        """
        del driver, frequency, shared

    def check_circuit(self, circuit: AbstractCircuit) -> None:
        """Raise ValueError unless this estimator can identify the circuit."""
        if not self.any_circuit and not isinstance(circuit, SkinRC):
            raise ValueError(
                f"method {str(self)!r} identifies SkinRC only, not {type(circuit).__name__}; "
                "use the method maximum_likelihood"
            )

    def check_driver(self, driver: AbstractFeed, sample_rate: float) -> None:
        """Raise ValueError unless this estimator can use the driver for a recording.

        Args:
            driver: The driver, or the measured current.
            sample_rate: Sampling rate of the recording [Hz].
        """
        if self.current and isinstance(driver, MeasuredCurrent):
            return
        found = serving(driver, self.driver, str(self))
        discrete = not issubclass(self.driver, ContinuousDriver)
        if discrete and not np.isclose(float(found.sample_rate), sample_rate):
            raise ValueError(
                f"{self} needs recording and calibration at the same sample rate; the recording "
                f"has {sample_rate:g} Hz and the driver {float(found.sample_rate):g} Hz; "
                "use the method maximum_likelihood"
            )

    def __str__(self) -> str:
        """The name, with the options that differ from the defaults. `registry.named` reads it."""
        changed = [
            f"{option.name}={getattr(self, option.name)!r}"
            for option in dataclasses.fields(self)
            if getattr(self, option.name) != option.default
        ]
        return f"{self.name}({', '.join(changed)})" if changed else self.name
