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
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.element_prior import Known, require_element
from etid.likelihood.linear import diagonal, inverse
from etid.precision import array_function, namespace
from etid.results.fit import Limited
from etid.signals.transfer import AnyArray

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

    values: Float[AnyArray, "*row element"]
    cov: Float[AnyArray, "*row element element"]
    shared_cov: Float[AnyArray, "*row element element"]
    outside: Float[AnyArray, "*row element"]
    deviance: Float[AnyArray, "*row"]
    contradicted: Bool[AnyArray, "*row"]


@array_function
def within(
    circuit: AbstractCircuit,
    values: Float[AnyArray, "*row element"],
    cov: Float[AnyArray, "*row element element"],
    shared_cov: Float[AnyArray, "*row element element"],
    bounds: Limits,
) -> Within:
    """The elements of free fits inside their bounds.

    If the bounds move an element so far that it would be negative, or if there is no covariance,
    all numbers are NaN.

    Args:
        circuit: Structure of the circuit.
        values: Elements of the free fits [SI].
        cov: Their covariance.
        shared_cov: The part of it that comes from the driver.
        bounds: The bounds.
    """
    xp = namespace(values, cov)
    rows = np.array([circuit.names().index(name) for name, *_ in bounds])
    lower, upper = (np.array([one[end] for one in bounds]) for end in (1, 2))
    scale, size, every = xp.sqrt(diagonal(cov)), rows.size, np.eye(values.shape[-1])
    # In standard errors, from the free estimate.
    low, high = ((end - values[..., rows]) / scale[..., rows] for end in (lower, upper))
    outer = scale[..., :, None] * scale[..., None, :]
    whole = cov / outer
    some = whole[..., rows]
    both = some[..., rows, :]

    def posterior(precision: AnyArray, shift: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """u, where the mean is C_B u; the gain C_B (1 + T C_BB)⁻¹; and the covariance of B."""
        inner = np.eye(size) + precision[..., :, None] * both
        gain = xp.linalg.solve(inner.swapaxes(-1, -2), some.swapaxes(-1, -2)).swapaxes(-1, -2)
        moved = gain[..., rows, :] @ (precision[..., :, None] * both)
        return xp.linalg.solve(inner, shift[..., None])[..., 0], gain, both - moved

    def sweep(sites: tuple[AnyArray, AnyArray]) -> tuple[AnyArray, AnyArray]:
        for i in range(size):
            precision, shift = sites
            u, _, spread = posterior(precision, shift)
            own, mean = spread[..., i, i], (both[..., i, :] * u).sum(-1)
            cavity = 1 / (1 / own - precision[..., i])
            centre = cavity * (mean / own - shift[..., i])
            inside, variance = truncated(centre, xp.sqrt(cavity), low[..., i], high[..., i])
            found = 1 / variance - 1 / cavity, inside / variance - centre / cavity
            sites = _replaced(precision, i, found[0]), _replaced(shift, i, found[1])
        return sites

    sites = xp.zeros_like(low), xp.zeros_like(low)
    precision, shift = _times(1 if size == 1 else SWEEPS, sweep, sites)
    u, gain, _ = posterior(precision, shift)
    found = values + scale * (some @ u[..., None])[..., 0]
    step = every - (gain * precision[..., None, :]) @ every[rows]
    sound = xp.isfinite(found).all(-1) & (found > 0).all(-1)

    def scaled(matrix: AnyArray) -> AnyArray:
        return xp.where(sound[..., None, None], matrix * outer, np.nan)

    limit = scipy.special.chdtri(size, scipy.special.chdtrc(1, CONTRADICTED))
    nearest = _nearest(both, low, high)
    outside = -xp.clip(xp.zeros_like(low), low, high) @ every[rows]
    moved = (u * (both @ u[..., None])[..., 0]).sum(-1)
    return Within(
        values=xp.where(sound[..., None], found, np.nan),
        cov=scaled(step @ whole),
        shared_cov=scaled(step @ (shared_cov / outer) @ step.swapaxes(-1, -2)),
        outside=outside,
        deviance=nearest,
        contradicted=xp.where(sound, moved, nearest) > limit,
    )


def _nearest(
    cov: Float[AnyArray, "*row bound bound"],
    low: Float[AnyArray, "*row bound"],
    high: Float[AnyArray, "*row bound"],
) -> Float[AnyArray, "*row"]:
    """Squared distance [standard errors] from 0 to the nearest point between the bounds.

    Each element in turn moves to its best place; the others follow by their correlations.
    """
    xp, precision = namespace(cov), inverse(cov)

    def sweep(x: AnyArray) -> AnyArray:
        for i in range(low.shape[-1]):
            pull = (precision[..., i, :] * x).sum(-1) / precision[..., i, i]
            x = _replaced(x, i, xp.clip(x[..., i] - pull, low[..., i], high[..., i]))
        return x

    x = _times(SWEEPS, sweep, xp.clip(xp.zeros_like(low), low, high))
    return (x * (precision @ x[..., None])[..., 0]).sum(-1)


def _times(count: int, step: Callable[[Any], Any], state: Any) -> Any:
    """A step, again and again: a loop of Python for NumPy, one of JAX for JAX."""
    if namespace(*jax.tree.leaves(state)) is np:
        for _ in range(count):
            state = step(state)
        return state
    return jax.lax.fori_loop(0, count, lambda _, state: step(state), state)


def _replaced(of: AnyArray, place: int, by: AnyArray) -> AnyArray:
    """An array with another value at one place of its last axis."""
    return namespace(of).where(np.arange(of.shape[-1]) == place, by[..., None], of)


def truncated(
    mean: Float[AnyArray, "*row"],
    deviation: Float[AnyArray, "*row"],
    low: Float[AnyArray, "*row"],
    high: Float[AnyArray, "*row"],
) -> tuple[Float[AnyArray, "*row"], Float[AnyArray, "*row"]]:
    """Mean and variance of a normal distribution between two bounds.

    By quadrature around the most probable value: the closed form loses all digits far from the
    mean, and between bounds that are close to each other.
    """
    xp = namespace(mean, deviation, low, high)
    a, b = (low - mean) / deviation, (high - mean) / deviation
    mode = xp.clip(xp.zeros_like(a), a, b)
    reach = TAIL / (xp.sqrt(mode**2 + TAIL) + xp.abs(mode))
    left, right = -xp.minimum(mode - a, reach), xp.minimum(b - mode, reach)
    t = ((left + right) / 2)[..., None] + ((right - left) / 2)[..., None] * NODES
    weight = WEIGHTS * xp.exp(-(t**2) / 2 - mode[..., None] * t)
    weight = weight / weight.sum(-1, keepdims=True)
    centre = (weight * t).sum(-1)
    spread = (weight * (t - centre[..., None]) ** 2).sum(-1)
    return mean + deviation * (mode + centre), deviation**2 * spread


def of_circuit(bounds: Limits, circuit: AbstractCircuit) -> Limits:
    """The bounds of those elements that a circuit has."""
    return tuple(one for one in bounds if one[0] in circuit.names())


def limited(
    circuit: AbstractCircuit, bounds: Limits, outside: Float[AnyArray, " element"] | None = None
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
