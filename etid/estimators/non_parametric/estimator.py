"""Maximum likelihood with the Z_th that the calibrations show at each harmonic."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import (
    BY_RESIDUALS,
    CHECKED,
    DETERMINED,
    HARMONICS,
    AbstractEstimator,
    Description,
    serving,
)
from etid.estimators.judgement import SUCCESSFUL, judged, unless
from etid.estimators.lanes import Harmonics
from etid.estimators.non_parametric.fit import fit_circuit
from etid.estimators.refined_driver import from_harmonics
from etid.estimators.score_tests.other_circuit import NO_OTHER_CIRCUIT, NO_OTHER_GAIN
from etid.estimators.score_tests.unloaded import UnloadedShape, shape_of
from etid.estimators.starts import harmonic_starts
from etid.results.driver import Driver, HarmonicDriver
from etid.results.feed import AbstractFeed
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS

SAME_PULSE_RATE = 1e-3  # relative difference of pulse rates that is allowed, as Z_th is smooth
# [standard errors] Largest bias that is corrected. The remaining bias is below half of one.
CORRECTED = 2.0


@dataclasses.dataclass(frozen=True)
class NonParametric(AbstractEstimator):
    """Maximum likelihood without a model of Z_th; calibrations need the same pulse rate."""

    name = "non_parametric"
    lane = Harmonics
    driver = HarmonicDriver

    def check_driver(self, driver: AbstractFeed, sample_rate: float, pulse_rate: float) -> None:
        """Raise ValueError unless a driver knows Z_th at the harmonics of the recording."""
        super().check_driver(driver, sample_rate, pulse_rate)
        frequency = np.asarray(serving(driver, HarmonicDriver, str(self)).spectra.frequency)
        known = float(frequency[0, 0])
        if not np.isclose(pulse_rate, known, rtol=SAME_PULSE_RATE):
            raise ValueError(
                f"{self} knows Z_th at harmonics of {known:.6g} Hz only, but the recording has "
                f"{pulse_rate:.6g} Hz; use method='maximum_likelihood'"
            )

    def fit_driver(
        self,
        records: Harmonics,
        r_load: Float[Array, " record"],
        order: int,
        instrument: Instrument | None,
    ) -> Driver:
        """Identify a driver by maximum likelihood, which keeps its harmonics."""
        return from_harmonics(records, r_load, order, "maximum_likelihood", instrument)

    def known(
        self, driver: Driver, frequency: Float[Array, " harmonic"], shared: bool
    ) -> UnloadedShape | None:
        """The unloaded voltage of the calibrations, if it can be compared."""
        del shared
        return shape_of(driver, frequency)

    def fit_load(
        self,
        lane: Harmonics,
        driver: HarmonicDriver,
        known: UnloadedShape | None,
        circuit: AbstractCircuit,
    ) -> Fit:
        """Refine from the best of several starts."""
        spectrum, rate = lane.spectrum, jnp.asarray(lane.sample_rate)
        starts = harmonic_starts(spectrum, rate, driver.response(spectrum.frequency), circuit)
        estimate, bias, other = fit_circuit(circuit, driver, spectrum, rate, starts)
        # It needs only the harmonics of the driver, so the driver's verdict does not matter.
        fit = judged(estimate, circuit, SUCCESSFUL, str(self))
        if known is not None:
            fit = unless(fit, known.differs(spectrum), RESULTS.inconsistent)
        far = jnp.any(jnp.abs(bias) > CORRECTED * jnp.sqrt(jnp.diagonal(estimate.cov)))
        fit = unless(fit, other.seen() | other.has_other_gain(), RESULTS.misfit)
        return unless(fit, far, RESULTS.biased)

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="non-parametric maximum likelihood",
            text=HARMONICS + "the load was estimated by maximum likelihood with Z_th as the "
            "calibrations show it at each harmonic, without a model of it, noise on all records "
            "being accounted for (Pintelon and Schoukens, 2012, ch. 9 and 10). Trigger delays were "
            "estimated with the load.",
            conditions=(*CHECKED, DETERMINED, NO_OTHER_CIRCUIT, NO_OTHER_GAIN),
            errors=BY_RESIDUALS,
            refined=True,
            cited=("pintelon2012", "optimistix2024", "white1980"),
        )
