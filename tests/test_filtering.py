from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from etid.circuits.circuit import Resistor, SkinRC
from etid.results.feed import loaded
from etid.signals import filtering
from etid.signals.filtering import BLOCK, CUTOFF, TAPS, band_limited, hold, simulate
from tests.test_driver import SOURCE

lfilter = jax.jit(filtering.lfilter)
run = jax.jit(simulate)
interpolate = jax.jit(band_limited, static_argnums=1)
held = jax.jit(lambda source, load, rate: hold(loaded(source, load, rate), rate))

# A recursion loses a few units of the last place per sample; 1e-12 is 1e4 of them.
ROUNDING = 1e-12


def random_filter(seed, order):
    rng = np.random.default_rng(seed)
    radius, angle = rng.uniform(0.3, 0.97, order // 2), rng.uniform(0.1, 3.0, order // 2)
    poles = np.concatenate([radius * np.exp(1j * angle), radius * np.exp(-1j * angle)])
    poles = np.concatenate([poles, rng.uniform(-0.9, 0.9, order % 2)])
    return rng.normal(size=order + 1), np.poly(poles).real, rng


@pytest.mark.parametrize(
    ("order", "time"),
    [(1, 5), (3, BLOCK), (4, BLOCK + 1), (6, 30 * BLOCK + 7)],
)
def test_equals_scipy_with_initial_state(order, time):
    b, a, rng = random_filter(order, order)
    x, zi = rng.normal(size=time), rng.normal(size=order)
    y, zf = lfilter(jnp.array(2 * b), jnp.array(2 * a), jnp.array(x), jnp.array(zi))
    expected, final = scipy.signal.lfilter(b, a, x, zi=zi)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(y, expected, atol=ROUNDING * scale)
    np.testing.assert_allclose(zf, final, atol=ROUNDING * scale)


def test_derivatives_agree_with_differences(getkey):
    """Along one direction of coefficients, input and state; the recursion has a rule of its own."""
    b, a = np.array([1.0, -0.5, 0.3, 0.2]), np.poly([0.9 + 0.1j, 0.9 - 0.1j, 0.8]).real
    x, zi = jax.random.normal(getkey(), (3 * BLOCK + 9,)), jax.random.normal(getkey(), (3,))
    at = jnp.array(b), jnp.array(2 * a), x, zi
    ways = tuple(jax.random.normal(getkey(), part.shape) for part in at)
    _, found = jax.jit(lambda *of: jax.jvp(filtering.lfilter, of, ways))(*at)
    step = 1e-6  # error step² of the third derivative, rounding 1e-16 / step
    low, high = (
        lfilter(*(part + sign * way for part, way in zip(at, ways, strict=True)))
        for sign in (-step, step)
    )
    for tangent, one, other in zip(found, low, high, strict=True):
        expected = (other - one) / 2 / step
        np.testing.assert_allclose(tangent, expected, atol=1e-6 * np.abs(expected).max())


def test_second_derivatives_agree_with_differences_of_the_first(getkey):
    """The recursion between blocks brings its own rule of differentiation."""
    x = jax.random.normal(getkey(), (3 * BLOCK,))

    def loss(p):
        return jnp.sum(jnp.sin(lfilter(jnp.ones(1), jnp.append(jnp.ones(1), p), x)[0]))

    p = jnp.array([-0.9])
    slope = jax.jit(jax.grad(loss))
    step = 1e-5  # error step² of the fourth derivative
    numeric = (slope(p + step) - slope(p - step)) / (2 * step)
    for second in (jax.jacfwd(jax.grad(loss)), jax.grad(lambda p: jax.jacfwd(loss)(p)[0])):
        np.testing.assert_allclose(jax.jit(second)(p).ravel(), numeric, rtol=1e-7)


# A Kaiser window with β = 10 attenuates by 10 / 0.1102 + 8.7 dB (Kaiser 1974), in its pass band as
# in its stop band; the transition is this wide on each side of the cutoff.
RIPPLE = 10 ** (-(10 / 0.1102 + 8.7) / 20)
TRANSITION = (10 / 0.1102 + 8.7 - 8) / (2.285 * 2 * np.pi * 2 * TAPS) / 2


@pytest.mark.parametrize(
    ("sample_rate", "cutoff", "fractions"),
    [
        (200e3, CUTOFF, [0.0031, 0.041, 0.13, 0.27]),
        (1e6, CUTOFF, [0.0031, 0.041, 0.13, 0.27]),
        (200e3, 0.47, [0.0031, 0.13, 0.27, 0.40]),
    ],
)
@pytest.mark.parametrize("load", [SkinRC(33e3, 186e3, 0.12e-9), Resistor(98.8e3)])
def test_held_system_has_the_continuous_frequency_response(sample_rate, cutoff, fractions, load):
    """Sines in the pass band of the interpolation, against the closed form of V_out / V_th."""
    n = np.arange(6000)
    frequency = np.array(fractions) * sample_rate
    assert max(fractions) < cutoff - TRANSITION
    assert 1 - max(fractions) > cutoff + TRANSITION  # the image that must not pass
    phasor = np.exp(2j * np.pi * np.outer(n, frequency) / sample_rate)
    v_th = phasor.real.sum(1)
    z = np.asarray(load.response(jnp.asarray(frequency)))
    h = z / (z + np.asarray(SOURCE.response(jnp.asarray(frequency))))
    expected = (phasor * h).real.sum(1)
    system = held(SOURCE, load.impedance().rational(), sample_rate)
    x0 = jnp.zeros_like(system.C)
    y, _ = run(system, interpolate(jnp.asarray(v_th), cutoff), x0)
    # 4000 samples let the slowest mode (300 rad/s, loaded 280) decay at 200 kHz; at 1 MHz it does
    # not, and its share is fitted out as the one slow exponential it is.
    tail = slice(4000, y.size)
    error = np.asarray(y)[tail] - expected[TAPS - 1 : TAPS - 1 + y.size][tail]
    slow = np.abs(np.linalg.eigvals(np.asarray(system.A))).max()
    decay = slow ** np.arange(error.size)
    error = error - decay * (decay @ error) / (decay @ decay)
    # Each of four sines and each image is off by the ripple; |h| of this driver rings up to 1.3.
    assert np.abs(error).max() < 4 * 2 * 1.3 * RIPPLE


def test_the_first_input_of_a_hold_is_a_zero_order_hold():
    system = loaded(SOURCE, SkinRC().impedance().rational(), 200e3)
    matrices = (system.A, system.B, system.C[None], system.D[None])
    discrete: Any = scipy.signal.cont2discrete(matrices, 1 / 200e3, method="zoh")
    A, B, *_ = discrete
    found = held(SOURCE, SkinRC().impedance().rational(), 200e3)
    np.testing.assert_allclose(found.A, A, atol=1e-11)
    np.testing.assert_allclose(found.B[:, :1], B, atol=1e-11 * np.abs(B).max())


EXPONENTIAL = jax.jit(filtering._expm)  # operation by operation, it takes seconds


@pytest.mark.parametrize("size", [1e-6, 1.0, 300.0, 1e6])
def test_the_matrix_exponential_is_that_of_scipy(size):
    """Slow and fast poles together, and the nilpotent chain of a hold beside them."""
    matrix = np.zeros((10, 10))
    matrix[:4, :4] = np.diag([-1e-3, -0.3, -1.0, -size]) + np.diag([0.1, 0.2, 0.3], 1)
    matrix[:4, 4] = 1.0
    matrix[np.arange(4, 9), np.arange(5, 10)] = 1.0
    found = EXPONENTIAL(jnp.asarray(matrix))
    np.testing.assert_allclose(found, scipy.linalg.expm(matrix), rtol=0, atol=ROUNDING)
