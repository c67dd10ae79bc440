"""The distribution of the elements of one fit, and the profile of one element.

Both evaluate the likelihood of `etid.estimators.maximum_likelihood.load` away from its minimum. The
standard errors of a fit are those at the minimum. At low signal-to-noise ratios the likelihood is
skewed, and its intervals are not symmetric.

**Draws.** With the parameters q (logarithms of the elements, trigger delay, and the uncertain
part z of Z_th), F(q) = −log p, and its curvature H at the minimum (Laplace), the draws come from
Student's t with covariance H⁻¹. Each draw is weighted by exp(−F) over its density (importance
sampling). Where the minimum lies in a curved valley, a few draws have all the weight: of 2000 draws
at 20 dB, less than 15 are effective in one fit of 20. Further rounds therefore draw from the mean
and the covariance of the weighted draws (population Monte Carlo; Cappé, Guillin, Marin and Robert
2004). If few draws are effective, their weights are flattened for this: all get a power below 1.

The prior is uniform in the logarithms, times the priors of the fit, and 0 outside its bounds. If a
recording does not exclude that an element is 0, as R_s at 20 dB, the tail of the posterior towards
0 never ends. The draws then cover the surroundings of the fit.

**Curvature.** The unknown true spectrum of V_th is eliminated from F. Below 40 dB F is therefore
too narrow: noise in the unloaded record counts as information (Neyman and Scott 1948). The
covariance of a fit corrects this. The draws of the elements are stretched around the minimum, so
that their curvature there is that covariance (Chandler and Bate 2007; Ribatet, Cooley and Davison
2012). At 20 dB this factor is 1.2 to 1.4, and without it 95 % intervals contain the truth in 85 %.
"""

import dataclasses
from collections.abc import Callable
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Float, Int

from etid.circuits.circuit import AbstractCircuit, Circuit
from etid.estimators.element_limits import Limits, of_circuit
from etid.estimators.element_prior import FIXED, ElementPrior, require_element
from etid.estimators.lanes import Harmonics, HarmonicsWithCurrent
from etid.estimators.maximum_likelihood import with_current
from etid.estimators.maximum_likelihood.estimator import MaximumLikelihood
from etid.estimators.maximum_likelihood.given_driver import AbstractGiven, GivenDriver
from etid.estimators.maximum_likelihood.load import Load
from etid.estimators.maximum_likelihood.load_fit import refined
from etid.estimators.maximum_likelihood.with_current import LoadWithCurrent
from etid.estimators.registry import MAXIMUM_LIKELIHOOD, named
from etid.identify.arguments import fed, require
from etid.identify.compiled import stored_jit
from etid.identify.one import is_shared, known_of, skin
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver
from etid.results.fits import Fit
from etid.results.posterior import Posterior, Profile, effective
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse

FREEDOM = 30.0  # of Student's t: 16 unknowns; with 8 half of the draws are lost, with ∞ the tails
WIDE = 3.5  # [standard errors] range of a profile to each side
POINTS = 29  # of a profile
STEEP = 1e3  # standard deviations of a residual one standard error outside a bound
MAX_STEPS = 200
AT_ONCE = 16  # draws in one vectorised evaluation
ROUNDS = 6  # of draws, at most
ENOUGH = 0.3  # effective part of the draws that ends the rounds
SEVERAL = 10.0  # effective draws for each parameter, from which a covariance is estimated


class Known(eqx.Module):
    """What is known besides the recording.

    Attributes:
        driver: Distribution of Z_th, or the measured current.
        elements: Prior of the elements; None without one.
        bounds: Bounds of elements.
    """

    driver: AbstractGiven
    elements: ElementPrior | None
    bounds: Limits = eqx.field(static=True, default=())


class _Minimum(eqx.Module):
    """The likelihood of a recording, and its minimum.

    Attributes:
        terms: Residuals; half of the sum of their squares is F.
        q: The minimum.
        cov: H⁻¹.
    """

    terms: Load | LoadWithCurrent
    q: Float[Array, " q"]
    cov: Float[Array, "q q"]

    @classmethod
    def of(cls, lane: Harmonics, known: Known, circuit: AbstractCircuit) -> "_Minimum":
        terms = terms_of(lane, known, circuit)
        alone = isinstance(terms, Load)
        delays = jnp.zeros(1 if alone else 2)
        start = jnp.concatenate([circuit.log_values(), delays, known.driver.mean])
        q = (refined(terms, start) if alone else with_current.refined(terms, start)).value
        return cls(terms, q, inverse(jax.hessian(lambda q: cost(terms, q))(q)))


