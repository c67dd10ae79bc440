"""Steiglitz-McBride in time, as in the paper, and equation error, its first iteration.

They have no covariance. Their estimates are not at the minimum of their model. If the minimum is
far from the estimate, the verdict is `biased`.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimator import CHECKED, NEAR_MINIMUM, AbstractEstimator, Description
from etid.estimators.judgement import BIASED, MAX_STEPS_REACHED, distance_to_minimum, misses
from etid.estimators.lanes import AlignedSamples
from etid.estimators.steiglitz_mcbride import iteration
from etid.results.driver import DiscreteDriver, Driver
from etid.results.fit import Fit
from etid.results.instrument import Instrument
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.noise import Measurement
from etid.signals.transfer import Rational
from etid.solvers.levenberg_marquardt import normal_equations

IMPULSE = 512  # length of the impulse response of a discrete model [samples]


def _score(
    m: Measurement,
    best: Rational,
    predict: Callable[[Rational, Float[Array, " time"]], Float[Array, " time"]],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² of a discrete model, and its squared distance to the minimum in standard errors."""
    impulse, free = jnp.zeros(IMPULSE).at[0].set(1.0), best.num.size

    def scaled(c: Float[Array, " n"], _) -> Float[Array, " time"]:
        of = Rational(c[:free], jnp.concatenate([jnp.ones(1), c[free:]]))
        s = m.sigma_out**2 + m.sigma_th**2 * jnp.sum(predict(of, impulse) ** 2)
        return (predict(of, m.v_th) - m.v_out) / jnp.sqrt(s)

    equations = normal_equations(scaled, jnp.concatenate([best.num, best.den[1:]]))
    return 2 * equations.objective / m.v_th.size, distance_to_minimum(equations)


@dataclasses.dataclass(frozen=True)
class SteiglitzMcBride(AbstractEstimator):
    """The paper's estimator: Z_th and the skin as discrete filters, by prefiltered least squares.

    Attributes:
        iterations: Number of iterations, at least one.
    """

    name = "steiglitz_mcbride"
    lane = AlignedSamples
    driver = Driver
    any_circuit = False

    iterations: int = iteration.ITERATIONS

    def __post_init__(self) -> None:
        iteration.check_iterations(self.iterations)

    def fit_driver(
        self,
        records: Measurement,
        r_load: Float[Array, " record"],
        order: int,
        instrument: Instrument | None,
    ) -> Driver:
        """The paper's estimate of Z_th (eqs. 4-6)."""
        del instrument
        best = iteration.driver_filter(records.v_th, records.v_out, r_load, order, self.iterations)

        def score(m: Measurement, r: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
            load = Rational(r[None], jnp.ones(1))
            return _score(
                m, best.filter, lambda z_th, v: iteration.terminal_voltage(z_th, load, v)[0]
            )

        chi2, distance = jax.vmap(score)(records, r_load)
        chi2 = chi2.max()
        unstable = ~jnp.isfinite(best.rrse) | ~best.stable
        return DiscreteDriver(
            b=best.filter.num,
            a=best.filter.den,
            sample_rate=records.sample_rate[0],
            rrse=best.rrse,
            chi2=jnp.where(jnp.isfinite(best.rrse), chi2, jnp.inf),
            result=first_verdict(
                (unstable, RESULTS.unstable),
                ((self.iterations > 1) & ~best.converged, MAX_STEPS_REACHED),
                (misses(chi2, best.rrse), RESULTS.misfit),
                (distance.max() > BIASED, RESULTS.biased),
            ),
            steps=best.iteration,
            method=str(self),
        )

    def fit_load(
        self, lane: AlignedSamples, driver: Driver, known: None, circuit: AbstractCircuit
    ) -> Fit:
        """The paper's estimate of SkinRC (eqs. 8-12)."""
        del known, circuit
        m = lane.measure()
        z_th = Rational(driver.b, driver.a)
        best = iteration.skin_filter(m.v_th, m.v_out, z_th, self.iterations)
        circuit = iteration.skin_elements(best.filter, m.sample_rate)
        chi2, distance = _score(
            m, best.filter, lambda load, v: iteration.terminal_voltage(z_th, load, v)[0]
        )
        values = circuit.values()
        unstable = ~jnp.isfinite(best.rrse)
        nothing = jnp.full((values.size, values.size), jnp.nan)
        return Fit(
            circuit=circuit,
            cov=nothing,
            shared_cov=nothing,
            rrse=best.rrse,
            chi2=jnp.where(unstable, jnp.inf, chi2),
            result=first_verdict(
                (unstable, RESULTS.unstable),
                (~jnp.all(values > 0), RESULTS.nonphysical),
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


@dataclasses.dataclass(frozen=True)
class EquationError(SteiglitzMcBride):
    """The first iteration of Steiglitz-McBride: least squares of the equation error."""

    name = "equation_error"

    iterations: int = dataclasses.field(default=1, init=False)

    def describe(self) -> Description:
        """The text for a methods section."""
        return Description(
            words="equation error",
            text="Z_th and the load were estimated as discrete filters by least squares of the "
            "equation error, the first iteration of Steiglitz and McBride (1965). It is biased by "
            "noise and gives no standard errors.",
            conditions=(*CHECKED, NEAR_MINIMUM),
        )
