"""Steiglitz-McBride in time, as in the paper.

It has no covariance. Its estimate is not at the minimum of its model. If the minimum is far from
the estimate, the verdict is `biased`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import CHECKED, NEAR_MINIMUM, AbstractEstimator, Description
from etid.estimators.judgement import BIASED, MAX_STEPS_REACHED, distance_to_minimum
from etid.estimators.lanes import AlignedSamples, stacked
from etid.estimators.steiglitz_mcbride import iteration
from etid.likelihood.linear import NormalEquations
from etid.likelihood.noise import misses
from etid.precision import array_function, namespace, one_thread, untraced
from etid.results.driver import DiscreteDriver, Driver
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.noise import Measurement
from etid.signals.transfer import AnyArray, Rational

IMPULSE = 512  # length of the impulse response of a discrete model [samples]


@array_function
def _score(
    m: Measurement, z_th: Rational, z_load: Rational, of_load: bool
) -> tuple[Float[AnyArray, ""], Float[AnyArray, ""]]:
    """χ² of a discrete model, and its squared distance to the minimum in standard errors."""
    xp = namespace(m.v_th)
    impulse = xp.asarray(1.0 * (np.arange(IMPULSE) == 0))
    v, slopes = iteration.with_slopes(z_th, z_load, m.v_th, of_load)
    h, by_h = iteration.with_slopes(z_th, z_load, impulse, of_load)
    variance = m.sigma_out**2 + m.sigma_th**2 * (h**2).sum()
    terms = (v - m.v_out) / xp.sqrt(variance)
    growth = m.sigma_th**2 * (by_h @ h) / variance  # half of that of the variance
    rows = slopes / xp.sqrt(variance) - growth[:, None] * terms
    equations = NormalEquations.of(terms, rows)
    return 2 * equations.objective / m.v_th.shape[-1], distance_to_minimum(equations)


@dataclasses.dataclass(frozen=True)
class SteiglitzMcBride(AbstractEstimator):
    """The paper's estimator: Z_th and the skin as discrete filters, by prefiltered least squares.

    Attributes:
        iterations: Number of iterations, at least one; 1 is least squares of the equation error.
    """

    name = "steiglitz_mcbride"
    lane = AlignedSamples
    driver = Driver
    any_circuit = False

    iterations: int = iteration.ITERATIONS

    def __post_init__(self) -> None:
        iteration.check_iterations(self.iterations)

    @one_thread()
    @array_function
    def fit_driver(
        self,
        records: Measurement,
        r_load: Float[AnyArray, " record"],
        order: int,
        instrument: Instrument | None,
    ) -> Driver:
        """The paper's estimate of Z_th (eqs. 4-6)."""
        del instrument
        best = iteration.driver_filter(records.v_th, records.v_out, r_load, order, self.iterations)
        xp, scores = namespace(records.v_th), []
        for number in range(r_load.shape[0]):
            one = jax.tree.map(lambda leaf, number=number: leaf[number], records)
            scores.append(_score(one, best.filter, iteration.resistor(r_load[number]), False))
        chi2, distance = (xp.stack(each).max() for each in zip(*scores, strict=True))
        unstable = ~xp.isfinite(best.rrse) | ~best.stable
        return DiscreteDriver(
            b=best.filter.num,
            a=best.filter.den,
            sample_rate=records.sample_rate[0],
            rrse=best.rrse,
            chi2=xp.where(xp.isfinite(best.rrse), chi2, np.inf),
            result=first_verdict(
                (unstable, RESULTS.unstable),
                ((self.iterations > 1) & ~best.converged, MAX_STEPS_REACHED),
                (misses(chi2, best.rrse), RESULTS.misfit),
                (distance > BIASED, RESULTS.biased),
            ),
            steps=best.iteration,
            method=str(self),
        )

    @one_thread()
    def fit_rows(
        self, lanes: Sequence[Any], driver: Any, known: None, circuit: AbstractCircuit
    ) -> list[Fit]:
        """Fits of several recordings, stacked."""
        of = untraced(driver), known, circuit
        return [stacked([self.fit_load(lane, *of) for lane in lanes])]

    @array_function
    def fit_load(
        self, lane: AlignedSamples, driver: Driver, known: None, circuit: AbstractCircuit
    ) -> Fit:
        """The paper's estimate of SkinRC (eqs. 8-12)."""
        del known, circuit
        m, z_th = lane.measure(), Rational(driver.b, driver.a)
        best, xp = iteration.skin_filter(m.v_th, m.v_out, z_th, self.iterations), namespace(m.v_th)
        circuit = iteration.skin_elements(best.filter, m.sample_rate)
        chi2, distance = _score(m, z_th, best.filter, True)
        values = circuit.values()
        unstable = ~xp.isfinite(best.rrse)
        nothing = xp.full((values.size, values.size), np.nan)
        return Fit(
            circuit=circuit,
            cov=nothing,
            shared_cov=nothing,
            rrse=best.rrse,
            chi2=xp.where(unstable, np.inf, chi2),
            result=first_verdict(
                (unstable, RESULTS.unstable),
                (~(values > 0).all(), RESULTS.nonphysical),
                ((self.iterations > 1) & ~best.converged, MAX_STEPS_REACHED),
                (misses(chi2, best.rrse), RESULTS.misfit),
                (distance > BIASED, RESULTS.biased),
            ),
            steps=best.iteration,
            method=str(self),
        )

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="Steiglitz-McBride",
            text="Z_th and the load were estimated as discrete filters by at most "
            f"{self.iterations} iterations of Steiglitz and McBride (1965). The iterate that "
            "predicts the terminal voltage best was kept. The method accounts neither for trigger "
            "delays nor for the noise that both of its regressors share, and gives no standard "
            "errors.",
            conditions=(*CHECKED, NEAR_MINIMUM),
        )
