"""Derivatives through a fit: implicit, against finite differences and against what must be."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid import single_load
from etid.scenes import Scene, Trial
from etid.transformer import ResistorLoad, SkinLoad

# Minima to ten digits: a difference of two of them is to be compared.
EXACT = dataclasses.replace(single_load.TOGETHER, rtol=1e-10, ftol=1e-15)
STEP = 1e-3  # of a disturbance that is small itself: the curvature costs its square
# Differences of minima along the flat direction of the driver repeat to some 1e-9 of an element.
REPEATED = 1e-8


def derivative(load, circuit, order, monkeypatch):
    """Elements at a step to either side, and their derivative by a disturbance and by r_load."""
    monkeypatch.setattr(single_load, "TOGETHER", EXACT)
    known = (Trial("c", ResistorLoad(98.8e3)),)
    scene = Scene((Trial("a", load),), known, sample_rate=40e3, samples=2000)
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["c"], order=order, throw=False)
    record = study["a"]
    v_th, v_out = jnp.asarray(record.v_th), jnp.asarray(record.v_out)

    @jax.jit
    def elements(v_out, r_load):
        changed = eqx.tree_at(lambda d: d.calibration.r_load, driver, r_load)
        fit = etid.identify_samples(
            v_th, v_out, changed, sample_rate=40e3, pulse_rate=60.0, circuit=circuit
        )
        return fit.circuit.log_values()

    assert driver.calibration is not None
    r_load = driver.calibration.r_load
    shape = jnp.sin(jnp.arange(2000.0) * 0.13) + 0.3
    both = jax.jit(lambda v, r, dv, dr: jax.jvp(elements, (v, r), (dv, dr)))
    still = jnp.zeros_like(r_load)
    change = 1e-2 * shape * v_out
    _, by_data = both(v_out, r_load, change, still)
    up, by_resistor = both(v_out + STEP * change, r_load, jnp.zeros_like(v_out), r_load)
    down, _ = both(v_out - STEP * change, r_load, jnp.zeros_like(v_out), r_load)
    return (up - down) / (2 * STEP), by_data, by_resistor


def test_a_resistor_follows_the_data_and_the_known_resistor_one_to_one(monkeypatch):
    numeric, by_data, by_resistor = derivative(
        ResistorLoad(55.2e3), etid.Resistor(), 3, monkeypatch
    )
    np.testing.assert_allclose(by_data, numeric, rtol=1e-4, atol=REPEATED / STEP)
    assert abs(float(by_data[0])) > 1e-4
    np.testing.assert_allclose(by_resistor, 1.0, atol=1e-4)  # the weak prior of Z_th is in ohm


@pytest.mark.slow
def test_the_skin_follows_the_data_and_its_elements_the_known_resistor(monkeypatch):
    load = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    numeric, by_data, by_resistor = derivative(load, etid.SkinRC(), 5, monkeypatch)
    np.testing.assert_allclose(by_data, numeric, rtol=1e-2, atol=REPEATED / STEP)
    np.testing.assert_allclose(by_resistor, [1.0, 1.0, -1.0], atol=3e-3)  # flat to that
