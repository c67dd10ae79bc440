import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import etid
from etid import (
    ParallelRC,
    SkinCole,
    SkinLayers,
    SkinRC,
    capacitor,
    cole,
    constant_phase,
    parallel,
    parameter,
    resistor,
    series,
)
from etid.circuits import lookup
from etid.circuits.display import heading
from etid.signals.transfer import frequency_variable

FREQUENCY = jnp.geomspace(10.0, 1e6, 25)
S = frequency_variable(FREQUENCY)
ohms = st.floats(1e2, 1e6)
farads = st.floats(1e-12, 1e-6)


@given(ohms, ohms, farads)
def test_skin_is_equation_7(r_s, r_p, c_p):
    s = np.asarray(S)
    expected = ((r_s + r_p) + r_s * r_p * c_p * s) / (1 + r_p * c_p * s)
    np.testing.assert_allclose(SkinRC(r_s, r_p, c_p).response(FREQUENCY), expected, rtol=1e-12)


@given(ohms, ohms, farads)
def test_connections_commute_associate_and_scale(r1, r2, c):
    a, b, z = resistor(r1), resistor(r2), capacitor(c)
    for connect in (series, parallel):
        np.testing.assert_allclose(connect(a, z)(S), connect(z, a)(S), rtol=1e-12)
        together = connect(a, b, z)(S)
        np.testing.assert_allclose(connect(connect(a, b), z)(S), together, rtol=1e-11)
        scaled = connect(resistor(3 * r1), resistor(3 * r2), capacitor(c / 3))(S)
        np.testing.assert_allclose(scaled, 3 * together, rtol=1e-11)


def test_a_circuit_has_everything():
    circuit = SkinLayers(20e3, 80e3, 0.2e-9, 40e3, 2e-9)
    s = np.asarray(S)
    expected = 20e3 + 80e3 / (1 + s * 80e3 * 0.2e-9) + 40e3 / (1 + s * 40e3 * 2e-9)
    np.testing.assert_allclose(circuit.response(FREQUENCY), expected, rtol=1e-12)
    assert circuit.names() == ("r_s", "r_1", "c_1", "r_2", "c_2")
    assert circuit.units()["c_2"] == "farad"
    again = circuit.with_log_values(circuit.log_values())
    np.testing.assert_allclose(again.values(), circuit.values(), rtol=1e-14)
    batch = circuit.with_log_values(jnp.stack([circuit.log_values()] * 3))
    z = jax.jit(jax.vmap(lambda c: c.response(FREQUENCY)))(batch)
    np.testing.assert_allclose(z[2], expected, rtol=1e-12)


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


def test_typical_layers_are_the_published_time_constants():
    """Birlea, Birlea and Culea 2011: 10 to 40 µs and 100 to 200 µs."""
    layers = SkinLayers()
    assert 10e-6 < float(layers.r_1 * layers.c_1) < 40e-6
    assert 100e-6 < float(layers.r_2 * layers.c_2) < 200e-6
    assert float(layers.r_1 + layers.r_2) == float(SkinRC().r_p)
    cole = SkinCole()
    assert float(cole.tau) == pytest.approx(float(SkinRC().r_p * SkinRC().c_p), rel=1e-12)
    assert float(ParallelRC().r_p * ParallelRC().c_p) == pytest.approx(float(cole.tau), rel=1e-12)


def test_a_negative_resistance_is_not_repaired():
    assert float(resistor(-50.0)(jnp.array(1j)).real) == -50.0
    assert bool(jnp.isnan(SkinRC(-1.0, 1.0, 1.0).log_values()[0]))


def test_corner_frequency_of_the_skin():
    np.testing.assert_allclose(SkinRC(33.4e3, 186e3, 0.12e-9).f_c, 7130.6, rtol=1e-4)


@pytest.mark.parametrize("alpha", [0.1, 0.5, 0.85, 1.0])
def test_constant_phases_are_their_formulas(alpha):
    s = np.asarray(S)
    z = constant_phase(2e-9, alpha)(S)
    np.testing.assert_allclose(z, 1 / (2e-9 * s**alpha), rtol=1e-12)
    np.testing.assert_allclose(np.angle(z), -alpha * np.pi / 2, rtol=1e-12)
    spread = 186e3 / (1 + (s * 22e-6) ** alpha)
    np.testing.assert_allclose(cole(186e3, 22e-6, alpha)(S), spread, rtol=1e-12)


def test_an_exponent_of_one_is_a_capacitor():
    np.testing.assert_allclose(constant_phase(2e-9, 1.0)(S), capacitor(2e-9)(S), rtol=1e-12)
    np.testing.assert_allclose(
        SkinCole(33e3, 186e3, 186e3 * 0.12e-9, 1.0).response(FREQUENCY),
        SkinRC(33e3, 186e3, 0.12e-9).response(FREQUENCY),
        rtol=1e-12,
    )


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
    cov = jnp.diag(jnp.array([1e-6, 1e-6, 1e-6, 0.01**2]))
    for alpha, expected in ((0.9, False), (1.03, False), (1.05, True)):
        found = SkinCole().with_log_values(SkinCole(20e3, 100e3, 30e-6, alpha).log_values())
        assert bool(found.is_too_steep(cov)) == expected
    assert not bool(SkinRC().is_too_steep(jnp.eye(3)))


def test_a_connection_of_nothing_is_refused():
    for connect in (series, parallel):
        with pytest.raises(ValueError, match="has no arguments"):
            connect()


def test_units_are_scaled_in_print_and_one_has_no_symbol():
    assert heading("r_s", "ohm") == "r_s [kΩ]"
    assert heading("tau", "second") == "tau [µs]"
    assert heading("alpha", "1") == "alpha"


def test_unknown_units_are_refused():
    with pytest.raises(ValueError, match="'tesla' is not known"):
        parameter("tesla", typical=1.0)
