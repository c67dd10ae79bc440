"""The likelihood of one unknown input against that of a dense covariance, by NumPy."""

import numpy as np
import pytest

from etid.likelihood.profile import Profile, Records

HARMONICS = 4


def dense(x, variance_x, g, y, variance_y):
    """½ D, 2 Σ⁻¹ e, 2 Σ⁻¹ and X̂ at one harmonic, for e = y − g x with covariance Σ."""
    inverse = np.linalg.inv(np.diag(variance_y) + variance_x * np.outer(g, g.conj()))
    e = y - g * x
    estimate = x + variance_x * g.conj() @ inverse @ e
    return (e.conj() @ inverse @ e).real, 2 * inverse @ e, 2 * inverse, estimate


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_a_profile_is_the_gaussian_likelihood_of_all_outputs(outputs):
    """Also where an output is not used at a harmonic: it is as if it had not been recorded."""
    rng = np.random.default_rng(outputs)

    def complexes(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    x, y, gains = (complexes(*of, HARMONICS) for of in ((), (outputs,), (outputs,)))
    variance_x, variance_y = rng.uniform(0.1, 2, HARMONICS), rng.uniform(0.1, 2, y.shape)
    used = np.ones(y.shape, bool)
    used[-1, 2] = False
    records = Records(np.arange(1.0, HARMONICS + 1), x, variance_x, y, variance_y, used)
    found = Profile.of(records, gains)
    pull, lower = found.pull, found.information()
    information = np.zeros((outputs, outputs, HARMONICS), complex)
    for i, row in enumerate(lower):
        for j, of in enumerate(row):
            information[i, j], information[j, i] = of, of.conj()
    total = 0.0
    for k in range(HARMONICS):
        in_use = np.flatnonzero(used[:, k])
        of = dense(x[k], variance_x[k], *(part[in_use, k] for part in (gains, y, variance_y)))
        total += of[0]
        at = np.ix_(in_use, in_use)
        np.testing.assert_allclose(pull[in_use, k], of[1], rtol=1e-10)
        np.testing.assert_allclose(found.x[k], of[3], rtol=1e-10)
        np.testing.assert_allclose(information[..., k][at], of[2], rtol=1e-10)
        assert not pull[~used[:, k], k].any()
    np.testing.assert_allclose(found.objective, total, rtol=1e-10)
