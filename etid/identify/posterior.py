"""The distribution of the elements of one fit, and the profile of one element.

Both evaluate the likelihood of `etid.estimators.maximum_likelihood.load` away from its minimum. The
standard errors of a fit are those at the minimum. At low signal-to-noise ratios the likelihood is
skewed, and its intervals are not symmetric.

**Draws.** With the parameters q (logarithms of the elements, trigger delay, and the uncertain
part z of Z_th), F(q) = −log p, and its curvature H at the minimum (Laplace), the draws come from
Student's t with covariance H⁻¹. Each draw is weighted by exp(−F) over its density (importance
sampling).

**Curvature.** The unknown true spectrum of V_th is eliminated from F. Below 40 dB F is therefore
too narrow: noise in the unloaded record counts as information (Neyman and Scott 1948). The
covariance of a fit corrects this. The draws of the elements are stretched around the minimum, so
that their curvature there is that covariance (Chandler and Bate 2007; Ribatet, Cooley and Davison
2012). At 20 dB this factor is 1.2 to 1.4, and without it 95 % intervals contain the truth in 85 %.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.load import Load, refined
from etid.estimators.registry import MAXIMUM_LIKELIHOOD
from etid.identify.arguments import require
from etid.identify.compiled import stored_jit
from etid.identify.one import is_shared, known_of
from etid.recordings.preflight import Inspected
from etid.recordings.recording import Recording
from etid.recordings.remarks import Remark
from etid.results.driver import Driver
from etid.results.fits import Fit
from etid.results.posterior import Posterior, Profile
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations
from etid.solvers.matrices import inverse

FREEDOM = 30.0  # of Student's t: 16 unknowns; with 8 half of the draws are lost, with ∞ the tails
WIDE = 3.5  # [standard errors] range of a profile to each side
POINTS = 29  # of a profile
MAX_STEPS = 200
AT_ONCE = 16  # draws in one vectorised evaluation

_Circuit = TypeVar("_Circuit", bound=AbstractCircuit)


class _Minimum(eqx.Module):
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
    def of(cls, lane: Harmonics, known: GivenDriver, circuit: AbstractCircuit) -> "_Minimum":
        terms = Load.behind(known, circuit, lane.spectrum, jnp.asarray(lane.sample_rate))
        start = jnp.concatenate([circuit.log_values(), jnp.zeros(1), known.mean])
        q = refined(terms, start).value
        return cls(terms, q, inverse(jax.hessian(lambda q: _cost(terms, q))(q)))


def _cost(terms: Load, q: Float[Array, " q"]) -> Float[Array, ""]:
    return 0.5 * jnp.sum(terms(q) ** 2)


def _least(
    terms: Load, start: Float[Array, " q"], free: Float[Array, "q free"]
) -> Float[Array, " q"]:
    """The minimum of F among `start` + `free` @ r."""

    def residual(r: Float[Array, " free"], _) -> Float[Array, " term"]:
        return terms(start + free @ r)

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
def _draws(
    lane: Harmonics,
    known: GivenDriver,
    circuit: AbstractCircuit,
    cov: Float[Array, "element element"],
    normal: Float[Array, "draw q"],
    square: Float[Array, " draw"],
) -> tuple[Float[Array, "draw element"], Float[Array, " draw"]]:
    """Logarithms of the elements, and their weights."""
    least = _Minimum.of(lane, known, circuit)
    t = normal / jnp.sqrt(square)[:, None]
    q = least.q[None] + t @ jnp.linalg.cholesky(least.cov).T
    worse = jax.lax.map(lambda at: _cost(least.terms, at), q, batch_size=AT_ONCE)
    density = -0.5 * (FREEDOM + least.q.size) * jnp.log1p(jnp.sum(t**2, axis=1) / FREEDOM)
    log_weight = _cost(least.terms, least.q) - worse - density
    log_weight = jnp.where(jnp.isfinite(log_weight), log_weight, -jnp.inf)
    size = cov.shape[0]
    own = jnp.linalg.cholesky(least.cov[:size, :size])
    stretch = jnp.linalg.cholesky(cov) @ jnp.linalg.inv(own)
    centre = least.q[None, :size]
    elements = centre + (q[:, :size] - centre) @ stretch.T
    return elements, jax.nn.softmax(log_weight)


@stored_jit
def _profile(
    lane: Harmonics,
    known: GivenDriver,
    circuit: AbstractCircuit,
    number: Int[Array, ""],
    stretched: Float[Array, ""],
    steps: Float[Array, " point"],
) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
    """Logarithms of an element, and the deviance there.

    Args:
        lane: Harmonics of the recording.
        known: Its driver.
        circuit: The fitted circuit.
        number: Number of the element.
        stretched: Standard error of the logarithm of the element, from the fit.
        steps: Distances from the minimum [standard errors].
    """
    least = _Minimum.of(lane, known, circuit)
    size = least.q.size
    others = jnp.where(jnp.arange(size - 1) < number, jnp.arange(size - 1), jnp.arange(1, size))
    free = jnp.eye(size)[:, others]
    error = jnp.sqrt(least.cov[number, number])

    def deviance(step: Float[Array, ""]) -> Float[Array, ""]:
        start = least.q + least.cov[:, number] / error * step
        return 2 * _cost(least.terms, _least(least.terms, start, free))

    found = jax.lax.map(deviance, steps)
    return least.q[number] + stretched * steps, found - 2 * _cost(least.terms, least.q)


def posterior(
    fit: Fit[_Circuit], recording: Recording, driver: Driver, *, draws: int = 1000, seed: int = 0
) -> Posterior[_Circuit]:
    """The distribution of the elements, by importance sampling around the fit.

    The prior is uniform in the logarithms of the elements. The trigger delay and the uncertain part
    of Z_th are drawn too.

    Args:
        fit: A fit by maximum likelihood.
        recording: Its recording.
        driver: Its driver.
        draws: Number of draws. 1000 take a tenth of a second; `effective` says what they are worth.
        seed: Seed of the draws.

    Returns:
        Weighted draws, with intervals.

    Raises:
        ValueError: The fit is a batch, or comes from another method, or its data do not determine
            all elements.
    """
    if draws < 1:
        raise ValueError(f"draws is {draws}; it must be at least 1, as in 1000")
    lane, known, cov = _given(fit, recording, driver)
    random = np.random.default_rng(seed)
    size = len(fit.circuit.names()) + 1 + known.mean.size
    normal = random.normal(size=(draws, size))
    square = random.chisquare(FREEDOM, draws) / FREEDOM
    drawn = map(jnp.asarray, (cov, normal, square))
    found, weights = map(np.asarray, _draws(lane, known, fit.circuit, *drawn))
    if not (np.isfinite(found).all() and np.isfinite(weights).all()):
        raise ValueError(f"the recording does not determine all elements of {fit}")
    names = fit.circuit.names()
    circuit = type(fit.circuit)(**dict(zip(names, np.exp(found.T), strict=True)))
    return Posterior(fit, circuit, weights)


def profile(fit: Fit, recording: Recording, driver: Driver, name: str) -> Profile:
    """The deviance as a function of one element; all other parameters are fitted again.

    Args:
        fit: A fit by maximum likelihood.
        recording: Its recording.
        driver: Its driver.
        name: The element, as in `"c_p"`.

    Returns:
        The profile, with an interval.

    Raises:
        ValueError: The circuit has no such element, or as in `posterior`.
    """
    names = fit.circuit.names()
    if name not in names:
        raise ValueError(
            f"{type(fit.circuit).__name__} has no element {name!r}; it has {', '.join(names)}"
        )
    lane, known, cov = _given(fit, recording, driver)
    number, steps = names.index(name), np.linspace(-WIDE, WIDE, POINTS)
    error = np.sqrt(cov[number, number])
    wanted = map(jnp.asarray, (number, error, steps))
    logs, deviance = map(np.asarray, _profile(lane, known, fit.circuit, *wanted))
    value = float(getattr(fit.circuit, name))
    return Profile(
        name=name,
        unit=fit.circuit.units()[name],
        value=value,
        stderr=value * float(error),
        values=np.exp(logs),
        deviance=deviance,
    )


def _given(
    fit: Fit, recording: Recording, driver: Driver
) -> tuple[Harmonics, GivenDriver, Float[np.ndarray, "element element"]]:
    """The harmonics of a fit, its driver, and the covariance of the logarithms of its elements.

    Raises:
        ValueError: As in `posterior`.
    """
    require("fit", fit, Fit)
    require("recording", recording, Recording)
    require("driver", driver, Driver)
    if np.ndim(fit.rrse):
        raise ValueError("this is a batch of fits; take one of them, as in fits[0]")
    if fit.method != MAXIMUM_LIKELIHOOD.name:
        raise ValueError(
            f"this fit was made by {fit.method}; identify the recording with "
            f"method={MAXIMUM_LIKELIHOOD.name!r}"
        )
    values = np.asarray(fit.circuit.values())
    cov = np.asarray(fit.cov) / np.outer(values, values)
    if not (np.isfinite(cov).all() and (np.linalg.eigvalsh(cov) > 0).all()):
        raise ValueError(f"the recording does not determine all elements of {fit}")
    seen = Inspected(recording)
    lane = Harmonics.of(seen)
    late = lane.late_by(fit.circuit, driver)  # as `etid.identify.one.repeated` does it
    seen.lag += late
    lane = lane.realigned(late)
    if int(fit.remarks) & Remark.mains_hum:
        lane = lane.without_mains() or lane
    known = known_of(lane, driver, is_shared(seen, driver), MAXIMUM_LIKELIHOOD)
    return lane, known, cov
