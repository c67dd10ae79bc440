"""The distribution of the elements of one fit.

It evaluates the likelihood of `etid.estimators.maximum_likelihood.load` away from its minimum. The
standard errors of a fit are those at the minimum. At low signal-to-noise ratios the likelihood is
skewed, and its intervals are not symmetric.

**Draws.** The parameters q are the logarithms of the elements, the trigger delay, and the uncertain
part z of Z_th. F(q) = −log p has the curvature H at its minimum. At 20 dB a record of damp skin
determines R_s + R_p to 0.5 %, and R_s to 30 %: in the logarithms this is a curved valley. The draws
are therefore of the impedances, R and 1/C, in which it is nearly straight. The first ones have the
covariance H⁻¹ there (Laplace; `etid.solvers.importance_sampling`).

The prior is uniform in these impedances above 0, and in the logarithms of elements that are none,
times the priors of the fit; it is 0 outside their bounds.

**Curvature.** The unknown true spectrum of V_th is eliminated from F. Below 40 dB F is therefore
too narrow: noise in the unloaded record counts as information (Neyman and Scott 1948). The
covariance of a fit corrects this. The draws of the elements are stretched around the minimum, so
that their curvature there is that covariance (Chandler and Bate 2007; Ribatet, Cooley and Davison
2012). At 20 dB this factor is 1.2 to 1.4, and without it 95 % intervals contain the truth in 85 %.
"""

import dataclasses
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit, Circuit
from etid.estimators.element_limits import Limits, of_circuit
from etid.estimators.element_prior import ElementPrior
from etid.estimators.lanes import Harmonics, HarmonicsWithCurrent, taken
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.profile import Records
from etid.estimators.maximum_likelihood.search import minimum as least
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named
from etid.identify.arguments import fed, require
from etid.identify.fitting import fits_of, is_shared, known_of
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver, HarmonicDriver
from etid.results.fit import Fit
from etid.results.instrument import BUDGETED, Budget, Effects
from etid.results.posterior import Posterior
from etid.solvers.importance_sampling import drawn
from etid.solvers.matrices import inverse, is_definite


class Known(eqx.Module):
    """What is known besides the recording.

    Attributes:
        driver: Distribution of Z_th, or the measured current.
        elements: Prior of the elements; None without one.
        bounds: Bounds of elements.
    """

    driver: GivenDriver
    elements: ElementPrior | None
    bounds: Limits = eqx.field(static=True, default=())

    def allows(self, circuits: AbstractCircuit) -> Bool[np.ndarray, " draw"]:
        """Whether the elements of each circuit are finite and inside their bounds."""
        of = {name: np.asarray(getattr(circuits, name)) for name in circuits.names()}
        inside = [(of[name] >= low) & (of[name] <= high) for name, low, high in self.bounds]
        return np.all([*map(np.isfinite, of.values()), *inside], axis=0)


class Minimum(eqx.Module):
    """The likelihood of a recording, and its minimum.

    Attributes:
        terms: Residuals; half of the sum of their squares is F.
        q: The minimum.
        cov: H⁻¹.
    """

    terms: Load
    q: Float[Array, " q"]
    cov: Float[Array, "q q"]

    @classmethod
    def of(cls, lane: Harmonics, known: Known, circuit: AbstractCircuit) -> "Minimum":
        """The minimum near a fitted circuit."""
        terms = terms_of(lane, known, circuit)
        delays = jnp.zeros(terms.gains.outputs)
        start = jnp.concatenate([circuit.log_values(), delays, known.driver.mean])
        q, _ = least(terms, start)
        return cls(terms, q, inverse(jax.hessian(lambda q: cost(terms, q))(q)))


def terms_of(lane: Harmonics, known: Known, circuit: AbstractCircuit) -> Load:
    """The residuals of a recording."""
    rate, records = jnp.asarray(lane.sample_rate), Records.of(lane.spectrum)
    if isinstance(lane, HarmonicsWithCurrent) and not known.driver.by_current:
        records = Records.of(lane.spectrum, (jnp.asarray(lane.i), jnp.asarray(lane.variance_i)))
    return Load.behind(known.driver, circuit, records, rate, known.elements)


def cost(terms: Load, q: Float[Array, " q"]) -> Float[Array, ""]:
    """F(q)."""
    return 0.5 * jnp.sum(terms(q) ** 2)


@program
def minimum(
    lane: Harmonics, known: Known, circuit: AbstractCircuit
) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """The minimum of F, and H⁻¹."""
    least = Minimum.of(lane, known, circuit)
    return least.q, least.cov


