"""What a user does arithmetic with is an array of NumPy in float64, whatever JAX is set to."""

import pickle
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.results.driver import DiscreteDriver

F = np.array([10.0, 1e3, 1e5])


@pytest.fixture(scope="module")
def study():
    return etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)


@pytest.fixture(scope="module", params=["maximum_likelihood", "steiglitz_mcbride"])
def driver(study, request):
    of = {"order": 5, "method": request.param, "throw": False}
    return etid.identify_driver(study["calibration/98k8"], **of)


WITHOUT_X64 = """
import warnings

import numpy as np

import etid

warnings.simplefilter("error")
skin = etid.SkinRC(r_s=33e3, r_p=186e3, c_p=0.12e-9)
f = 60.0 * np.arange(1, 1600)
for found in (skin.response(f), skin.response(1e3), skin.values(), skin.f_c):
    assert isinstance(found, np.ndarray | np.generic), type(found)
    assert found.dtype in (np.float64, np.complex128), found.dtype
z = skin.response(f)
exact = 33e3 + 186e3 / (1 + 2j * np.pi * f * 186e3 * 0.12e-9)
assert np.abs(f * z / (f * exact) - 1).max() < 1e-14
moved = skin.with_log_values(np.log(skin.values()) + 1e-9)
assert abs(moved.r_p / 186e3 - 1 - 1e-9) < 1e-14
"""


def test_responses_do_not_fall_to_float32_in_a_process_without_x64():
    """`pulse * skin.response(f)` was complex64, with a warning, in the guide's first block."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_X64], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("at", [1e3, np.float64(1e3), F, F[:, None]])
def test_every_response_takes_one_frequency_or_an_array_of_any_shape(driver, at):
    """`driver.response_stderr(1e3)` was an IndexError."""
    shape, z = np.shape(at), etid.SkinRC().response(at)
    found = {
        "response": driver.response(at),
        "gain": driver.gain(z, at),
        "sensitivity": driver.sensitivity(z, at),
        "response_stderr": driver.response_stderr(at),
    }
    for name, value in found.items():
        assert isinstance(value, np.ndarray | np.generic), name
        assert np.shape(value) == shape, name
        assert value.dtype == (np.float64 if name == "response_stderr" else np.complex128), name
    assert driver.log_response_stderr(at).shape == (2, *shape)
    flat = np.reshape(at, -1)
    np.testing.assert_allclose(np.ravel(found["response"]), driver.response(flat), rtol=1e-12)
    errors = driver.response_stderr(flat)
    np.testing.assert_allclose(np.ravel(found["response_stderr"]), errors, rtol=1e-12)
    assert np.isnan(errors).all() == isinstance(driver, DiscreteDriver)


def test_under_transformations_a_response_is_an_array_of_jax():
    circuit = etid.SkinRC()

    def size(f):
        z = circuit.response(f)
        assert isinstance(z, jax.Array)
        return jnp.abs(z)

    np.testing.assert_allclose(jax.vmap(size)(F), np.abs(circuit.response(F)), rtol=1e-14)
    assert jax.grad(size)(1e3) < 0


@pytest.mark.parametrize("value", [-1, 0, 0.0, np.array([1e3, -1.0]), jnp.asarray(-1.0)])
def test_a_circuit_with_an_element_that_is_not_positive_is_refused(value):
    with pytest.raises(ValueError, match=r"r_s of SkinRC is (-1|0); .* must be positive"):
        etid.SkinRC(r_s=value)
    string: Any = type(etid.circuit("R0-p(R1,C1)"))
    with pytest.raises(ValueError, match=r"c_1 of R0-p\(R1,C1\) is"):
        string(c_1=value)


def test_a_circuit_of_a_fit_may_hold_any_number(tmp_path):
    """Negative elements of a fit that is `nonphysical`, NaN of one that failed, errors of 0."""
    string = type(etid.circuit("R0-p(R1,C1)"))
    for kind in (etid.SkinRC, string):
        circuit = kind.of_fit([np.array(-1.0), np.array(np.nan), np.array(0.0)])
        doubled = jax.tree.map(lambda leaf: 2 * leaf, circuit)
        again = pickle.loads(pickle.dumps(doubled))
        np.testing.assert_array_equal(again.values(), [-2.0, np.nan, 0.0])
        assert str(again)
    assert jax.vmap(lambda r: etid.SkinRC(r_s=r).values()[0])(np.array([-1.0, 2.0]))[0] == -1
    noisy = etid.scenes.paper_dry(snr_db=20.0).simulate(seed=0)
    method = etid.SteiglitzMcBride(iterations=1)
    driver = etid.identify_driver(noisy["calibration/98k8"], method=method, throw=False)
    fits = etid.identify_skins([noisy["typical/dry/01"]], driver, method=method)
    assert not np.all(fits.circuit.values() > 0)
    fits.write(tmp_path / "fits.h5")
    read = etid.Fits.read(tmp_path / "fits.h5")
    np.testing.assert_array_equal(read.circuit.values(), fits.circuit.values())
    assert np.isnan(read.stderr.values()).all()


def test_calls_end_in_their_verdict_where_jax_looks_for_nan(study):
    """Every call ended in FloatingPointError."""
    with jax.debug_nans(True), jax.debug_infs(True):
        driver = etid.identify_driver(study["calibration/98k8"], order=5)
        fit = etid.identify_skin(study["typical/dry/01"], driver)
        assert "successful" in str(fit)
        assert etid.identify_impedance(F, etid.SkinRC().response(F)).verdict == "successful"
        assert np.isnan(etid.SkinRC().response(np.nan))
