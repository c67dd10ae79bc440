"""Elements with bounds: what the likelihood of a fit says of them inside their bounds.

Near its minimum the likelihood of the elements is a normal distribution: the estimate of a free fit
and its covariance. Bounds cut off a part of it. The mean and the covariance of the rest are the
estimate with bounds. They are exact for one bounded element. Several bounded elements take
expectation propagation: each bound is replaced by the normal factor that gives its element the same
mean and variance (Minka 2001, Expectation propagation for approximate Bayesian inference).

A mean never lies on a bound, so it has a standard error, and value ± 1.96 standard errors contain
the truth in 94.2 to 97.3 % wherever it lies, if the bounds are four standard errors apart or more.
The point of the largest likelihood would often lie on a bound, and have no standard error there.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import Known, require_element
from etid.results.fit import Limited

Limits = tuple[tuple[str, float, float], ...]
"""Elements with bounds: name, lower and upper bound [SI]; infinity without an upper bound."""

# Squared distance from the estimate of a free fit to that inside the bounds [standard errors]. An
# element whose true value is its bound exceeds it once in 2000, 3.3 standard errors from the bound.
CONTRADICTED = 12.7
SWEEPS = 20  # of expectation propagation; three are enough for correlations of ±0.9
NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)
TAIL = 80.0  # twice the exponent at which a tail ends


class Within(NamedTuple):
    """Elements inside their bounds.

    Attributes:
        values: Their mean [SI].
        cov: Their covariance.
        shared_cov: The part of it that comes from the driver.
        outside: Distance of the free estimate of each element from its bounds [standard errors];
            negative below the lower one, 0 inside.
        deviance: Increase of −2 log L from the free estimate to the likeliest point inside.
        contradicted: Whether the bounds are no longer credible.
    """

    values: Float[Array, " element"]
    cov: Float[Array, "element element"]
    shared_cov: Float[Array, "element element"]
    outside: Float[Array, " element"]
    deviance: Float[Array, ""]
    contradicted: Bool[Array, ""]


def within(
    circuit: AbstractCircuit,
    cov: Float[Array, "element element"],
    shared_cov: Float[Array, "element element"],
    bounds: Limits,
) -> Within:
    """The elements of a free fit inside their bounds.

    If the bounds move an element so far that it would be negative, or if there is no covariance,
    all numbers are NaN.
    """
    rows = np.array([circuit.names().index(name) for name, *_ in bounds])
    lower = jnp.array([low for _, low, _ in bounds])
    upper = jnp.array([high for *_, high in bounds])
    free, scale = circuit.values(), jnp.sqrt(jnp.diagonal(cov))
    # In standard errors, from the free estimate.
    low, high = (lower - free[rows]) / scale[rows], (upper - free[rows]) / scale[rows]
    whole = cov / jnp.outer(scale, scale)
    some = whole[:, rows]

    def posterior(
        precision: Float[Array, " bound"], shift: Float[Array, " bound"]
    ) -> tuple[Float[Array, " bound"], Float[Array, "element bound"], Float[Array, "bound bound"]]:
        """u, where the mean is C_B u; the gain C_B (1 + T C_BB)⁻¹; and the covariance of B."""
        inner = jnp.eye(rows.size) + precision[:, None] * some[rows]
        gain = jnp.linalg.solve(inner.T, some.T).T
        moved = gain[rows] @ (precision[:, None] * some[rows].T)
        return jnp.linalg.solve(inner, shift), gain, some[rows] - moved

    def one(i: Array, sites: tuple[Array, Array]) -> tuple[Array, Array]:
        precision, shift = sites
        u, _, spread = posterior(precision, shift)
        own, mean = spread[i, i], some[rows][i] @ u
        cavity = 1 / (1 / own - precision[i])
        centre = cavity * (mean / own - shift[i])
        inside, variance = truncated(centre, jnp.sqrt(cavity), low[i], high[i])
        site = 1 / variance - 1 / cavity, inside / variance - centre / cavity
        return precision.at[i].set(site[0]), shift.at[i].set(site[1])

    def sweep(sites: tuple[Array, Array], _) -> tuple[tuple[Array, Array], None]:
        return jax.lax.fori_loop(0, rows.size, one, sites), None

    nothing = jnp.zeros(rows.size), jnp.zeros(rows.size)
    count = 1 if rows.size == 1 else SWEEPS
    (precision, shift), _ = jax.lax.scan(sweep, nothing, length=count)
    u, gain, _ = posterior(precision, shift)
    values = free + scale * (some @ u)
    step = jnp.eye(free.size) - gain @ (precision[:, None] * jnp.eye(free.size)[rows])
    sound = jnp.isfinite(values).all() & (values > 0).all()

    def scaled(matrix: Float[Array, "element element"]) -> Float[Array, "element element"]:
        return jnp.where(sound, matrix * jnp.outer(scale, scale), jnp.nan)

    limit = scipy.special.chdtri(rows.size, scipy.special.chdtrc(1, CONTRADICTED))
    nearest = _nearest(some[rows], low, high)
    return Within(
        values=jnp.where(sound, values, jnp.nan),
        cov=scaled(step @ whole),
        shared_cov=scaled(step @ (shared_cov / jnp.outer(scale, scale)) @ step.T),
        outside=jnp.zeros_like(free).at[rows].set(-jnp.clip(0.0, low, high)),
        deviance=nearest,
        contradicted=jnp.where(sound, u @ some[rows] @ u, nearest) > limit,
    )


def _nearest(
    cov: Float[Array, "bound bound"], low: Float[Array, " bound"], high: Float[Array, " bound"]
) -> Float[Array, ""]:
    """Squared distance [standard errors] from 0 to the nearest point between the bounds.

    Each element in turn moves to its best place; the others follow by their correlations.
    """
    precision = jnp.linalg.inv(cov)

    def move(step: Array, x: Float[Array, " bound"]) -> Float[Array, " bound"]:
        i = step % x.size
        best = x[i] - precision[i] @ x / precision[i, i]
        return x.at[i].set(jnp.clip(best, low[i], high[i]))

    x = jax.lax.fori_loop(0, SWEEPS * low.size, move, jnp.clip(0.0, low, high))
    return x @ precision @ x


def truncated(
    mean: Float[Array, ""],
    deviation: Float[Array, ""],
    low: Float[Array, ""],
    high: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and variance of a normal distribution between two bounds.

    By quadrature around the most probable value: the closed form loses all digits far from the
    mean, and between bounds that are close to each other.
    """
    a, b = (low - mean) / deviation, (high - mean) / deviation
    mode = jnp.clip(0.0, a, b)
    reach = TAIL / (jnp.sqrt(mode**2 + TAIL) + jnp.abs(mode))
    left, right = -jnp.minimum(mode - a, reach), jnp.minimum(b - mode, reach)
    t = (left + right) / 2 + (right - left) / 2 * NODES
    weight = WEIGHTS * jnp.exp(-(t**2) / 2 - mode * t)
    weight = weight / weight.sum()
    centre = weight @ t
    return mean + deviation * (mode + centre), deviation**2 * (weight @ (t - centre) ** 2)


