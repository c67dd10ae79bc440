"""Derivatives through a fit: implicit, against finite differences and against what must be."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import etid
from etid.estimators.maximum_likelihood import search
from etid.results.driver import ContinuousDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad
from etid.solvers import successive

# Minima to ten digits: a difference of two of them is to be compared.
EXACT = dataclasses.replace(search.WELL, rtol=1e-10, ftol=1e-15)
STEP = 1e-3  # of a disturbance that is small itself: the curvature costs its square
# Differences of minima along the flat direction of the driver repeat to some 1e-9 of an element.
REPEATED = 1e-8
# The derivative is that of the minimum of all harmonics, the fit that of the knots.
BETWEEN_KNOTS = 2e-2


class Derivatives(NamedTuple):
    """Of the logarithms of elements: by differences, and as JAX has them."""

    data_numeric: Array
    data: Array
    resistor_numeric: Array
    resistor: Array


def derivatives(load, circuit, order, monkeypatch):
    """By a disturbance of the data, and by the logarithm of the known resistor."""
    monkeypatch.setattr(search, "WELL", EXACT)
    monkeypatch.setattr(successive, "BEFORE", 1e-6)
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

    assert isinstance(driver, ContinuousDriver)
    r_load = driver.calibration.r_load
    shape = jnp.sin(jnp.arange(2000.0) * 0.13) + 0.3
    both = jax.jit(lambda v, r, dv, dr: jax.jvp(elements, (v, r), (dv, dr)))
    change, still = 1e-2 * shape * v_out, jnp.zeros_like(v_out)
    up, by_resistor = both(v_out, (1 + STEP) * r_load, still, r_load)
    down, also = both(v_out, (1 - STEP) * r_load, still, r_load)
    of_resistor = (up - down) / (2 * STEP), (by_resistor + also) / 2  # both of second order
    up, by_data = both(v_out + STEP * change, r_load, change, jnp.zeros_like(r_load))
    down, also = both(v_out - STEP * change, r_load, change, jnp.zeros_like(r_load))
    return Derivatives((up - down) / (2 * STEP), (by_data + also) / 2, *of_resistor)


@pytest.mark.slow
def test_a_resistor_follows_the_data_and_the_known_resistor_one_to_one(monkeypatch):
    found = derivatives(ResistorLoad(55.2e3), etid.Resistor(), 3, monkeypatch)
    np.testing.assert_allclose(found.data, found.data_numeric, rtol=1e-4, atol=REPEATED / STEP)
    assert abs(float(found.data[0])) > 1e-4
    np.testing.assert_allclose(found.resistor, 1.0, atol=1e-4)  # the weak prior of Z_th is in ohm


@pytest.mark.slow
def test_skin_follows_the_data_and_the_known_resistor_as_differences_say(monkeypatch):
    """By the resistor it is not 1:1 to the digit: Z_th stays as it was, but for one step to the
    minimum with another resistor, along a floor that is flat at 40 kHz."""
    load = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    found = derivatives(load, etid.SkinRC(), 5, monkeypatch)
    np.testing.assert_allclose(
        found.data, found.data_numeric, rtol=BETWEEN_KNOTS, atol=REPEATED / STEP
    )
    np.testing.assert_allclose(
        found.resistor, found.resistor_numeric, rtol=BETWEEN_KNOTS, atol=REPEATED / STEP
    )
    # One step is as good as the floor is straight: C_p is known to two thirds of its value here.
    np.testing.assert_allclose(found.resistor, [1.0, 1.0, -1.0], atol=0.2)
