"""Output error: predicts the loaded voltage in time, for records of any length."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_limits import Limits, stated_limits
from etid.estimators.element_prior import ElementPrior, Known, stated
from etid.estimators.estimator import CHECKED, DETERMINED, AbstractEstimator, Description
from etid.estimators.judgement import MISFIT_CHI2, judged, misses, unless
from etid.estimators.lanes import PaddedSamples
from etid.estimators.output_error import fit, prediction
from etid.estimators.output_error.sample_rate import has_aliases, leaves_out
from etid.estimators.refined_driver import from_samples
from etid.estimators.score_tests import other_on_harmonics
from etid.estimators.starts import circuit_starts, current_starts
from etid.estimators.steiglitz_mcbride import iteration
from etid.estimators.unknowns import LoadUnknowns
from etid.results.driver import ContinuousDriver, Driver, HarmonicDriver
from etid.results.feed import MeasuredCurrent
from etid.results.fit import Fit
from etid.results.verdicts import RESULTS
from etid.signals.noise import Measurement
from etid.signals.transfer import Rational

# Part of the signal that the interpolation may leave unexplained. At 100 kHz and 80 dB it leaves
# 6e-4, and R_s is wrong by ten standard errors. At 200 kHz it leaves 1e-4, less than one.
INTERPOLATED = 3e-4
# Limit of χ² behind a measured current. It was 0.98 ± 0.06 in 320 single pulses. Edges of a current
# that are shorter than a sample shift R_s by six standard errors at 1.3.
EDGES = 1.25


@dataclasses.dataclass(frozen=True)
class OutputError(AbstractEstimator):
    """Output error in continuous time; a record need not hold a whole pulse period.

    Attributes:
        known_elements: Elements that are known: name, value and standard deviation [SI]; 0 fixes
            one.
        bounds: Bounds of elements: name, lower and upper bound [SI].
    """

    known_elements: Known = ()
    bounds: Limits = ()
    name = "output_error"
    lane = PaddedSamples
    driver = ContinuousDriver
    current = True
    chooses = True

    def check_circuit(self, circuit: AbstractCircuit) -> None:
        """Raise ValueError unless the response of the circuit in time is known."""
        if not circuit.impedance().has_response:
            raise ValueError(
                f"method {str(self)!r} needs a ratio of polynomials in s or constant phases, which "
                f"the impedance of {type(circuit).__name__} is not; "
                "use method='maximum_likelihood'"
            )

    def fit_driver(
        self,
        records: Measurement,
        r_load: Float[Array, " record"],
        order: int,
    ) -> Driver:
        """Identify a driver: Z_th in continuous time."""
        return from_samples(records, r_load, order, str(self))

    def fit_load(
        self,
        lane: PaddedSamples,
        driver: ContinuousDriver | MeasuredCurrent,
        known: None,
        circuit: AbstractCircuit,
    ) -> Fit:
        """Refine from the best of several starts."""
        del known
        m, samples = lane.measurement, jnp.asarray(lane.samples)
        if isinstance(driver, MeasuredCurrent):
            m = _at_rest(m, samples)
        starts = circuit.with_log_values(_starts(m, driver, circuit))
        prior = ElementPrior.of(self.known_elements, circuit) if self.known_elements else None
        fitted, estimate, other = fit.fit_circuit(
            prediction.prepare(m, samples=samples), driver, starts, prior
        )
        found = judged(estimate, circuit, driver.result, str(self), self.bounds)
        limit = EDGES if isinstance(driver, MeasuredCurrent) else MISFIT_CHI2
        off = misses(estimate.chi2, estimate.rrse, INTERPOLATED, limit)
        if isinstance(driver, MeasuredCurrent):
            found = unless(found, other & ~has_aliases(m, samples), RESULTS.misfit)
            return unless(found, off | other, RESULTS.biased)
        found = unless(found, off | leaves_out(m, samples), RESULTS.biased)
        if isinstance(driver, HarmonicDriver):
            # The driver of maximum likelihood is more exact than output error. In time, the test
            # would take the error of output error, three standard errors, for a relaxation.
            if lane.harmonics is None:
                return found
            own = LoadUnknowns(estimate.parameters, estimate.delay_samples[0])
            spectrum = lane.harmonics.spectrum
            other = other_on_harmonics.scores(spectrum, own, m.sample_rate, fitted, driver).seen()
        return unless(found, other, RESULTS.misfit)

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="output error",
            text="The load was estimated by output error (Ljung, 1999): the terminal voltage was "
            "predicted in continuous time from the band-limited unloaded record, and its "
            "difference to the loaded record, weighted by the noise of both, was minimised. The "
            "state at the start of the record, an offset and the trigger delay were estimated with "
            f"the load.{stated(self.known_elements)}"
            f"{stated_limits(self.bounds)}",
            conditions=(*CHECKED, DETERMINED),
            errors="were multiplied by the square root of χ² where the residual exceeds the noise",
            refined=True,
            cited=("ljung1999", "optimistix2024"),
        )


def _at_rest(m: Measurement, samples: Int[Array, ""]) -> Measurement:
    """A recording without the constant current and voltage between its pulses.

    State and offset of the fit stand for both. A start would have to know them: with a holding
    current of a third of the pulse, no start found the elements of a model cell.
    """

    def centred(record: Float[Array, " time"]) -> Float[Array, " time"]:
        inside = jnp.arange(record.size) < samples
        level = jnp.nanmedian(jnp.where(inside, record, jnp.nan))
        return jnp.where(inside, record - level, 0.0)

    return dataclasses.replace(m, v_th=centred(m.v_th), v_out=centred(m.v_out))


def _starts(
    m: Measurement, driver: ContinuousDriver | MeasuredCurrent, circuit: AbstractCircuit
) -> Float[Array, "start element"]:
    """Starts of the elements' logarithms."""
    if isinstance(driver, MeasuredCurrent):
        size = m.v_th.shape[0]
        frequency = jnp.fft.rfftfreq(size)[1:] * m.sample_rate
        x, y = jnp.fft.rfft(m.v_th)[1:], jnp.fft.rfft(m.v_out)[1:]
        of_x, of_y = (jnp.full(frequency.shape, size * of**2) for of in (m.sigma_th, m.sigma_out))
        return current_starts(frequency, (x, y), (of_x, of_y), circuit)
    discrete = iteration.skin_filter(m.v_th, m.v_out, Rational(driver.b, driver.a)).filter
    simpler = iteration.skin_elements(discrete, m.sample_rate)
    return circuit_starts(circuit, simpler)
