import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from etid import Resistor, SkinRC, capacitor, parallel, resistor, series
from etid.circuits.impedance import realise
from etid.estimators.refined_driver import is_split
from etid.results.feed import SourceImpedance, loaded
from etid.signals.transfer import frequency_variable

FREQUENCY = jnp.geomspace(10.0, 1e6, 25)
S = np.asarray(frequency_variable(FREQUENCY))
RATE = 2e5  # [1/s]

# State matrices are of order 1e6 and solved at 60 rad/s: their condition, 1e5, times ε.
SOLVED = 1e-9

SOURCE = SourceImpedance(
    log_resistance=jnp.log(600.0),
    log_omega=jnp.log(jnp.array([3.0e5, 1.5e6])),
    log_zeta=jnp.log(jnp.array([0.25, 1.2])),
    gain=jnp.array([9e3, 2e3]),
    slope=jnp.array([1.2e4, 500.0]),
    log_omega_real=jnp.log(jnp.array([300.0])),
    gain_real=jnp.array([-5e3]),
)
LAYERS = series(
    resistor(20e3),
    parallel(resistor(80e3), capacitor(0.2e-9)),
    parallel(resistor(40e3), capacitor(2e-9)),
).rational()
LOADS = {
    "skin": SkinRC(33.4e3, 186e3, 0.12e-9).impedance().rational(),
    "resistor": Resistor(98.8e3).impedance().rational(),
    "two layers": LAYERS,
    "no series resistor": parallel(resistor(80e3), capacitor(0.2e-9)).rational(),
}

respond = jax.jit(SourceImpedance.response)


def transfer_of(system):
    """C (s − A)⁻¹ B + D by numpy."""
    eye = np.eye(system.A.shape[0])
    A, B = np.asarray(system.A), np.asarray(system.B)[:, 0]
    columns = [np.linalg.solve(s * eye - A, B) for s in S]
    return np.array(columns) @ np.asarray(system.C) + float(system.D[0])


def test_source_impedance_is_its_formula():
    expected = 600.0 - 5e3 / (1 + S / 300.0)
    for w, zeta, g, h in ((3e5, 0.25, 9e3, 1.2e4), (1.5e6, 1.2, 2e3, 500.0)):
        expected = expected + (g + h * S / w) / (1 + 2 * zeta * S / w + (S / w) ** 2)
    np.testing.assert_allclose(respond(SOURCE, FREQUENCY), expected, rtol=1e-12)
    np.testing.assert_allclose(transfer_of(SOURCE.state_space()), expected, rtol=SOLVED)
    assert SOURCE.order == 5


def test_slopes_are_the_derivatives_of_the_formula():
    def parts(vector, frequency):
        z = unravel(vector).response(frequency)
        return jnp.stack([z.real, z.imag])

    @jax.jit
    def derivatives(vector, f):
        by_log_f = jax.jvp(lambda f: parts(vector, f), (f,), (f,))[1]
        return jnp.moveaxis(jax.jacfwd(parts)(vector, f), -1, 0), by_log_f

    vector, unravel = ravel_pytree(SOURCE)
    z, slopes = SOURCE.with_slopes(FREQUENCY)
    np.testing.assert_allclose(z, respond(SOURCE, FREQUENCY), rtol=1e-12)
    expected, by_log_f = derivatives(vector, FREQUENCY)
    size = jnp.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        jnp.stack([slopes.real, slopes.imag], axis=1) / size, expected / size, atol=1e-12
    )
    found = -slopes[SOURCE.log_omegas].sum(axis=0)
    np.testing.assert_allclose(jnp.stack([found.real, found.imag]), by_log_f, rtol=1e-9, atol=1e-6)


def one_section(log_zeta):
    none = jnp.zeros(0)
    one, half = jnp.ones(1), jnp.full(1, 0.5)
    return SourceImpedance(jnp.zeros(()), 0 * one, log_zeta * one, one, half, none, none)


def test_poles_pass_from_complex_to_real_smoothly():
    slope = jax.jit(jax.grad(lambda d: jnp.abs(one_section(d).response(jnp.array(0.2)))))
    jet = [slope(jnp.array(d)) for d in (-1e-9, 0.0, 1e-9)]  # ζ = 1 is a double pole
    assert np.ptp(np.array(jet)) < 1e-8
    assert np.isfinite(jet).all()


@pytest.mark.parametrize("name", LOADS)
def test_realisations_have_the_right_response(name):
    load = LOADS[name]
    z = np.asarray(load(jnp.asarray(S)))
    np.testing.assert_allclose(transfer_of(realise(load, RATE)), z, rtol=SOLVED)
    expected = z / (z + np.asarray(respond(SOURCE, FREQUENCY)))
    system = loaded(SOURCE, load, RATE)
    np.testing.assert_allclose(transfer_of(system), expected, rtol=10 * SOLVED)
    # A passive driver and a passive load cannot oscillate.
    assert np.linalg.eigvals(np.asarray(system.A)).real.max() < 0


@pytest.mark.parametrize(
    ("omega", "zeta", "split"),
    [
        ((3.0e5, 3.02e5), (0.29, 0.28), True),
        ((3.0e5, 1.5e6), (0.29, 0.28), False),
        ((3.0e5, 3.02e5), (0.2, 1.2), False),
        ((3.0e5, 1.5e6, 1.49e6), (0.2, 1.2, 1.2), True),
        ((3.0e5,), (0.2,), False),
    ],
)
def test_sections_in_one_place_are_one_that_is_split(omega, zeta, split):
    gain = jnp.ones(len(omega))
    logs = jnp.log(jnp.array(omega)), jnp.log(jnp.array(zeta))
    source = SourceImpedance(jnp.zeros(()), *logs, gain, gain, jnp.zeros(1), jnp.ones(1))
    assert bool(is_split(source)) == split
