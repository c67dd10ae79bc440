"""Standard errors of loads that share an unloaded record: effects are added, then squared."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from etid.estimators.joint import errors
from etid.estimators.joint.terms import DriverStudy, Loads
from etid.estimators.sandwich import Curvature
from etid.estimators.unknowns import LoadUnknowns
from etid.signals.harmonics import Spectrum
from etid.signals.knots import knots

HARMONICS, COMMON = 5, 2
ROWS = 2 * knots(HARMONICS).index.size


def repeated(one, count):
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), one)


def test_the_sum_over_a_shared_record_adds_what_its_loads_have_in_common(monkeypatch):
    """Σ_i Σ_j≠i m_iᵀ m_j: of a load alone nothing is added, and bad loads do not take part."""
    effects = np.random.default_rng(0).standard_normal((6, ROWS, COMMON))

    def influence(study, common, load, own, eliminated):
        return jnp.asarray(effects)[load.sample_rate.astype(int)], None

    monkeypatch.setattr(errors, "_influence", influence)
    line, wave = jnp.ones(HARMONICS), jnp.ones(HARMONICS, complex)
    spectrum = Spectrum(line, wave, wave, line, line, line > 0)
    square, own = jnp.eye(3), LoadUnknowns(jnp.zeros(2), jnp.zeros(()))
    one = errors._Eliminated(
        Curvature(jnp.eye(COMMON), jnp.eye(COMMON)), square, jnp.zeros((3, COMMON)), square
    )
    loads = Loads(
        spectrum=repeated(spectrum, 6),
        sample_rate=jnp.arange(6.0),
        own=repeated(own, 6),
        used=jnp.array([True, True, True, True, False, True]),
        unloaded=jnp.array([0, 1, 0, -1, 0, 2]),
    )
    study = object.__new__(DriverStudy)  # only what is replaced would read it
    arguments = (study, jnp.zeros(COMMON), loads, repeated(own, 6), repeated(one, 6))
    sums, added = errors._sums(*arguments, 3)
    np.testing.assert_allclose(sums, [effects[0] + effects[2], effects[1], effects[5]])
    expected = effects[0].T @ effects[2] + effects[2].T @ effects[0]
    np.testing.assert_allclose(added, expected, atol=1e-12)
    _, none = errors._sums(*arguments, 0)
    np.testing.assert_array_equal(none, np.zeros((COMMON, COMMON)))


def test_the_misfit_of_a_load_knows_its_own_unknowns(monkeypatch):
    """χ² is Σ r² over two numbers for each harmonic that is used, less the unknowns."""
    part = jnp.array([3.0, 1.0, 0.0, 2.0, 0.0, 1.0])
    line, wave = jnp.ones(3), jnp.ones(3, complex)
    used = jnp.array([True, True, False])
    own = LoadUnknowns(jnp.zeros(2), jnp.zeros(()))
    load = Loads(
        spectrum=Spectrum(line, wave, 2.0 * wave, line, line, used),
        sample_rate=jnp.asarray(1.0),
        own=own,
        used=jnp.asarray(True),
        unloaded=jnp.asarray(-1),
    )
    unread: Any = None
    seen = errors._Seen(1.5 * wave, load.spectrum, part, unread, unread)
    monkeypatch.setattr(DriverStudy, "owned", property(lambda _: 3))
    chi2, rrse = errors._misfit(object.__new__(DriverStudy), load, seen)
    assert float(chi2) == 15.0 / (2 * 2 - 3)
    np.testing.assert_allclose(rrse, 0.5 / 2.0)
