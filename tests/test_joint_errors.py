"""Standard errors of loads that share an unloaded record: effects are added, then squared."""

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.joint import errors, seen
from etid.estimators.joint.terms import Loads
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.harmonics import Spectrum
from etid.signals.knots import knots

HARMONICS, COMMON = 5, 2
ROWS = 2 * knots(HARMONICS).index.size


def repeated(one, count):
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), one)


def test_the_sum_over_a_shared_record_adds_what_its_loads_have_in_common():
    """Σ_i Σ_j≠i m_iᵀ m_j: of a load alone nothing is added, and bad loads do not take part."""
    effects = np.random.default_rng(0).standard_normal((6, ROWS, COMMON))
    line, wave = jnp.ones(HARMONICS), jnp.ones(HARMONICS, complex)
    spectrum = Spectrum(line, wave, wave, line, line, line > 0)
    loads = Loads(
        spectrum=repeated(spectrum, 6),
        sample_rate=jnp.arange(6.0),
        own=repeated(LoadUnknowns(jnp.zeros(2), jnp.zeros(())), 6),
        used=jnp.array([True, True, True, True, False, True]),
        unloaded=jnp.array([0, 1, 0, -1, 0, 2]),
    )
    by_x = errors._ByX(jnp.asarray(effects), jnp.zeros((6, ROWS, 3)))
    sums, added = errors._sums(loads, by_x, 3, COMMON)
    np.testing.assert_allclose(sums, [effects[0] + effects[2], effects[1], effects[5]])
    expected = effects[0].T @ effects[2] + effects[2].T @ effects[0]
    np.testing.assert_allclose(added, expected, atol=1e-12)
    _, none = errors._sums(loads, None, 0, COMMON)
    np.testing.assert_array_equal(none, np.zeros((COMMON, COMMON)))


def test_the_misfit_of_a_load_knows_its_own_unknowns():
    """χ² is Σ r² over two numbers for each harmonic that is used, less the unknowns."""
    part = jnp.array([3.0, 1.0, 0.0, 2.0, 0.0, 1.0])
    line, wave = jnp.ones(3), jnp.ones(3, complex)
    used = jnp.array([True, True, False])
    spectrum = Spectrum(line, wave, 2.0 * wave, line, line, used)
    chi2, rrse = seen._misfit(spectrum, 1.5 * wave, part, 3)
    assert float(chi2) == 15.0 / (2 * 2 - 3)
    np.testing.assert_allclose(rrse, 0.5 / 2.0)
