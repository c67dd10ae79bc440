"""Standard errors of loads that share an unloaded record: effects are added, then squared."""

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.joint import errors
from etid.estimators.joint.terms import Loads
from etid.estimators.maximum_likelihood.profile import Profile, Records
from etid.estimators.sandwich import Curvature
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.harmonics import Spectrum
from etid.signals.knots import knots

HARMONICS, COMMON = 5, 2
ROWS = 2 * knots(HARMONICS).index.size


def repeated(one, count):
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), one)


def loads_with(unloaded, used):
    line, wave = jnp.ones(HARMONICS), jnp.ones(HARMONICS, complex)
    count = len(unloaded)
    return Loads(
        spectrum=repeated(Spectrum(line, wave, wave, line, line, line > 0), count),
        sample_rate=jnp.ones(count),
        own=repeated(LoadUnknowns(jnp.zeros(2), jnp.zeros(())), count),
        used=jnp.array(used),
        unloaded=jnp.array(unloaded),
    )


def test_the_sum_over_a_shared_record_adds_what_its_loads_have_in_common():
    """Σ_i Σ_j≠i m_iᵀ m_j: of a load alone nothing is added, and bad loads do not take part."""
    effects = np.random.default_rng(0).standard_normal((6, ROWS, COMMON))
    loads = loads_with([0, 1, 0, -1, 0, 2], [True, True, True, True, False, True])
    by_x = errors._ByX(jnp.asarray(effects), jnp.zeros((6, ROWS, 3)))
    sums, added = errors._sums(loads, by_x, 3, COMMON)
    np.testing.assert_allclose(sums, [effects[0] + effects[2], effects[1], effects[5]])
    expected = effects[0].T @ effects[2] + effects[2].T @ effects[0]
    np.testing.assert_allclose(added, expected, atol=1e-12)
    _, none = errors._sums(loads, None, 0, COMMON)
    np.testing.assert_array_equal(none, np.zeros((COMMON, COMMON)))


def test_the_covariance_with_a_shared_record_is_that_of_all_parameters_at_once():
    """H⁻¹ Jᵀ C J H⁻¹ of three loads whose terms have unit noise each."""
    draws, own, count = np.random.default_rng(1), 3, 3
    rows, total = 12, COMMON + 3 * own
    whole, parts, noise = np.zeros((count * rows, total)), [], np.zeros((count * rows, 2 * ROWS))
    for i in range(count):
        part = draws.standard_normal((rows, COMMON + own))
        at = slice(i * rows, (i + 1) * rows)
        whole[at, :COMMON] = part[:, :COMMON]
        whole[at, COMMON + i * own : COMMON + (i + 1) * own] = part[:, COMMON:]
        # Loads 0 and 1 have the columns of one record, load 2 those of another.
        record = slice(0, ROWS) if i < 2 else slice(ROWS, None)
        noise[at, record] = 0.3 * draws.standard_normal((rows, ROWS))
        parts.append((part, noise[at, record]))
    inverse = np.linalg.inv(whole.T @ whole)
    noise = noise @ noise.T
    for i in range(count):
        noise[i * rows : (i + 1) * rows, i * rows : (i + 1) * rows] = np.eye(rows)
    spread = whole.T @ noise @ whole
    expected = (inverse @ spread @ inverse)[COMMON : COMMON + own, COMMON : COMMON + own]

    eliminated, by_x = [], []
    for part, of_x in parts:
        of = Curvature(jnp.asarray(part.T @ part), jnp.asarray(part.T @ part))
        bread = jnp.linalg.inv(of.expected[COMMON:, COMMON:])
        slope = -bread @ of.expected[COMMON:, :COMMON]
        cov = bread @ of.score[COMMON:, COMMON:] @ bread
        none = jnp.zeros(COMMON)
        one = errors._Eliminated(of.eliminate(COMMON), cov, slope, bread, none, jnp.zeros(own))
        eliminated.append(one)
        by_x.append(errors._influence(jnp.asarray(of_x.T @ part), one))
    loads = loads_with([0, 0, 1], [True] * count)
    effects = jax.tree.map(lambda *leaves: jnp.stack(leaves), *by_x)
    sums, more = errors._sums(loads, effects, 2, COMMON)
    bread = jnp.linalg.inv(sum(one.rest.expected for one in eliminated))
    cov = bread @ (sum(one.rest.score for one in eliminated) + more) @ bread
    first, load = eliminated[0], jax.tree.map(lambda leaf: leaf[0], loads)
    of_x, shared = errors._by_x(load, by_x[0], sums, first.slope @ bread)
    found = first.cov - of_x + first.slope @ cov @ first.slope.T + shared
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_the_misfit_of_a_load_is_that_of_the_harmonics_that_are_used():
    """e = Y − G x has the variance 1 + 1.5², and counts twice: real and imaginary part."""
    line, wave = jnp.ones(3), jnp.ones(3, complex)
    used = jnp.array([True, True, False])
    spectrum = Spectrum(line, wave, 2.0 * wave, line, line, used)
    records = Records.of(spectrum)
    profile = Profile.of(records, 1.5 * wave[None, :])
    np.testing.assert_allclose(2 * profile.objective, 2 * 2 * 0.5**2 / (1 + 1.5**2))
    np.testing.assert_allclose(profile.rrse(records, wave), 0.5 / 2.0)