def terms_of(lane: Harmonics, known: Known, circuit: AbstractCircuit) -> Load | LoadWithCurrent:
    """The residuals of a recording."""
    rate = jnp.asarray(lane.sample_rate)
    if isinstance(lane, HarmonicsWithCurrent) and isinstance(known.driver, GivenDriver):
        current = jnp.asarray(lane.i), jnp.asarray(lane.variance_i)
        of = lane.spectrum, current, rate, known.elements
        return LoadWithCurrent.behind(known.driver, circuit, *of)
    return Load.behind(known.driver, circuit, lane.spectrum, rate, known.elements)


def cost(terms: Load | LoadWithCurrent, q: Float[Array, " q"]) -> Float[Array, ""]:
    """F(q)."""
    return 0.5 * jnp.sum(terms(q) ** 2)


class _Walls(eqx.Module):
    """Bounds of the logarithms of the elements, as steep residuals outside.

    Attributes:
        low: Lower bounds; −∞ without one.
        high: Upper bounds; ∞ without one.
        error: Standard errors of the elements.
    """

    low: Float[Array, " element"]
    high: Float[Array, " element"]
    error: Float[Array, " element"]

    def __call__(self, q: Float[Array, " q"]) -> Float[Array, " element"]:
        """Distances outside, in a small part of a standard error."""
        own = q[: self.low.size]
        outside = jnp.maximum(self.low - own, 0.0) + jnp.maximum(own - self.high, 0.0)
        return STEEP * outside / self.error


def _least(
    terms: Load | LoadWithCurrent,
    walls: _Walls,
    start: Float[Array, " q"],
    free: Float[Array, "q free"],
) -> Float[Array, " q"]:
    """The minimum of F among `start` + `free` @ r, inside the walls."""

    def residual(r: Float[Array, " free"], _) -> Float[Array, " term"]:
        q = start + free @ r
        return jnp.concatenate([terms(q), walls(q)])

    def equations(_, r: Float[Array, " free"], __) -> NormalEquations:
        value, jacobian = residual(r, None), jax.jacfwd(residual)(r, None)
        matrix = jacobian.T @ jacobian
        return NormalEquations(0.5 * value @ value, jacobian.T @ value, matrix).finite()

    solver = LevenbergMarquardt(rtol=1e-6, ftol=1e-8, equations=equations)
    found = optx.least_squares(
        residual, solver, jnp.zeros(free.shape[1]), max_steps=MAX_STEPS, throw=False
    )
    return start + free @ found.value


@stored_jit
def minimum(
    lane: Harmonics, known: Known, circuit: AbstractCircuit
) -> tuple[Float[Array, " q"], Float[Array, "q q"]]:
    """The minimum of F, and H⁻¹."""
    least = _Minimum.of(lane, known, circuit)
    return least.q, least.cov


@stored_jit
def _costs(
    lane: Harmonics, known: Known, circuit: AbstractCircuit, q: Float[Array, "draw q"]
) -> Float[Array, " draw"]:
    """F of each draw."""
    terms = terms_of(lane, known, circuit)
    return jax.lax.map(lambda at: cost(terms, at), q, batch_size=AT_ONCE)


def drawn(
    costs: Callable[[np.ndarray], np.ndarray],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    draws: int,
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "draw q"], Float[np.ndarray, " draw"]]:
    """Draws and their weights, of the round with most effective draws.

    Args:
        costs: F of each draw.
        mean: The minimum of F.
        cov: H⁻¹.
        draws: Number of draws in a round.
        random: Source of the draws.
    """
    best = np.zeros((draws, mean.size)), np.full(draws, np.nan)
    most = 0.0
    for _ in range(ROUNDS):
        t = random.normal(size=(draws, mean.size))
        t /= np.sqrt(random.chisquare(FREEDOM, (draws, 1)) / FREEDOM)
        q = mean + t @ np.linalg.cholesky(cov).T
        density = -0.5 * (FREEDOM + mean.size) * np.log1p(np.sum(t**2, axis=1) / FREEDOM)
        log_weight = -costs(q) - density
        log_weight = np.where(np.isfinite(log_weight), log_weight, -np.inf)
        weights = scipy.special.softmax(log_weight)
        found = effective(weights)
        if found > most:
            best, most = (q, weights), found
        if not found < ENOUGH * draws:  # also if no draw has a weight
            break
        flat = _flattened(log_weight, min(SEVERAL * mean.size, ENOUGH * draws))
        mean = flat @ q
        cov = np.cov(q, rowvar=False, aweights=flat)
    return best


