"""How far the trigger delays of a study scatter, so that fits need not leave them open.

A record that is fitted alone must leave its delay open: a delay that is too small to be seen still
shifts the elements. Many records together show their scatter. Their true delays are taken as draws
from N(0, w²), and the estimates t̂ have the covariance V of their fit. Then

    S(w) = t̂ᵀ (V + w² I)⁻¹ t̂

is χ² with one degree of freedom for each record. The upper limit of w is where S(w) is as small as
by chance in one of 10 000 studies. As the width of the prior of every delay it keeps the intervals
honest, however far the true delays scatter. A few delays may be alike by chance: where the limit is
too small, the elements are several standard errors off.
"""

import math

import numpy as np
import scipy
from jaxtyping import Float


def upper_limit(
    delays: Float[np.ndarray, " load"],
    own_variance: Float[np.ndarray, " load"],
    slope: Float[np.ndarray, "load common"],
    cov: Float[np.ndarray, "common common"],
    largest: float,
) -> float:
    """Upper limit of the standard deviation of the true delays; `largest` if there is none below.

    Args:
        delays: Estimated delays, in any unit.
        own_variance: Their variances at given common parameters.
        slope: Their derivatives with respect to the common parameters.
        cov: Covariance of the common parameters.
        largest: Largest limit.
    """
    values, vectors = np.linalg.eigh(cov)
    shared = slope @ vectors * np.sqrt(np.maximum(values, 0.0))
    least = scipy.special.chdtri(delays.size, 1 - 1e-4)

    def explained(width: float) -> bool:
        """Whether S(width) is as small as it is by chance; V is diagonal and of low rank."""
        weight = 1 / (own_variance + width**2)
        inner = np.eye(shared.shape[1]) + shared.T @ (weight[:, None] * shared)
        of_shared = shared.T @ (weight * delays)
        squares = weight @ delays**2 - of_shared @ np.linalg.solve(inner, of_shared)
        return bool(squares <= least)

    low, high = 1e-6 * largest, largest
    if not explained(high):
        return largest
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if explained(middle) else (middle, high)
    return high
