"""Importance sampling of a density that is known up to a factor, in several rounds.

The draws come from Student's t. Each draw is weighted by the density over that of its proposal.
Where the density lies in a curved valley, a few draws have all the weight. Further rounds therefore
draw from the mean and the covariance of the weighted draws (population Monte Carlo; Cappé, Guillin,
Marin and Robert 2004). If few draws are effective, their weights are flattened for this: all get a
power below 1.
"""

from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Float

FREEDOM = 30.0  # of Student's t: 16 unknowns; with 8 half of the draws are lost, with ∞ the tails
ROUNDS = 6  # of draws, at most
ENOUGH = 0.3  # effective part of the draws that ends the rounds
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
    """Draws and their weights, of the round with most effective draws.

    Args:
        costs: F = −log p of each draw, but for a constant.
        mean: Mean of the first proposal, such as the minimum of F.
        cov: Its covariance, such as the inverse of the curvature of F there.
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
        if np.linalg.matrix_rank(cov) < mean.size:  # of fewer draws than parameters
            break
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