@program
def _costs(
    lane: Harmonics, known: Known, circuit: AbstractCircuit, q: Float[Array, "draw q"]
) -> Float[Array, " draw"]:
    """F of each draw."""
    terms = terms_of(lane, known, circuit)
    return jax.lax.map(lambda at: cost(terms, at), q, batch_size=16)


class Impedances(NamedTuple):
    """Impedances of the elements in place of their logarithms; other parameters are as in q.

    Attributes:
        least: The minimum of F, at which each impedance is 1.
        powers: To which each impedance is proportional, such as −1 for a capacitance; 0 for
            parameters that are none.
    """

    least: Float[np.ndarray, " q"]
    powers: Float[np.ndarray, " q"]

    @classmethod
    def of_circuit(cls, circuit: AbstractCircuit, least: Float[np.ndarray, " q"]) -> "Impedances":
        """Those of the elements of a circuit, at the minimum of F."""
        powers = np.asarray(_powers(circuit))
        return cls(least, np.pad(powers, (0, least.size - powers.size)))

    def of(self, q: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
        """The impedances."""
        return np.where(self.powers != 0, np.exp(self.powers * (q - self.least)), q)

    def logs(self, x: Float[np.ndarray, "draw part"]) -> Float[np.ndarray, "draw part"]:
        """The parameters q, or those of them that come first; NaN for an impedance below 0."""
        powers, least = (of[: x.shape[1]] for of in (self.powers, self.least))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(powers != 0, least + np.log(x) / powers, x)

    def moments(
        self, mean: Float[np.ndarray, " q"], cov: Float[np.ndarray, "part part"]
    ) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "part part"]]:
        """The impedances at a mean of q, and the covariance of the first ones, to first order."""
        x = self.of(mean)
        slopes = np.where(self.powers != 0, self.powers * x, 1.0)[: len(cov)]
        return x, cov * np.outer(slopes, slopes)


@program
def _powers(circuit: AbstractCircuit) -> Float[Array, " element"]:
    return jnp.asarray(circuit.scaling()[0])


def stretched(
    x: Float[np.ndarray, "draw q"],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> Float[np.ndarray, "draw element"]:
    """Draws of the elements, stretched around the minimum.

    Args:
        x: Draws of all parameters.
        mean: The minimum of F.
        cov: H⁻¹.
        wanted: Covariance of the elements, from the fit.
    """
    size = len(wanted)
    return mean[:size] + (x[:, :size] - mean[:size]) @ _stretch(cov, wanted).T


def _stretch(
    cov: Float[np.ndarray, "q q"], wanted: Float[np.ndarray, "element element"]
) -> Float[np.ndarray, "element element"]:
    size = len(wanted)
    return np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(cov[:size, :size]))


