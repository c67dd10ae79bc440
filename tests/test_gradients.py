"""Derivatives through a fit: implicit, against differences of fits and against what must be."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from etid.estimators.maximum_likelihood import search
from etid.results.driver import ContinuousDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad
from etid.solvers import successive

# Minima to ten digits: a difference of two of them is to be compared.
EXACT = dataclasses.replace(search.WELL, rtol=1e-10, ftol=1e-15)
STEP = 1e-3  # of a disturbance that is small itself: the curvature costs its square
# Differences of minima along the flat direction of the driver repeat to some 1e-9 of an element.
REPEATED = 1e-8


@pytest.mark.slow
def test_a_resistor_follows_the_data_and_the_known_resistor_one_to_one(monkeypatch):
    monkeypatch.setattr(search, "WELL", EXACT)
    monkeypatch.setattr(successive, "BEFORE", 1e-6)
    known = (Trial("c", ResistorLoad(98.8e3)),)
    scene = Scene((Trial("a", ResistorLoad(55.2e3)),), known, sample_rate=40e3, samples=2000)
    study = scene.simulate(seed=1)
    driver = etid.identify_driver(study["c"], order=3, throw=False)
    assert isinstance(driver, ContinuousDriver)
    v_th, v_out = jnp.asarray(study["a"].v_th), jnp.asarray(study["a"].v_out)
    r_load = driver.calibration.r_load

    @jax.jit
    def derivative(v_out, r_load, of_v_out, of_r_load):
        """The logarithm of the resistor, and its derivative in one direction."""

        def log_resistor(v_out, r_load):
            changed = eqx.tree_at(lambda d: d.calibration.r_load, driver, r_load)
            fit = etid.identify_samples(
                v_th, v_out, changed, sample_rate=40e3, pulse_rate=60.0, circuit=etid.Resistor()
            )
            return fit.circuit.log_values()[0]

        return jax.jvp(log_resistor, (v_out, r_load), (of_v_out, of_r_load))

    change = 1e-2 * (jnp.sin(jnp.arange(2000.0) * 0.13) + 0.3) * v_out
    still = jnp.zeros_like(r_load)
    up, by_data = derivative(v_out + STEP * change, r_load, change, still)
    down, also = derivative(v_out - STEP * change, r_load, change, still)
    numeric = (up - down) / (2 * STEP)
    assert abs(float(numeric)) > 1e-4
    # The mean of two derivatives and the difference are both of second order.
    np.testing.assert_allclose((by_data + also) / 2, numeric, rtol=1e-4, atol=REPEATED / STEP)
    _, by_resistor = derivative(v_out, r_load, 0 * v_out, r_load)
    np.testing.assert_allclose(by_resistor, 1.0, atol=1e-4)  # the weak prior of Z_th is in ohm
