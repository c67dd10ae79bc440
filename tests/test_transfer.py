import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from etid.signals.transfer import (
    Rational,
    add_polynomials,
    delay_variable,
    is_stable,
    multiply_polynomials,
    poles,
    reflect_poles,
)


def coefficients(size):  # few sizes, because every new shape is compiled
    return st.lists(st.floats(-10, 10), min_size=size, max_size=size)


multiply, add = jax.jit(multiply_polynomials), jax.jit(add_polynomials)


@given(
    st.sampled_from([(1, 4), (3, 3), (6, 2)]).flatmap(lambda n: st.tuples(*map(coefficients, n)))
)
def test_polynomials_equal_numpy(pair):
    p, q = pair
    product = multiply(jnp.array(p), jnp.array(q))
    np.testing.assert_allclose(product, np.convolve(p, q), atol=1e-10)
    total = add(jnp.array(p), jnp.array(q))
    expected = np.polyval(p[::-1], 0.7) + np.polyval(q[::-1], 0.7)
    np.testing.assert_allclose(np.polyval(total[::-1], 0.7), expected, atol=1e-10)


def test_sum_and_reciprocal_are_pointwise():
    f = Rational(jnp.array([1.0, 2.0]), jnp.array([3.0, 0.5]))
    g = Rational(jnp.array([2.0]), jnp.array([1.0, 1.0, 4.0]))
    x = jnp.array([0.3 + 0.1j, -1.0 + 2.0j])
    np.testing.assert_allclose(f.add(g)(x), np.asarray(f(x)) + np.asarray(g(x)), rtol=1e-13)
    np.testing.assert_allclose(f.reciprocal()(x), 1 / f(x), rtol=1e-13)


stable = jax.jit(is_stable)


@settings(max_examples=60)
@given(
    st.sampled_from([1, 4]).flatmap(
        lambda n: st.lists(st.floats(-1.5, 1.5), min_size=n, max_size=n)
    ),
    st.floats(0.2, 1.6),
    st.floats(0, 3),
)
def test_stability_agrees_with_the_roots(real, radius, angle):
    roots = [*real, radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]
    magnitude = np.abs(roots)
    assume(np.all(np.abs(magnitude - 1) > 1e-3))  # on the circle rounding decides
    a = jnp.array(np.poly(roots).real)
    assert bool(stable(a)) == bool((magnitude < 1).all())


def test_reflection_moves_poles_inside_and_keeps_the_magnitude_shape():
    a = jnp.array(np.poly([1.25, 0.5, 0.9 * np.exp(0.4j), 0.9 * np.exp(-0.4j)]).real)
    reflected = reflect_poles(a)
    np.testing.assert_allclose(np.sort(np.abs(poles(reflected))), [0.5, 0.8, 0.9, 0.9], rtol=1e-9)
    z = delay_variable(jnp.linspace(0.0, 0.5, 50), 1.0)
    ratio = np.abs(np.polyval(a[::-1], z) / np.polyval(reflected[::-1], z))
    np.testing.assert_allclose(ratio / ratio[0], 1.0, rtol=1e-9)