def inside(
    fit: Fit,
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q q"]]:
    """Mean and covariance of all parameters, if the elements have those of a fit with bounds.

    Args:
        fit: The fit with bounds.
        mean: The minimum of F, without bounds.
        cov: H⁻¹.
        wanted: Covariance of the logarithms of the elements, from the fit.
    """
    size, back = len(wanted), np.linalg.inv(_stretch(cov, wanted))
    slope = cov[:, :size] @ np.linalg.inv(cov[:size, :size])
    moved = back @ (np.asarray(fit.circuit.log_values()) - mean[:size])
    less = cov[:size, :size] - back @ _determined(fit) @ back.T
    return mean + slope @ moved, cov - slope @ less @ slope.T


@in_float64
def posterior(
    fit: Fit[Circuit], recording: Recording | None, driver: Driver | None, *, draws: int, seed: int
) -> Posterior[Circuit]:
    """`Fit.posterior`."""
    if draws < 1:
        raise ValueError(f"draws is {draws}; it must be at least 1, as in 1000")
    lane, known, cov = given(fit, recording, driver)
    least, own = map(np.asarray, minimum(lane, known, fit.circuit))
    if not np.isfinite(own).all():
        raise _undetermined(fit)
    impedances = Impedances.of_circuit(fit.circuit, least)
    at_least, (_, wanted) = impedances.moments(least, own), impedances.moments(least, cov)

    def elements(x: Float[np.ndarray, "draw q"]) -> Circuit:
        logs = impedances.logs(stretched(x, *at_least, wanted))
        return fit.circuit.with_values(np.exp(logs))

    def costs(x: Float[np.ndarray, "draw q"]) -> Float[np.ndarray, " draw"]:
        q = impedances.logs(x)
        possible = np.isfinite(q).all(axis=1) & known.allows(elements(x))
        q[~possible] = least
        found = np.asarray(_costs(lane, known, fit.circuit, jax.device_put(q)))
        return np.where(possible, found, np.inf)

    begin = impedances.moments(*inside(fit, least, own, cov)) if known.bounds else at_least
    x, weights = drawn(costs, *begin, draws, np.random.default_rng(seed))
    if not np.isfinite(weights).all():
        raise _undetermined(fit)
    possible = weights > 0
    found = elements(x[possible])
    return Posterior(fit.circuit, np.asarray(fit.cov), found, weights[possible])


def given(
    fit: Fit, recording: Recording | None, driver: Driver | None
) -> tuple[Harmonics, Known, Float[np.ndarray, "element element"]]:
    """The harmonics of a fit, what is known besides, and the covariance of the log elements.

    Raises:
        ValueError: As in `Fit.posterior`.
    """
    require("fit", fit, Fit)
    recording, driver = fit.source_or_own(recording, driver)
    if recording is None and fit.measured is not None:
        raise ValueError("a fit to a measured impedance has no draws and no profiles")
    if recording is None:
        raise ValueError(
            "this fit does not know its recording and its driver; pass both, as in "
            "fit.posterior(recording, driver)"
        )
    recording, feed = fed(recording, driver)
    fit.refuse_batch()
    if fit.method.partition("(")[0] != MAXIMUM_LIKELIHOOD.name:
        raise ValueError(
            f"this fit was made by {fit.method}; identify the recording with "
            f"the method {MAXIMUM_LIKELIHOOD.name}"
        )
    cov = _determined(fit)
    seen = Inspected(recording)
    estimator = cast(MaximumLikelihood, named(fit.method))
    lane = (HarmonicsWithCurrent if estimator.with_current else Harmonics).of(seen)
    late = lane.late_by(fit.circuit, feed)  # as `etid.identify.fitting.refitted` does it
    seen.realign(*late)
    lane = lane.realigned(late)
    if int(fit.remarks) & Remark.mains_hum:
        lane = lane.without_mains() or lane
    known = jax.device_put(known_of(lane, feed, is_shared(seen, feed), MAXIMUM_LIKELIHOOD))
    elements = ElementPrior.of(estimator.known_elements, fit.circuit)
    if estimator.bounds:  # the draws begin with those of the same fit without bounds
        unbounded = dataclasses.replace(estimator, bounds=())
        of = fits_of([lane], feed, known, fit.circuit, unbounded)
        cov = _determined(taken(of, 0))
    return lane, Known(known, elements, of_circuit(estimator.bounds, fit.circuit)), cov


def _determined(fit: Fit) -> Float[np.ndarray, "element element"]:
    """The covariance of the logarithms of the elements.

    Raises:
        ValueError: The recording does not determine all elements.
    """
    values = np.asarray(fit.circuit.values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    if not is_definite(cov):
        raise _undetermined(fit)
    return cov


def _undetermined(fit: Fit) -> ValueError:
    return ValueError(f"the recording does not determine all elements of {fit}")


@in_float64
def budget(fit: Fit, recording: Recording | None, driver: Driver | None) -> Budget:
    """`Fit.budget`."""
    effects = fit.by_tolerance
    if effects is None or not np.isfinite(effects.moved).any():
        effects = _effects(fit, *fit.source_or_own(recording, driver))
    stated = dict(zip(BUDGETED, np.asarray(effects.stated).tolist(), strict=True))
    moved = zip(BUDGETED, np.asarray(effects.moved), strict=True)
    of = {name: part for name, part in moved if np.isfinite(part).all()}
    values = np.asarray(fit.circuit.values())
    cov, shared = (np.diagonal(np.asarray(of)) / values**2 for of in (fit.cov, fit.shared_cov))
    instrument = {name: part for name, part in of.items() if stated[name]}
    rest = shared - sum(part**2 for part in instrument.values())
    return Budget(
        names=fit.circuit.names(),
        parts={
            "recording": np.sqrt(cov - shared),
            "driver": np.sqrt(np.maximum(rest, 0.0)),
            **instrument,
        },
        tolerances=stated,
        unstated=effects.unstated,
    )


def _effects(fit: Fit, recording: Recording | None, driver: Driver | None) -> Effects:
    """The effects of errors of the instrument on a fit of a file, from its recording."""
    if fit.method == "joint":
        raise ValueError(
            "this joint fit has no budget: pass instrument=etid.Instrument() to identify_jointly, "
            "with the tolerances that you know; files of fits keep none"
        )
    if not isinstance(driver, HarmonicDriver):
        raise ValueError(
            "a budget needs the driver of the fit, with the harmonics of its calibrations; "
            "identify it by maximum likelihood, and pass it as in fit.budget(recording, driver)"
        )
    lane, known, _ = given(fit, recording, driver)
    estimator = named(fit.method)
    found = taken(fits_of([lane], driver, known.driver, fit.circuit, estimator), 0)
    assert found.by_tolerance is not None
    return found.by_tolerance