def _flattened(log_weight: Float[np.ndarray, " draw"], enough: float) -> Float[np.ndarray, " draw"]:
    """Weights to the largest power up to 1 that leaves `enough` effective draws."""
    low, high = 0.0, 1.0
    if effective(scipy.special.softmax(log_weight)) >= enough:
        return scipy.special.softmax(log_weight)
    for _ in range(20):
        middle = (low + high) / 2
        if effective(scipy.special.softmax(middle * log_weight)) < enough:
            high = middle
        else:
            low = middle
    return scipy.special.softmax(np.where(np.isfinite(log_weight), low * log_weight, -np.inf))


def stretched(
    q: Float[np.ndarray, "draw q"],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    wanted: Float[np.ndarray, "element element"],
) -> Float[np.ndarray, "draw element"]:
    """Logarithms of the elements, stretched around the minimum.

    Args:
        q: Draws.
        mean: The minimum of F.
        cov: H⁻¹.
        wanted: Covariance of the logarithms of the elements, from the fit.
    """
    size = len(wanted)
    return mean[:size] + (q[:, :size] - mean[:size]) @ _stretch(cov, wanted).T


def _stretch(
    cov: Float[np.ndarray, "q q"], wanted: Float[np.ndarray, "element element"]
) -> Float[np.ndarray, "element element"]:
    size = len(wanted)
    return np.linalg.cholesky(wanted) @ np.linalg.inv(np.linalg.cholesky(cov[:size, :size]))


