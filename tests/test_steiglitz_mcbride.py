import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

from etid import SkinRC
from etid.estimators.steiglitz_mcbride.iteration import (
    driver_filter,
    in_time,
    iterate,
    no_poles,
    periodic_driver_filter,
    skin_elements,
    skin_filter,
    terminal_voltage,
)
from etid.signals.filtering import lfilter
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import Rational, delay_variable

FS = 200e3
predict = jax.jit(terminal_voltage)
DRY = SkinRC(33.4e3, 186e3, 0.12e-9)
DAMP = SkinRC(6.1e3, 17.4e3, 0.66e-9)


def tustin(circuit):
    """The circuit as a discrete filter, by the bilinear transform."""
    continuous = circuit.impedance().rational()
    b, a = scipy.signal.bilinear(continuous.num[::-1], continuous.den[::-1], FS)
    return Rational(jnp.asarray(b), jnp.asarray(a))


def impulse_fit(h, orders, iterations):
    """Model an impulse response, as `stmcb` does; the error of the simulated response decides."""
    impulse = jnp.zeros(h.size).at[0].set(1.0)

    def assess(candidate):
        simulated = lfilter(candidate.num, candidate.den, impulse)[0]
        return jnp.linalg.norm(simulated - h) / jnp.linalg.norm(h)

    zeros, poles = orders

    @jax.jit
    def run(x, w):
        return iterate(in_time(x, w, zeros, poles), zeros, no_poles(jnp, poles), assess, iterations)

    return run(impulse[None], jnp.asarray(h)[None])


def test_models_of_impulse_responses_are_those_published(reference_data):
    cases = json.loads(reference_data("peer_cases.json").read_text())["steiglitz_mcbride"]["cases"]
    exact, reduced = cases[0], cases[2]
    h = np.asarray(scipy.signal.lfilter(exact["b"], exact["a"], np.eye(exact["n"])[0]))
    best = impulse_fit(h, exact["orders"], 8)
    np.testing.assert_allclose(best.filter.num, exact["b"], atol=exact["tol"])
    np.testing.assert_allclose(best.filter.den, exact["a"], atol=exact["tol"])
    assert bool(best.stable)
    b, a = np.asarray(scipy.signal.butter(6, 0.2))  # a filter of higher order
    h = np.asarray(scipy.signal.lfilter(b, a, np.eye(reduced["n"])[0]))
    best = impulse_fit(h, reduced["orders"], 10)
    # The reference is printed to 6 digits; the best iterate may be better than its fixed point.
    assert float(best.rrse) <= reduced["sm_rel_err"] * (1 + 1e-6)
    assert float(best.rrse) >= reduced["lm_output_error_optimum_rel_err"] * (1 - 1e-6)
    np.testing.assert_allclose(best.filter.den, reduced["sm_fixed_point_a"], atol=2e-2)


@pytest.fixture(scope="module")
def exact():
    """A pulse through a discrete driver with a resistor and with a bilinear skin, without noise."""
    pulse = np.zeros(3000)
    pulse[100:233] = 50.0
    pulse[1500:1633] = 50.0
    b, a = np.asarray(scipy.signal.butter(2, 0.3))
    v_th = jnp.asarray(scipy.signal.lfilter(b, a, pulse))
    den = np.poly([0.97, 0.6 * np.exp(0.8j), 0.6 * np.exp(-0.8j)]).real
    z_th = Rational(jnp.array([4e3, -3.5e3, 1.2e3]), jnp.asarray(den))
    r = 98.8e3
    v_ref, stable = predict(z_th, Rational(jnp.array([r]), jnp.ones(1)), v_th)
    assert bool(stable)
    z_bio = tustin(DAMP)
    v_out, stable = predict(z_th, z_bio, v_th)
    assert bool(stable)
    return v_th, v_ref, r, z_th, v_out


