"""Importance sampling of a density that is known up to a factor, in several rounds.

The draws come from Student's t. Where the density lies in a curved valley, a few draws have all the
weight. Further rounds therefore draw from the mean and the covariance of the weighted draws. If few
draws are effective, their weights are flattened for this: all get a power below 1. In the end each
draw of all rounds is weighted by the density over that of the mixture of all proposals (adaptive
multiple importance sampling; Cornuet, Marin, Mira and Robert 2012). Of one round alone, the draws
of a proposal that is too narrow would look as good as any.
"""

from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Float

from etid.solvers.matrices import is_definite

FREEDOM = 30.0  # of Student's t: 16 unknowns; with 8 half of the draws are lost, with ∞ the tails
ROUNDS = 6  # of draws, at most
ENOUGH = 0.3  # effective draws that end the rounds, in draws of one round
SEVERAL = 10.0  # effective draws for each parameter, from which a covariance is estimated


def effective(weights: Float[np.ndarray, " draw"]) -> float:
    """Number of draws of equal weight that would be as good, 1 / Σ w²."""
    return float(1 / np.sum(weights**2))


def drawn(
    costs: Callable[[np.ndarray], np.ndarray],
    mean: Float[np.ndarray, " q"],
    cov: Float[np.ndarray, "q q"],
    draws: int,
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "draw q"], Float[np.ndarray, " draw"]]:
    """Draws of all rounds, and their weights; those are NaN if no draw has one.

    Args:
        costs: F = −log p of each draw, but for a constant.
        mean: Mean of the first proposal, such as the minimum of F.
        cov: Its covariance, such as the inverse of the curvature of F there.
        draws: Number of draws in a round.
        random: Source of the draws.
    """
    q, cost = np.zeros((0, mean.size)), np.zeros(0)
    proposals: list[tuple[np.ndarray, np.ndarray]] = []
    while True:
        proposals.append((mean, np.linalg.cholesky(cov)))
        fresh = _draws(*proposals[-1], draws, random)
        q, cost = np.concatenate([q, fresh]), np.concatenate([cost, costs(fresh)])
        mixture = scipy.special.logsumexp([_log_density(q, *one) for one in proposals], axis=0)
        log_weight = np.where(np.isfinite(cost), -cost - mixture, -np.inf)
        weights = scipy.special.softmax(log_weight)
        enough = not effective(weights) < ENOUGH * draws  # also if no draw has a weight
        if enough or len(proposals) == ROUNDS:
            return q, weights
        flat = _flattened(log_weight, min(SEVERAL * mean.size, ENOUGH * draws))
        mean = flat @ q
        cov = np.cov(q, rowvar=False, aweights=flat)
        if not is_definite(cov):  # of fewer draws than parameters
            return q, weights


# scipy.stats.multivariate_t takes the covariance of a fixed element, 10⁻¹⁸, for a singular one.
def _draws(
    mean: Float[np.ndarray, " q"],
    root: Float[np.ndarray, "q q"],
    draws: int,
    random: np.random.Generator,
) -> Float[np.ndarray, "draw q"]:
    """Draws from Student's t around a mean, with the Cholesky factor of its covariance."""
    t = random.normal(size=(draws, mean.size))
    return mean + t / np.sqrt(random.chisquare(FREEDOM, (draws, 1)) / FREEDOM) @ root.T


def _log_density(
    q: Float[np.ndarray, "draw q"], mean: Float[np.ndarray, " q"], root: Float[np.ndarray, "q q"]
) -> Float[np.ndarray, " draw"]:
    """Logarithm of its density, but for a constant."""
    t = scipy.linalg.solve_triangular(root, (q - mean).T, lower=True)
    volume = np.log(np.diagonal(root)).sum()
    return -0.5 * (FREEDOM + mean.size) * np.log1p(np.sum(t**2, axis=0) / FREEDOM) - volume


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
