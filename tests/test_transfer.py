import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from etid.signals.transfer import (
    Rational,
    add_polynomials,
    as_complex,
    combined,
    delay_variable,
    delayed,
    frequency_variable,
    is_stable,
    multiply_polynomials,
    poles,
    power,
    reciprocal,
    reflect_poles,
    turns,
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


def rows_of_numbers():
    rng = np.random.default_rng(5)
    z = rng.standard_normal((3, 4, 40)) + 1j * rng.standard_normal((3, 4, 40))
    return z, np.arange(1.0, 41.0) * 60.0, rng.uniform(-0.5, 0.5, (3, 4))


@pytest.mark.parametrize("apply", [
    lambda z, f, c: power(z),
    lambda z, f, c: reciprocal(z),
    lambda z, f, c: as_complex(c),
    lambda z, f, c: combined(c, z[0]),
    lambda z, f, c: frequency_variable(f),
    lambda z, f, c: delayed(z, f, c, 2e5),
    lambda z, f, c: turns(c, 40),
])  # fmt: skip
def test_numpy_and_jax_give_the_same_rows_in_their_own_namespace(apply):
    numbers = rows_of_numbers()
    found, expected = apply(*numbers), jax.jit(apply)(*map(jnp.asarray, numbers))
    assert isinstance(found, np.ndarray)
    assert isinstance(expected, jax.Array)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)  # of numbers near one
    with jax.numpy_dtype_promotion("strict"):
        np.testing.assert_allclose(apply(*map(jnp.asarray, numbers)), found, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("of", [np.asarray, jnp.asarray])
def test_delays_and_turns_of_rows_are_those_of_each_row(of):
    z, f, cycles = map(of, rows_of_numbers())
    late, turned = delayed(z, f, cycles, 2e5), turns(cycles, 40)
    for row in np.ndindex(3, 4):
        c = float(cycles[row])
        expected = np.exp(-2j * np.pi * np.asarray(f) * c / 2e5)
        np.testing.assert_allclose(late[row], np.asarray(z[row]) * expected, rtol=1e-13)
        np.testing.assert_allclose(delayed(z[row], f, cycles[row], 2e5), late[row], rtol=1e-13)
        expected = np.exp(2j * np.pi * c * np.arange(1, 41))
        np.testing.assert_allclose(turned[row], expected, rtol=1e-12)
        np.testing.assert_allclose(turns(cycles[row], 40), expected, rtol=1e-12)
    own = of(np.asarray(f) * np.linspace(1.0, 2.0, 12).reshape(3, 4, 1))  # of each row
    expected = z[2, 1] * np.exp(-2j * np.pi * np.asarray(own[2, 1]) * float(cycles[2, 1]) / 2e5)
    np.testing.assert_allclose(delayed(z, own, cycles, 2e5)[2, 1], expected, rtol=1e-13)