def _inside(
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
        wanted: As in `stretched`.
    """
    size, back = len(wanted), np.linalg.inv(_stretch(cov, wanted))
    slope = cov[:, :size] @ np.linalg.inv(cov[:size, :size])
    moved = back @ (np.asarray(fit.circuit.log_values()) - mean[:size])
    less = cov[:size, :size] - back @ _determined(fit) @ back.T
    return mean + slope @ moved, cov - slope @ less @ slope.T


@stored_jit
def _profile(
    lane: Harmonics,
    known: Known,
    circuit: AbstractCircuit,
    number: Int[Array, ""],
    stretched: Float[Array, " element"],
) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
    """Logarithms of an element, and the deviance there.

    Args:
        lane: Harmonics of the recording.
        known: What is known besides.
        circuit: The fitted circuit.
        number: Number of the element.
        stretched: Standard errors of the logarithms of the elements, from the fit.
    """
    least = _Minimum.of(lane, known, circuit)
    size, count = least.q.size, stretched.size
    errors = jnp.sqrt(jnp.diagonal(least.cov))[:count]
    names, ends = circuit.names(), np.tile([-np.inf, np.inf], (count, 1))
    for name, low, high in known.bounds:
        ends[names.index(name)] = np.log(low) if low > 0 else -np.inf, np.log(high)
    own = least.q[:count]
    low, high = ((jnp.asarray(end) - own) / stretched for end in ends.T)  # from the minimum
    walls = _Walls(own + low * errors, own + high * errors, errors)
    middle = jnp.clip(0.0, low[number], high[number])
    steps = jnp.linspace(
        jnp.maximum(middle - WIDE, low[number]), jnp.minimum(middle + WIDE, high[number]), POINTS
    )
    others = jnp.where(jnp.arange(size - 1) < number, jnp.arange(size - 1), jnp.arange(1, size))
    free = jnp.eye(size)[:, others]
    towards = least.cov[:, number] / errors[number]

    def deviance(step: Float[Array, ""]) -> Float[Array, ""]:
        found = _least(least.terms, walls, least.q + towards * step, free)
        return 2 * cost(least.terms, found)

    best = least.q
    if known.bounds:
        best = _least(least.terms, walls, least.q + towards * middle, jnp.eye(size))
    found = jax.lax.map(deviance, steps)
    return least.q[number] + stretched[number] * steps, found - 2 * cost(least.terms, best)


def posterior(
    fit: Fit[Circuit],
    recording: Recording | None,
    driver: Driver | None,
    *,
    draws: int,
    seed: int,
) -> Posterior[Circuit]:
    """`Fit.posterior`."""
    if draws < 1:
        raise ValueError(f"draws is {draws}; it must be at least 1, as in 1000")
    lane, known, cov = given(fit, recording, driver)
    least, own = map(np.asarray, minimum(lane, known, fit.circuit))
    if not np.isfinite(own).all():
        raise ValueError(f"the recording does not determine all elements of {fit}")

    names = fit.circuit.names()

    def costs(q: Float[np.ndarray, "draw q"]) -> Float[np.ndarray, " draw"]:
        found = np.array(_costs(lane, known, fit.circuit, jnp.asarray(q)))
        elements = np.exp(stretched(q, least, own, cov))
        for name, low, high in known.bounds:
            value = elements[:, names.index(name)]
            found[(value < low) | (value > high)] = np.inf
        return found

    begin = _inside(fit, least, own, cov) if known.bounds else (least, own)
    q, weights = drawn(costs, *begin, draws, np.random.default_rng(seed))
    if not np.isfinite(weights).all():
        raise ValueError(f"the recording does not determine all elements of {fit}")
    found = stretched(q, least, own, cov)
    circuit = type(fit.circuit)(**dict(zip(names, np.exp(found.T), strict=True)))
    return Posterior(fit.circuit, np.asarray(fit.cov), circuit, weights)


def profile(fit: Fit, recording: Recording | None, driver: Driver | None, name: str) -> Profile:
    """`Fit.profile`."""
    names = fit.circuit.names()
    require_element(name, fit.circuit)
    lane, known, cov = given(fit, recording, driver)
    number = names.index(name)
    if known.elements is not None and known.elements.width[number] <= FIXED:
        raise ValueError(f"{name} is fixed, so it has no profile; take another element")
    wanted = jnp.asarray(number), jnp.sqrt(jnp.diagonal(jnp.asarray(cov)))
    logs, deviance = map(np.asarray, _profile(lane, known, fit.circuit, *wanted))
    ends = {one: (low, high) for one, low, high in known.bounds}
    return Profile(
        name=name,
        unit=fit.circuit.units()[name],
        value=float(getattr(fit.circuit, name)),
        stderr=float(getattr(fit.stderr, name)),
        values=np.exp(logs),
        deviance=deviance,
        bounds=ends.get(name, (-np.inf, np.inf)),
    )


def given(
    fit: Fit, recording: Recording | None, driver: Driver | None
) -> tuple[Harmonics, Known, Float[np.ndarray, "element element"]]:
    """The harmonics of a fit, what is known besides, and the covariance of the log elements.

    Raises:
        ValueError: As in `Fit.posterior`.
    """
    require("fit", fit, Fit)
    recording, driver = fit.made_from(recording, driver)
    if recording is None and fit.measured is not None:
        raise ValueError("a fit to a measured impedance has no draws and no profiles")
    if recording is None:
        raise ValueError(
            "this fit does not know its recording and its driver; pass both, as in "
            "fit.posterior(recording, driver)"
        )
    recording, feed = fed(recording, driver)
    if np.ndim(fit.rrse):
        raise ValueError("this is a batch of fits; take one of them, as in fits[0]")
    if fit.method.partition("(")[0] != MAXIMUM_LIKELIHOOD.name:
        raise ValueError(
            f"this fit was made by {fit.method}; identify the recording with "
            f"method={MAXIMUM_LIKELIHOOD.name!r}"
        )
    cov = _determined(fit)
    seen = Inspected(recording)
    estimator = cast(MaximumLikelihood, named(fit.method))
    lane = (HarmonicsWithCurrent if estimator.with_current else Harmonics).of(seen)
    late = lane.late_by(fit.circuit, feed)  # as `etid.identify.one.repeated` does it
    seen.lag += late
    lane = lane.realigned(late)
    if int(fit.remarks) & Remark.mains_hum:
        lane = lane.without_mains() or lane
    known = known_of(lane, feed, is_shared(seen, feed), MAXIMUM_LIKELIHOOD)
    told = estimator.known_elements
    elements = ElementPrior.of(told, fit.circuit) if told else None
    if estimator.bounds:  # the draws begin with those of the same fit without bounds
        unbounded = dataclasses.replace(estimator, bounds=())
        of = jax.device_get(skin(lane, feed, known, fit.circuit, unbounded))
        cov = _determined(of)
    return lane, Known(known, elements, of_circuit(estimator.bounds, fit.circuit)), cov


def _determined(fit: Fit) -> Float[np.ndarray, "element element"]:
    """The covariance of the logarithms of the elements.

    Raises:
        ValueError: The recording does not determine all elements.
    """
    values = np.asarray(fit.circuit.values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    if not (np.isfinite(cov).all() and (np.linalg.eigvalsh(cov) > 0).all()):
        raise ValueError(f"the recording does not determine all elements of {fit}")
    return cov
