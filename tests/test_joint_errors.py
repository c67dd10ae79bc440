"""Standard errors of loads that share an unloaded record: effects are added, then squared."""

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.joint import errors
from etid.estimators.joint.terms import Loads
from etid.estimators.maximum_likelihood.profile import Profile, Records
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


def test_the_misfit_of_a_load_is_that_of_the_harmonics_that_are_used():
    """e = Y − G x has the variance 1 + 1.5², and counts twice: real and imaginary part."""
    line, wave = jnp.ones(3), jnp.ones(3, complex)
    used = jnp.array([True, True, False])
    spectrum = Spectrum(line, wave, 2.0 * wave, line, line, used)
    records = Records.of(spectrum)
    profile = Profile.of(records, 1.5 * wave[None, :])
    np.testing.assert_allclose(2 * profile.objective, 2 * 2 * 0.5**2 / (1 + 1.5**2))
    np.testing.assert_allclose(profile.rrse(records, wave), 0.5 / 2.0)
