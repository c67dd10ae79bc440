"""etid computes in float64, and the rest of the process keeps its precision."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

RATE = 200e3


@functools.cache
def example(wide):
    """What a user does, in a process of float64 or float32: a driver, skins, what is read."""
    with jax.enable_x64(wide):
        assert jnp.zeros(1).dtype == (np.float64 if wide else np.float32)
        return _example()


def _example():
    load = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    scene = Scene(
        (Trial("a", load), Trial("b", load)),
        (Trial("c", ResistorLoad(98.8e3)),),
        sample_rate=RATE,
        samples=6667,
    )
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["c"])
    fit = etid.identify_skin(study["a"], driver)
    fits = etid.identify_skins(study.loaded, driver)
    f = np.geomspace(100.0, 10e3, 5)
    return {
        "driver": driver,
        "z_th": driver.response(f),
        "z_th error": driver.response_stderr(f),
        "fit": fit,
        "errors": fit.stderr,
        "intervals": fit.intervals(),
        "z_load": fit.circuit.response(f),
        "f_c": fit.circuit.f_c,
        "logarithms": fit.circuit.log_values(),
        "profile": fit.profile("c_p").interval(),
        "predicted": etid.predict(study["a"], driver, fit.circuit),
        "fits": fits.fit,
        "one of them": fits[1],
        "text": etid.circuit_string(etid.SkinCole(tau=18.9e-6))[1],
        "start": etid.SkinRC(r_s=33333.333333),
    }


def test_numbers_do_not_depend_on_the_precision_of_the_process():
    wide, narrow = example(True), example(False)
    for name, found in narrow.items():
        for here, there in zip(jax.tree.leaves(found), jax.tree.leaves(wide[name]), strict=True):
            np.testing.assert_array_equal(here, there, name)
            assert np.asarray(here).dtype == np.asarray(there).dtype, name


def test_fits_hold_numpy_arrays():
    """An array of JAX would become float32 in the arithmetic of a process that has float32."""
    found = example(False)
    for name in ("fit", "errors", "fits", "one of them", "start"):
        arrays = [leaf for leaf in jax.tree.leaves(found[name]) if isinstance(leaf, jax.Array)]
        assert arrays == [], name


@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
def test_a_trace_in_float32_is_refused_with_the_line_to_add(transform):
    def r_s(v_out):
        fit = etid.identify_samples(v_out, v_out, driver, sample_rate=RATE, pulse_rate=60.0)
        return fit.circuit.r_s

    study = Scene((), (Trial("c", ResistorLoad(98.8e3)),), sample_rate=RATE, samples=2000)
    driver = etid.identify_driver(
        study.simulate(seed=1)["c"], order=2, method="steiglitz_mcbride", throw=False
    )
    with (
        jax.enable_x64(False),
        pytest.raises(RuntimeError, match=r'jax.config.update\("jax_enable_x64", True\)'),
    ):
        transform(r_s)(jnp.ones(2000))
