"""The score test against constant phases: its slope, its statistic, and what it sees in records."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.failure_axes import Cole, TwoLayers
from benchmarks.ladder import CALIBRATION, LOADS, rung
from benchmarks.skins import SkinCole, SkinTwoLayer
from etid import dispersion
from etid.scenes import Trial


def test_the_slope_is_that_of_a_constant_phase():
    """Against a central difference of (jω)^α in the place of jω."""
    skin, step = LOADS["dry"], 1e-5
    f = np.geomspace(60.0, 1e5, 30)
    s = 2j * np.pi * f

    def spread(alpha):
        return skin.r_s + skin.r_p / (1 + s**alpha * skin.r_p * skin.c_p)

    circuit = etid.SkinRC(skin.r_s, skin.r_p, skin.c_p)
    z, slope = dispersion.slope(circuit.impedance(), jnp.asarray(f))
    np.testing.assert_allclose(z, spread(1.0), rtol=1e-12)
    expected = (spread(1 + step) - spread(1 - step)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-7)  # step², and rounding over step


def test_the_slope_of_a_spread_relaxation_is_that_of_its_asymmetry():
    """Against a central difference of ln s + ε ln² (s/s₀) in the place of ln s."""
    circuit, step = SkinCole(33e3, 186e3, 22e-6, 0.85), 1e-5
    f = np.geomspace(60.0, 1e5, 30)
    log_s = np.log(2j * np.pi * f)
    middle = np.log(2 * np.pi * np.sqrt(60.0 * 1e5))

    def skewed(epsilon):
        s = np.exp(log_s + epsilon * (log_s - middle) ** 2)
        return 33e3 + 186e3 / (1 + (s * 22e-6) ** 0.85)

    z, slope = dispersion.slope(circuit.impedance(), jnp.asarray(f))
    np.testing.assert_allclose(z, skewed(0.0), rtol=1e-12)
    expected = (skewed(step) - skewed(-step)) / (2 * step)
    np.testing.assert_allclose(slope, expected, rtol=1e-7)  # step², and rounding over step


def seen(residual, row, jacobian):
    """Without priors, in white noise of known size."""
    q = jacobian.shape[0]
    covariance = np.linalg.inv(jacobian @ jacobian.T)
    ones = np.ones(row.size)
    of = (row, jacobian, residual, np.zeros(q), np.zeros((q, q)), covariance, ones, ones)
    return bool(dispersion.is_seen(*map(jnp.asarray, of)))


@pytest.mark.parametrize(("z", "expected"), [(3.99, False), (4.01, True), (-4.01, True)])
def test_what_counts_is_the_residual_along_what_the_parameters_cannot_do(z, expected):
    rng = np.random.default_rng(4)
    jacobian, row = rng.normal(size=(3, 50)), rng.normal(size=50)
    rest = row - np.linalg.lstsq(jacobian.T, row, rcond=None)[0] @ jacobian
    along = rest / np.linalg.norm(rest)
    anything = rng.normal(size=3) @ jacobian  # a fit that has not quite ended
    assert seen(z * along + anything, row, jacobian) == expected


def test_a_spread_that_hardly_matters_is_none():
    """However well it is determined: a driver that is not quite right looks like that."""
    rng = np.random.default_rng(6)
    jacobian, row = rng.normal(size=(3, 50)), 1e4 * rng.normal(size=50)
    assert not seen(0.009 * row, row, jacobian)
    assert seen(0.011 * row, row, jacobian)


def test_a_load_without_a_capacitor_has_no_phase_to_be_constant():
    rng = np.random.default_rng(5)
    assert not seen(rng.normal(size=50), np.zeros(50), rng.normal(size=(3, 50)))


def identified(load, snr_db, circuit=None):
    scene = dataclasses.replace(rung("dry", snr_db=snr_db), trials=(Trial("skin", load),))
    study = scene.simulate(11)
    driver = etid.identify_driver(study[CALIBRATION])
    return etid.identify_skin(study["skin"], driver, circuit=circuit, throw=False)


def test_two_layers_are_no_cole_relaxation_where_chi2_does_not_show_it():
    """R_s is 10 standard errors off, χ² 1.02."""
    load = SkinTwoLayer(33.4e3, 150e3, 0.12e-9, 36e3, 5e-9)
    fit = identified(load, 40.0, SkinCole())
    assert fit.chi2 < 1.5
    assert abs(fit.circuit.values()[0] - 33.4e3) > 5 * fit.stderr.values()[0]
    assert fit.verdict == "misfit"


@pytest.mark.parametrize("load", [Cole(LOADS["dry"], 0.9), TwoLayers(LOADS["damp"], 0.05)])
def test_another_skin_is_a_misfit_where_chi2_does_not_show_it(load):
    """R_s of these is 24 and 10 % off."""
    fit = identified(load, 40.0)
    assert fit.chi2 < 1.5
    assert fit.verdict == "misfit"


@pytest.mark.parametrize("snr_db", [40.0, 80.0])
def test_the_circuit_itself_is_none(snr_db):
    """At 80 dB too, where a driver of order 5 is not quite that of the scene, of order 6."""
    assert identified(LOADS["damp"], snr_db).verdict == "successful"