def test_driver_and_skin_are_exact_on_discrete_data(exact):
    """Eqs. (5)-(6), then (8)-(12), on data that obey the discrete model to the last digit."""
    v_th, v_ref, r, z_th, v_out = exact
    best = jax.jit(functools.partial(driver_filter, order=3))(
        v_th[None], v_ref[None], jnp.array([r])
    )
    z = delay_variable(jnp.linspace(0.0, 0.5, 30), 1.0)
    # The regression squares nothing (QR), so errors are rounding times a condition near 1e6.
    np.testing.assert_allclose(best.filter(z), z_th(z), rtol=1e-7)
    assert float(best.rrse) < 1e-10
    skin = jax.jit(skin_filter)(v_th, v_out, z_th)
    elements = skin_elements(skin.filter, FS)
    np.testing.assert_allclose(elements.values(), DAMP.values(), rtol=1e-7)
    assert bool(skin.converged)
    # The same in the periodic steady state, with two resistors and harmonics that are left out.
    r = jnp.array([98.8e3, 21.62e3])
    frequency = jnp.broadcast_to(60.0 * jnp.arange(1.0, 1601), (2, 1600))
    turn = 100 * (frequency / FS) ** 2
    x = jax.lax.complex(jnp.cos(turn), jnp.sin(turn)) / frequency.astype(complex)
    known = jnp.broadcast_to(r[:, None], x.shape).astype(complex)
    used = frequency < 0.35 * FS
    y = jnp.where(used, x * known / (known + z_th(delay_variable(frequency, FS))), 1.0)
    noise = jnp.ones_like(frequency)
    fit = functools.partial(periodic_driver_filter, order=3)
    of = Spectrum(frequency, x, y, noise, noise, used), r, jnp.asarray(FS)
    z = delay_variable(jnp.linspace(0.0, 0.35, 30), 1.0)
    for best in (jax.jit(fit)(*of), fit(*jax.tree.map(np.asarray, of))):
        np.testing.assert_allclose(best.filter(z), z_th(z), rtol=1e-7)
        assert float(best.rrse) < 1e-10


@pytest.mark.parametrize("circuit", [DRY, DAMP])
def test_elements_satisfy_equations_10_to_12(circuit):
    """Evaluate the printed definitions on Z(s) itself, not on the algebra of the implementation."""
    z_bio = tustin(circuit)
    elements = skin_elements(z_bio, FS)
    np.testing.assert_allclose(elements.values(), circuit.values(), rtol=1e-10)

    def z(s):
        return complex(circuit.impedance()(jnp.asarray(s, dtype=complex)))

    r_s, r_p, c_p = (float(x) for x in elements.values())
    assert abs(z(1e15) - r_s) < 1e-3 * r_s  # eq. (10)
    assert abs(z(0.0) - r_s - r_p) < 1e-9 * r_p  # eq. (11)
    magnitude = np.sqrt((r_s + r_p) ** 2 + r_s**2) / np.sqrt(2)
    assert abs(abs(z(1j / (r_p * c_p))) - magnitude) < 1e-9 * magnitude  # eq. (12)


@pytest.mark.parametrize("xp", [np, jnp])
def test_a_filter_that_is_no_circuit_has_elements_that_are_negative(xp):
    """The estimate is not corrected: its verdict says that it is not physical."""
    less = Rational(*(xp.asarray(of) for of in ([1e3, -2e3], [1.0, -0.5])))
    elements = np.asarray(skin_elements(less, FS).values())
    assert elements[0] == pytest.approx(2e3)
    assert elements[1] == pytest.approx(-4e3)
    assert elements[2] < 0


def test_the_magnitude_as_printed_costs_what_it_costs():
    """C_p where |Z(j/(R_p C_p))| is (2 R_s + R_p)/√2, as the paper prints it."""
    excess = []
    for circuit in (DRY, DAMP):
        r_s, r_p, c_p = (float(x) for x in circuit.values())
        printed = (2 * r_s + r_p) / np.sqrt(2)

        z, corner = circuit.impedance(), 1 / (r_p * c_p)
        found = scipy.optimize.root_scalar(
            lambda omega, z, printed: abs(complex(z(jnp.asarray(1j * omega)))) - printed,
            bracket=(0.1 * corner, corner),
            args=(z, printed),
        )
        excess.append(1 / (r_p * found.root) / c_p - 1)
    np.testing.assert_allclose(excess, [0.38, 0.88], atol=0.01)


def test_an_unstable_loop_is_reported_not_simulated():
    v_th = jnp.ones(200)
    unstable = Rational(jnp.array([-1.5, 0.0]), jnp.array([1.0, 0.0]))
    _, stable = predict(unstable, Rational(jnp.array([1.0, -0.9]), jnp.ones(1)), v_th)
    assert not bool(stable)
