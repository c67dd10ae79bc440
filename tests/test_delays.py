"""How far the trigger delays of a study scatter: an upper limit that holds as often as it says."""

import numpy as np
import pytest

from etid.selection.delays import CHANCE, upper_limit

LARGEST = 0.5
STUDIES = 200
# Four standard deviations of a binomial count.
TOLERANCE = 4 * np.sqrt(CHANCE * (1 - CHANCE) / STUDIES)


@pytest.fixture(scope="module")
def errors():
    """Errors of 20 delays: own ones of 2 to 9 ns at 5 µs a sample, and shared ones."""
    rng = np.random.default_rng(1)
    own = np.tile([0.4e-3, 1.8e-3], 10) ** 2
    slope = rng.standard_normal((20, 3))
    root = 1e-3 * rng.standard_normal((3, 3))
    return own, slope, root @ root.T


def drawn(errors, scatter, seed):
    """Estimates of delays that scatter."""
    rng = np.random.default_rng(seed)
    own, slope, cov = errors
    common = rng.multivariate_normal(np.zeros(3), cov)
    delays = scatter * rng.standard_normal(20)
    return delays + np.sqrt(own) * rng.standard_normal(20) + slope @ common


def limit_of(delays, errors):
    own, slope, cov = errors
    return upper_limit(delays, own, slope, cov, LARGEST)


@pytest.mark.parametrize("scatter", [1e-3, 4e-3, 0.02])
def test_the_limit_exceeds_the_scatter_in_95_percent_of_the_studies(errors, scatter):
    limits = [limit_of(drawn(errors, scatter, seed), errors) for seed in range(STUDIES)]
    assert abs(np.mean(np.array(limits) >= scatter) - (1 - CHANCE)) < TOLERANCE
