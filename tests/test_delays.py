"""How far the trigger delays of a study scatter: an upper limit that holds as often as it says."""

import numpy as np
import pytest

from etid.selection.delays import upper_limit

LARGEST = 0.5
STUDIES = 500
TOO_SMALL = 3  # more of them would be one in 2 million runs


def errors_of(records):
    """Errors of delays: own ones of 2 to 9 ns at 5 µs a sample, and shared ones."""
    rng = np.random.default_rng(1)
    own = np.resize([0.4e-3, 1.8e-3], records) ** 2
    slope = rng.standard_normal((records, 3))
    root = 1e-3 * rng.standard_normal((3, 3))
    return own, slope, root @ root.T


def drawn(errors, scatter, rng):
    """Estimates of delays that scatter."""
    own, slope, cov = errors
    common = rng.multivariate_normal(np.zeros(3), cov)
    delays = scatter * rng.standard_normal(own.size)
    return delays + np.sqrt(own) * rng.standard_normal(own.size) + slope @ common


@pytest.mark.parametrize("scatter", [1e-3, 4e-3, 0.02])
@pytest.mark.parametrize("records", [3, 20])
def test_the_limit_exceeds_the_scatter_as_often_as_stated(records, scatter):
    """A few delays are alike by chance more easily than many; the limit knows."""
    rng, errors = np.random.default_rng(0), errors_of(records)
    limits = [upper_limit(drawn(errors, scatter, rng), *errors, LARGEST) for _ in range(STUDIES)]
    assert np.sum(np.array(limits) < scatter) <= TOO_SMALL


def test_many_delays_without_scatter_are_limited():
    """Else no study would have smaller errors for its common trigger."""
    rng, errors = np.random.default_rng(0), errors_of(60)
    own, slope, cov = errors
    limits = [upper_limit(drawn(errors, 0.0, rng), *errors, LARGEST) for _ in range(100)]
    each = np.sqrt(own + np.einsum("ij,jk,ik->i", slope, cov, slope))
    assert np.quantile(limits, 0.95) < np.median(each)
