"""Standard errors of loads that share an unloaded record, against all parameters at once."""

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.joint import errors
from etid.estimators.joint.terms import Loads
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.sandwich import Curvature, Linear
from etid.signals.harmonics import Spectrum

COMMON, OWN, ROWS, NOISE = 2, 3, 12, 4  # parameters, terms of a load, numbers of a record's noise


def loads_with(unloaded, used):
    def repeated(one):
        return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(unloaded)), one)

    line, wave = jnp.ones(5), jnp.ones(5, complex)
    return Loads(
        spectrum=repeated(Spectrum(line, wave, wave, line, line, line > 0)),
        sample_rate=jnp.ones(len(unloaded)),
        own=repeated(LoadUnknowns(jnp.zeros(OWN - 1), jnp.zeros(()))),
        errors=jnp.zeros((len(unloaded), 0)),
        used=jnp.array(used),
        unloaded=jnp.array(unloaded),
    )


def test_what_loads_with_one_record_have_in_common_adds_to_the_score_of_the_driver():
    """Σ_i Σ_j≠i m_iᵀ m_j: a load alone adds nothing, and loads that take no part do not either."""
    m = np.random.default_rng(0).standard_normal((6, NOISE, COMMON))
    loads = loads_with([0, 1, 0, -1, 0, -1], [True, True, True, True, False, True])
    added = errors._correlated(loads, errors._ByX(jnp.asarray(m), jnp.zeros((6, NOISE, OWN))), 2)
    np.testing.assert_allclose(added, m[0].T @ m[2] + m[2].T @ m[0], atol=1e-12)


def test_the_covariance_of_the_driver_is_that_of_all_parameters_at_once():
    """H⁻¹ Jᵀ C J H⁻¹ of three loads whose terms have unit noise each, two with one record."""
    draws, unloaded = np.random.default_rng(1), (0, 0, -1)
    whole = np.zeros((3 * ROWS, COMMON + 3 * OWN))
    noise, parts = np.zeros((3 * ROWS, NOISE)), []
    for i in range(3):
        at, own = slice(i * ROWS, (i + 1) * ROWS), COMMON + i * OWN
        part = draws.standard_normal((ROWS, COMMON + OWN))
        of_x = 0.3 * draws.standard_normal((ROWS, NOISE))
        whole[at, :COMMON], whole[at, own : own + OWN] = part[:, :COMMON], part[:, COMMON:]
        noise[at] = of_x if unloaded[i] == 0 else 0.0
        parts.append((part, of_x))
    covariance = noise @ noise.T
    for i in range(3):
        at = slice(i * ROWS, (i + 1) * ROWS)
        covariance[at, at] = np.eye(ROWS)
    inverse = np.linalg.inv(whole.T @ whole)
    expected = (inverse @ whole.T @ covariance @ whole @ inverse)[:COMMON, :COMMON]

    rests, by_x = [], []
    for part, of_x in parts:
        of = Curvature(jnp.asarray(part.T @ part), jnp.asarray(part.T @ part))
        bread = jnp.linalg.inv(of.expected[COMMON:, COMMON:])
        slope = -bread @ of.expected[COMMON:, :COMMON]
        one = errors._Eliminated(of.eliminate(COMMON), bread, slope, bread)
        rests.append(one.rest)
        by_x.append(errors._influence(jnp.asarray(of_x.T @ part), one))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *by_x)
    more = errors._correlated(loads_with(unloaded, [True] * 3), stacked, 1)
    bread = jnp.linalg.inv(sum(of.expected for of in rests))
    found = bread @ (sum(of.score for of in rests) + more) @ bread
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_noise_of_an_unloaded_record_moves_the_gradient_as_the_gains_bring_it_into_the_terms():
    """∂(J r)/∂n of terms Re and Im of g n, for real and for imaginary noise of each X."""
    outputs, size, q = 2, 4, 3
    draws = np.random.default_rng(2)
    jacobian = draws.standard_normal((q, 2 * outputs * size))
    gains = draws.standard_normal((outputs, size)) + 1j * draws.standard_normal((outputs, size))
    expected = []
    for unit in (1.0, 1j):
        for x in range(size):
            noise = unit * gains * (np.arange(size) == x)
            expected.append(jacobian @ np.concatenate([noise.real.ravel(), noise.imag.ravel()]))
    ones = jnp.ones(2 * outputs * size)
    found = errors._by_noise(Linear(jnp.asarray(jacobian), ones, ones), jnp.asarray(gains))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
