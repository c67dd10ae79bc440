import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import etid
from etid import (
    SkinCole,
    SkinLayers,
    SkinRC,
    capacitor,
    cole,
    constant_phase,
    parallel,
    resistor,
    series,
)
from etid.circuits import lookup
from etid.circuits.circuit import too_steep
from etid.signals.transfer import frequency_variable

FREQUENCY = jnp.geomspace(10.0, 1e6, 25)
S = frequency_variable(FREQUENCY)
ohms = st.floats(1e2, 1e6)
farads = st.floats(1e-12, 1e-6)


@settings(max_examples=10)
@given(ohms, ohms, farads)
def test_connections_commute_associate_and_scale(r1, r2, c):
    a, b, z = resistor(r1), resistor(r2), capacitor(c)
    for connect in (series, parallel):
        np.testing.assert_allclose(connect(a, z)(S), connect(z, a)(S), rtol=1e-12)
        together = connect(a, b, z)(S)
        np.testing.assert_allclose(connect(connect(a, b), z)(S), together, rtol=1e-11)
        scaled = connect(resistor(3 * r1), resistor(3 * r2), capacitor(c / 3))(S)
        np.testing.assert_allclose(scaled, 3 * together, rtol=1e-11)


@pytest.mark.parametrize("kind", lookup.built_in().values())
def test_the_formula_is_the_impedance(kind):
    """As a person reads it: what stands beside each other is multiplied, ^ is a power."""
    text = kind.formula.lower().replace("^", "**")
    product = re.sub(r"(?<=[\w)]) (?=[\w(])", " * ", text)
    values = dict(zip(kind.names(), kind().values().tolist(), strict=True))
    expected = eval(product, values | {"s": np.asarray(S), "sqrt": np.sqrt, "tanh": np.tanh})
    np.testing.assert_allclose(kind().response(FREQUENCY), expected + 0 * S, rtol=1e-12)


def test_the_circuits_of_etid_are_public():
    assert sorted(lookup.built_in()) == [
        "ParallelRC",
        "Resistor",
        "SkinCole",
        "SkinLayers",
        "SkinRC",
        "SkinWarburg",
    ]
    for name, kind in lookup.built_in().items():
        assert getattr(etid, name) is kind
        assert lookup.class_path(kind) == f"etid:{name}"
        assert lookup.circuit_class(f"etid:{name}") is kind


def test_a_negative_resistance_is_not_repaired():
    assert float(resistor(-50.0)(jnp.array(1j)).real) == -50.0
    assert bool(jnp.isnan(SkinRC.of_fit([-1.0, 1.0, 1.0]).log_values()[0]))


@pytest.mark.parametrize("alpha", [0.1, 0.5, 0.85, 1.0])
def test_constant_phases_are_their_formulas(alpha):
    s = np.asarray(S)
    z = constant_phase(2e-9, alpha)(S)
    np.testing.assert_allclose(z, 1 / (2e-9 * s**alpha), rtol=1e-12)
    np.testing.assert_allclose(np.angle(z), -alpha * np.pi / 2, rtol=1e-12)
    spread = 186e3 / (1 + (s * 22e-6) ** alpha)
    np.testing.assert_allclose(cole(186e3, 22e-6, alpha)(S), spread, rtol=1e-12)


def test_trees_are_their_polynomials():
    for circuit in (SkinRC(), SkinLayers()):
        tree = circuit.impedance()
        np.testing.assert_allclose(tree.rational()(S), tree(S), rtol=1e-12)
        np.testing.assert_allclose(tree.admittance(S), 1 / np.asarray(tree(S)), rtol=1e-12)


def test_a_constant_phase_is_no_ratio_of_polynomials():
    assert SkinLayers().is_rational
    assert not SkinCole().is_rational
    with pytest.raises(ValueError, match=r"no rational function of s; .*maximum_likelihood"):
        SkinCole().impedance().rational()


def test_an_exponent_is_too_steep_if_its_error_does_not_explain_it():
    """Of rows in NumPy, and of one circuit in JAX."""
    cov = np.diag([1e-6, 1e-6, 1e-6, 0.01**2])
    logs = np.log([SkinCole(20e3, 100e3, 30e-6, alpha).values() for alpha in (0.9, 1.03, 1.05)])
    np.testing.assert_array_equal(
        too_steep(SkinCole(), logs, np.stack([cov] * 3)), [False, False, True]
    )
    assert bool(jax.jit(lambda logs: too_steep(SkinCole(), logs, jnp.asarray(cov)))(logs[2]))
    assert not too_steep(SkinRC(), SkinRC().log_values(), np.eye(3))
