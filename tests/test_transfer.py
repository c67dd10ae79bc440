import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from etid.transfer import (
    Rational,
    add_polynomials,
    delay_variable,
    frequency_variable,
    is_stable,
    multiply_polynomials,
    poles,
    reflect_poles,
    tustin,
)

coefficients = st.lists(st.floats(-10, 10), min_size=1, max_size=6)


@given(coefficients, coefficients)
def test_polynomials_equal_numpy(p, q):
    product = multiply_polynomials(jnp.array(p), jnp.array(q))
    np.testing.assert_allclose(product, np.convolve(p, q), atol=1e-10)
    total = add_polynomials(jnp.array(p), jnp.array(q))
    expected = np.polyval(p[::-1], 0.7) + np.polyval(q[::-1], 0.7)
    np.testing.assert_allclose(np.polyval(total[::-1], 0.7), expected, atol=1e-10)


def test_products_of_lanes_do_not_mix():
    p, q = jnp.arange(6.0).reshape(3, 2), jnp.ones((3, 2)).at[1, 0].set(jnp.nan)
    product = jax.vmap(multiply_polynomials)(p, q)
    assert jnp.isnan(product[1]).any()
    assert not jnp.isnan(product[jnp.array([0, 2])]).any()


def test_sum_product_and_reciprocal_are_pointwise():
    f = Rational(jnp.array([1.0, 2.0]), jnp.array([3.0, 0.5]))
    g = Rational(jnp.array([2.0]), jnp.array([1.0, 1.0, 4.0]))
    x = jnp.array([0.3 + 0.1j, -1.0 + 2.0j])
    np.testing.assert_allclose(f.add(g)(x), f(x) + g(x), rtol=1e-13)
    np.testing.assert_allclose(f.multiply(g)(x), f(x) * g(x), rtol=1e-13)
    np.testing.assert_allclose(f.reciprocal()(x), 1 / f(x), rtol=1e-13)


def test_tustin_equals_scipy_bilinear():
    num, den = np.array([2.0e5, 3.0, 1e-5]), np.array([1.0, 2e-5, 4e-10])
    discrete = tustin(Rational(jnp.array(num), jnp.array(den)), 200e3)
    b, a = scipy.signal.bilinear(num[::-1], den[::-1], 200e3)
    np.testing.assert_allclose(discrete.num, b, rtol=1e-10)
    np.testing.assert_allclose(discrete.den, a, rtol=1e-10)


def test_variables_on_the_frequency_axis():
    frequency = jnp.array([0.0, 50e3])
    np.testing.assert_allclose(frequency_variable(frequency), [0, 2j * np.pi * 50e3])
    np.testing.assert_allclose(delay_variable(frequency, 200e3), [1, -1j], atol=1e-15)


@settings(max_examples=60)
@given(st.lists(st.floats(-1.5, 1.5), min_size=1, max_size=4), st.floats(0.2, 1.6), st.floats(0, 3))
def test_stability_agrees_with_the_roots(real, radius, angle):
    roots = [*real, radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]
    magnitude = np.abs(roots)
    if np.any(np.abs(magnitude - 1) < 1e-3):
        return  # on the circle rounding decides, and both answers are right
    a = jnp.array(np.poly(roots).real)
    assert bool(is_stable(a)) == bool((magnitude < 1).all())


def test_nan_is_not_stable():
    assert not bool(is_stable(jnp.array([1.0, jnp.nan, 0.1])))


def test_reflection_moves_poles_inside_and_keeps_the_magnitude_shape():
    a = jnp.array(np.poly([1.25, 0.5, 0.9 * np.exp(0.4j), 0.9 * np.exp(-0.4j)]).real)
    reflected = reflect_poles(a)
    np.testing.assert_allclose(np.sort(np.abs(poles(reflected))), [0.5, 0.8, 0.9, 0.9], rtol=1e-9)
    z = delay_variable(jnp.linspace(0.0, 0.5, 50), 1.0)
    ratio = np.abs(np.polyval(a[::-1], z) / np.polyval(reflected[::-1], z))
    np.testing.assert_allclose(ratio / ratio[0], 1.0, rtol=1e-9)
