"""Standard errors of loads that share an unloaded record, against all parameters at once."""

import numpy as np

from etid.likelihood.joint.errors import AtMinimum, Eliminated, by_noise, correlated

COMMON, OWN, ROWS, NOISE = 2, 3, 12, 4  # parameters, terms of a load, numbers of a record's noise


def test_what_loads_with_one_record_have_in_common_adds_to_the_score_of_the_driver():
    """Σ_i Σ_j≠i m_iᵀ m_j over loads with one record: a load alone adds nothing."""
    m = np.random.default_rng(0).standard_normal((4, NOISE, COMMON))
    added = correlated(m, np.array([0, 1, 0, 2]))
    np.testing.assert_allclose(added, m[0].T @ m[2] + m[2].T @ m[0], atol=1e-12)


def test_the_covariance_of_the_driver_is_that_of_all_parameters_at_once():
    """H⁻¹ Jᵀ C J H⁻¹ of three loads whose terms have unit noise each, two with one record."""
    draws, unloaded = np.random.default_rng(1), np.array([0, 0, -1])
    whole = np.zeros((3 * ROWS, COMMON + 3 * OWN))
    noise, parts, of_x = np.zeros((3 * ROWS, NOISE)), [], []
    for i in range(3):
        at, own = slice(i * ROWS, (i + 1) * ROWS), COMMON + i * OWN
        part = draws.standard_normal((ROWS, OWN + COMMON))
        whole[at, :COMMON], whole[at, own : own + OWN] = part[:, OWN:], part[:, :OWN]
        parts.append(part)
        of_x.append(0.3 * draws.standard_normal((ROWS, NOISE)))
        noise[at] = of_x[-1] if unloaded[i] == 0 else 0.0
    score = noise @ noise.T
    for i in range(3):
        at = slice(i * ROWS, (i + 1) * ROWS)
        score[at, at] = np.eye(ROWS)
    inverse = np.linalg.inv(whole.T @ whole)
    expected = (inverse @ whole.T @ score @ whole @ inverse)[:COMMON, :COMMON]

    jacobian, ones = np.stack(parts).swapaxes(1, 2), np.ones((3, ROWS))
    by_x = np.stack([of.T @ part for of, part in zip(of_x, parts, strict=True)])
    none = np.zeros((3, OWN + COMMON, OWN + COMMON))
    at = AtMinimum(np.ones(3), np.ones(3), jacobian, ones, ones, 0 * ones, none, {}, by_x)
    found = Eliminated.of(at, OWN)
    bread, both = np.linalg.inv(found.rest.sum(0)), unloaded >= 0
    more = correlated(found.x_by_common[both], unloaded[both])
    np.testing.assert_allclose(
        bread @ (found.score.sum(0) + more) @ bread, expected, rtol=1e-9, atol=1e-12
    )


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
    [found] = by_noise(jacobian[None], gains[None])
    np.testing.assert_allclose(found, expected, rtol=1e-12)