def of_circuit(bounds: Limits, circuit: AbstractCircuit) -> Limits:
    """The bounds of those elements that a circuit has."""
    return tuple(one for one in bounds if one[0] in circuit.names())


def limited(
    circuit: AbstractCircuit, bounds: Limits, outside: Float[Array, " element"] | None = None
) -> Limited | None:
    """The bounds of the elements of a fit; None without bounds.

    `outside` is that of `Within`; None if the recording was not fitted.
    """
    if not bounds:
        return None
    ends = {name: (low, high) for name, low, high in bounds}
    both = np.array([ends.get(name, (0.0, np.inf)) for name in circuit.names()])
    return Limited(both[:, 0], both[:, 1], np.zeros(len(both)) if outside is None else outside)


def checked_limits(bounds: Limits, known: Known, circuits: Sequence[AbstractCircuit]) -> None:
    """Raise ValueError unless these are possible bounds of elements of some of the circuits.

    A choice of circuits compares each one inside its own bounds, so a circuit may lack an element.
    """
    for name, low, high in bounds:
        if not any(name in one.names() for one in circuits):
            require_element(name, circuits[0])
        if any(name == one and not error for one, _, error in known):
            raise ValueError(f"{name} is fixed and has bounds; remove one of them")
        if not 0 <= low < high:
            raise ValueError(
                f"the bounds of {name} are {low:g} and {high:g}; the lower one must not be "
                "negative, and the upper one must be larger"
            )


def stated_limits(bounds: Limits) -> str:
    """A sentence for a methods section; empty without bounds."""
    if not bounds:
        return ""
    each = [
        f"{name} ≥ {low:g}" if high == math.inf else f"{name} from {low:g} to {high:g}"
        for name, low, high in bounds
    ]
    return (
        f" Bounds of elements [SI]: {'; '.join(each)}; the estimates are mean and covariance of "
        "the normal distribution of the elements inside these bounds."
    )
