"""Discrete filters as objects, and Steiglitz-McBride on arrays."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import etid
from etid.signals.filtering import BLOCK
from tests.test_filtering import ROUNDING, random_filter

SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)
RATE = 200e3
F = np.array([0.0, 60.0, 1e3, 2e4, 9e4])


@pytest.fixture(scope="module")
def driver():
    return etid.identify_driver(etid.read("data_schema/example.h5")["calibration/98k8"], order=5)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize(("order", "time"), [(1, 5), (4, BLOCK + 1), (6, 30 * BLOCK + 7)])
def test_equals_scipy_for_rows_of_inputs_and_states(order, time, xp):
    b, a, rng = random_filter(order, order)
    u, zi = rng.normal(size=(2, 3, time)), rng.normal(size=(3, order))

    def simulated(b, a, u, zi):
        return etid.Filter.of(b, a).simulate(u, zi)

    y, state = (simulated if xp is np else jax.jit(simulated))(2 * b, 2 * a, u, zi)
    expected, final = scipy.signal.lfilter(b, a, u, zi=np.broadcast_to(zi, (2, 3, order)))
    assert isinstance(y, np.ndarray) == (xp is np)
    np.testing.assert_allclose(y, expected, atol=ROUNDING * np.abs(expected).max())
    np.testing.assert_allclose(state, final, atol=ROUNDING * np.abs(expected).max())


def test_a_gain_has_no_state():
    gain = etid.Filter.of(np.array([3.0]), np.array([2.0]))
    y, state = gain.simulate(np.arange(4.0))
    np.testing.assert_array_equal(y, 1.5 * np.arange(4.0))
    assert state.shape == (0,)
    np.testing.assert_array_equal(gain.response(F / RATE), np.full(F.size, 1.5))


@pytest.mark.parametrize("order", [1, 5])
def test_coefficients_and_response(order):
    b, a, _ = random_filter(3, order)
    of = etid.Filter.of(b, a, RATE)
    np.testing.assert_allclose(of.b, b, atol=1e-12)
    np.testing.assert_allclose(of.a, a, atol=1e-12)
    how: Any = {"worN": F, "fs": RATE}
    expected = scipy.signal.freqz(b, cast(Any, a), **how)[1]
    np.testing.assert_allclose(of.response(F), expected, atol=1e-11 * np.abs(expected).max())


def test_a_circuit_under_the_bilinear_map():
    """The paper's eq. 7, from which eqs. 10 to 12 find the elements again."""
    r_s, r_p, c_p = SKIN.values()
    tau = r_p * c_p
    b, a = map(np.asarray, scipy.signal.bilinear([r_s * tau, r_s + r_p], [tau, 1.0], RATE))
    of = etid.Filter.bilinear(SKIN, RATE)
    np.testing.assert_allclose(of.b, b, rtol=1e-12)
    np.testing.assert_allclose(of.a, a, rtol=1e-12)
    assert of.response(np.zeros(1))[0] == pytest.approx(r_s + r_p)


def test_a_divider_is_the_ratio_of_both_impedances(driver):
    source = etid.Filter.bilinear(driver.source, RATE)
    load = etid.Filter.bilinear(SKIN, RATE)
    z, z_th = load.response(F), source.response(F)
    np.testing.assert_allclose(load.divider(source).response(F), z / (z + z_th), rtol=1e-9)
    # Passive impedances remain passive under the map, so that the loop is stable.
    assert np.abs(np.linalg.eigvals(load.divider(source).A)).max() < 1
    with pytest.raises(ValueError, match="100000 Hz and the source of 200000 Hz"):
        etid.Filter.bilinear(SKIN, 1e5).divider(source)


def test_its_derivatives_agree_with_differences(driver):
    source = etid.Filter.bilinear(driver.source, RATE)
    u = np.random.default_rng(0).normal(size=200)

    @jax.jit
    @jax.value_and_grad
    def last(logs):
        skin = SKIN.of_fit(jnp.exp(logs))
        return etid.Filter.bilinear(skin, RATE).divider(source).simulate(jnp.asarray(u))[0][-1]

    logs = jnp.log(jnp.asarray(SKIN.values()))
    (_, found), step = last(logs), 1e-5
    numeric = [
        (last(logs + step * e)[0] - last(logs - step * e)[0]) / (2 * step) for e in np.eye(3)
    ]
    np.testing.assert_allclose(found, numeric, rtol=1e-6)  # rounding 1e-16 / step


@pytest.mark.parametrize("zeros", [None, 1])
def test_a_filter_is_found_in_its_output(zeros):
    rng = np.random.default_rng(1)
    b, a = np.array([0.3, 0.5, 0.0 if zeros else -0.2]), np.array([1.0, -1.5, 0.7])
    u = rng.normal(size=(2, 500))  # two records of one filter
    y, _ = etid.Filter.of(b, a).simulate(u)
    found = etid.steiglitz_mcbride(u, y, 2, zeros=zeros, sample_rate=RATE)
    np.testing.assert_allclose(found.a, a, atol=1e-9)
    np.testing.assert_allclose(found.b, b, atol=1e-9)
    assert found.sample_rate == RATE


def test_noise_of_the_output_biases_equation_error_only():
    rng = np.random.default_rng(2)
    truth = np.array([1.0, -1.5, 0.7])
    u = rng.normal(size=4000)
    y, _ = etid.Filter.of(np.array([0.0, 0.5]), truth).simulate(u)
    y = y + 0.1 * np.std(y) * rng.normal(size=u.size)
    first, last = (etid.steiglitz_mcbride(u, y, 2, iterations=n) for n in (1, 20))
    # The bound of a coefficient is about 0.1 / √4000.
    assert np.abs(last.a - truth).max() < 0.01
    assert np.abs(first.a - truth).max() > 0.05


def test_the_hair_dryer(reference_data):
    """Plain Steiglitz-McBride of another program ends at 0.13 to 0.19, output error at 0.112."""
    lines = (reference_data("hair_dryer") / "IB01AD.dat").read_text().split("\n", 2)[2]
    u, y = np.array(lines.split(), float)[:2000].reshape(2, 1000)
    u, y = u - u.mean(), y - y.mean()
    found = etid.steiglitz_mcbride(u, y, 4)
    left = y - found.simulate(u)[0]
    assert np.linalg.norm(left) / np.linalg.norm(y) < 0.115


def test_refusals_of_arrays():
    x = np.zeros(10)
    with pytest.raises(ValueError, match="records of one shape"):
        etid.steiglitz_mcbride(x, x[1:], 2)
    with pytest.raises(ValueError, match="order is 0"):
        etid.steiglitz_mcbride(x, x, 0)
    with pytest.raises(ValueError, match="13 coefficients"):
        etid.steiglitz_mcbride(x, x, 6)
    with pytest.raises(ValueError, match="at least one"):
        etid.steiglitz_mcbride(x, x, 2, iterations=0)
    assert np.isnan(etid.steiglitz_mcbride(x, x, 2).a).any()  # nothing determines it


def test_strings_are_circuits_and_a_filter_looks_at_no_later_sample():
    named, given = (
        etid.Filter.bilinear(of, RATE) for of in ("R0-p(R1,C1)", etid.circuit("R0-p(R1,C1)"))
    )
    np.testing.assert_array_equal(named.b, given.b)
    with pytest.raises(ValueError, match=r"a\[0\] is 0"):
        etid.Filter.of(np.array([1.0, 2.0]), np.array([0.0, 1.0]))
