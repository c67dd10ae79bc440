import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from etid import AbstractCircuit, SkinRC, capacitor, parallel, parameter, resistor, series
from etid.elements import Farad, Ohm
from etid.transfer import frequency_variable

FREQUENCY = jnp.geomspace(10.0, 1e6, 25)
S = frequency_variable(FREQUENCY)
ohms = st.floats(1e2, 1e6)
farads = st.floats(1e-12, 1e-6)


class SkinTwoLayer(AbstractCircuit):
    """Stratum corneum and viable epidermis in series, R(RC)(RC)."""

    r_s: Ohm = parameter("ohm", typical=20e3)
    r_1: Ohm = parameter("ohm", typical=80e3)
    c_1: Farad = parameter("farad", typical=0.2e-9)
    r_2: Ohm = parameter("ohm", typical=40e3)
    c_2: Farad = parameter("farad", typical=2e-9)

    def impedance(self):
        first = parallel(resistor(self.r_1), capacitor(self.c_1))
        second = parallel(resistor(self.r_2), capacitor(self.c_2))
        return series(resistor(self.r_s), first, second)


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


@given(ohms, ohms, farads)
def test_passive_circuits_have_no_negative_resistance(r_s, r_p, c_p):
    z = np.asarray(SkinRC(r_s, r_p, c_p).response(FREQUENCY))
    assert (np.real(z) >= -1e-9 * np.abs(z)).all()


def test_a_circuit_of_ones_own_has_everything():
    circuit = SkinTwoLayer()
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

    @jax.jit
    def magnitude(log_values):
        return jnp.abs(circuit.with_log_values(log_values).response(FREQUENCY)).sum()

    slope = jax.jit(jax.grad(magnitude))(circuit.log_values())
    step = 1e-5 * jnp.eye(5)  # central differences: error step², rounding 1e-16/step
    differences = [magnitude(circuit.log_values() + d) for d in (*step, *-step)]
    numeric = (jnp.stack(differences[:5]) - jnp.stack(differences[5:])) / 2e-5
    np.testing.assert_allclose(
        slope, numeric, rtol=1e-7, atol=1e-7 * float(magnitude(circuit.log_values()))
    )


def test_a_negative_resistance_is_not_repaired():
    assert float(resistor(-50.0)(jnp.array(1j)).real) == -50.0
    assert bool(jnp.isnan(SkinRC(-1.0, 1.0, 1.0).log_values()[0]))


def test_corner_frequency_of_the_skin():
    np.testing.assert_allclose(SkinRC(33.4e3, 186e3, 0.12e-9).f_c, 7130.6, rtol=1e-4)


def test_unknown_units_are_refused():
    with pytest.raises(ValueError, match="'henry' is not known"):
        parameter("henry", typical=1.0)
