"""The profile of one element: the smallest F at each of its values, over all other parameters.

F is that of `etid.identify.posterior`. Its deviance is drawn over the stretched element, as the
draws are there. Bounds are walls: no element leaves them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import FIXED, require_element
from etid.estimators.lanes import Harmonics
from etid.estimators.maximum_likelihood.load import Load
from etid.identify.posterior import Known, Minimum, cost, given
from etid.numpy_tier.tiers import program
from etid.precision import in_float64
from etid.recordings.recording import Recording
from etid.results.driver import Driver
from etid.results.fit import Fit
from etid.results.posterior import Profile
from etid.solvers.levenberg_marquardt import LevenbergMarquardt, NormalEquations


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
        """Distances outside, in thousandths of a standard error."""
        own = q[: self.low.size]
        outside = jnp.maximum(self.low - own, 0.0) + jnp.maximum(own - self.high, 0.0)
        return 1e3 * outside / self.error


def _least(
    terms: Load, walls: _Walls, start: Float[Array, " q"], free: Float[Array, "q free"]
) -> Float[Array, " q"]:
    """The minimum of F among `start` + `free` @ r, inside the walls."""

    def residual(r: Float[Array, " free"], _) -> Float[Array, " term"]:
        q = start + free @ r
        return jnp.concatenate([terms(q), walls(q)])

    def equations(_, r: Float[Array, " free"], __) -> NormalEquations:
        value, jacobian = residual(r, None), jax.jacfwd(residual)(r, None)
        return NormalEquations.of(value, jacobian.T)

    solver = LevenbergMarquardt(rtol=1e-6, ftol=1e-8, equations=equations)
    begin = jnp.zeros(free.shape[1])
    found = optx.least_squares(residual, solver, begin, max_steps=200, throw=False)
    return start + free @ found.value


@program
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
    least = Minimum.of(lane, known, circuit)
    size, count = least.q.size, stretched.size
    errors = jnp.sqrt(jnp.diagonal(least.cov))[:count]
    names, limits = circuit.names(), np.tile([-np.inf, np.inf], (count, 1))
    for name, low, high in known.bounds:
        limits[names.index(name)] = np.log(low) if low > 0 else -np.inf, np.log(high)
    own = least.q[:count]
    low, high = ((jnp.asarray(end) - own) / stretched for end in limits.T)  # from the minimum
    walls = _Walls(own + low * errors, own + high * errors, errors)
    middle = jnp.clip(0.0, low[number], high[number])
    ends = jnp.clip(middle + np.array([-3.5, 3.5]), low[number], high[number])  # [standard errors]
    steps = jnp.linspace(ends[0], ends[1], 29)
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


@in_float64
def profile(fit: Fit, recording: Recording | None, driver: Driver | None, name: str) -> Profile:
    """`Fit.profile`."""
    names = fit.circuit.names()
    require_element(name, fit.circuit)
    lane, known, cov = given(fit, recording, driver)
    number = names.index(name)
    if known.elements is not None and known.elements.width[number] <= FIXED:
        raise ValueError(f"{name} is fixed, so it has no profile; take another element")
    wanted = jax.device_put((np.asarray(number), np.sqrt(np.diagonal(cov))))
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
