"""The Cramer-Rao bound of a scene: equal to an independent one, and what follows from it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import etid
from benchmarks.spice import BOUND, scene_of
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver

DRY = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
KNOWN = (Trial("calibration/0", ResistorLoad(98.8e3)),)
INDEPENDENT = 1e-6  # two programs, one formula; they differ in the rounding of the noise


def relative(load=DRY, *, calibration=KNOWN, delays=True, known_driver=False, **settings):
    scene = Scene((Trial("a", load),), calibration, **settings)
    bounds = etid.bound(scene, delays=delays, known_driver=known_driver)
    return np.array(list(bounds["a"].relative.values()))


def test_the_bound_is_that_of_the_spice_recordings(reference_data):
    """`truth.json` comes from a program of its own, with one unloaded record for all."""
    scenes = json.loads((reference_data("spice_recordings") / "truth.json").read_text())["scenes"]
    compared = 0
    for truth in scenes.values():
        if BOUND not in truth["trials"][0]:
            continue
        scene = scene_of(truth)
        for key, delays in ((BOUND, True), ("crb_rel_RsRpCp", False)):
            bounds = etid.bound(scene, delays=delays)
            for name, trial in zip(bounds, truth["trials"], strict=True):
                found = list(bounds[name].relative.values())  # R_s, R_p, C_p, as there
                assert found == pytest.approx(trial[key], rel=INDEPENDENT)
                compared += len(found)
    assert compared > 500


def test_what_is_known_makes_every_error_smaller():
    unknown = relative()
    assert (relative(delays=False) < unknown).all()
    assert (relative(known_driver=True) < unknown).all()
    assert (relative(shared_v_th=True) < unknown).all()
    two = (*KNOWN, Trial("calibration/1", ResistorLoad(21.62e3)))
    assert (relative(calibration=two) < unknown).all()


def test_an_element_that_is_not_determined_is_named():
    scene = Scene((Trial("a", SkinLoad(30.0, 186e3, 0.12e-9)),), KNOWN, snr_db=40.0)
    bound = etid.bound(scene)["a"]
    assert bound.undetermined == ("r_s",)
    assert "do not determine r_s" in str(bound)
    assert "do not determine" not in str(etid.bound(etid.scenes.paper_dry())["typical/dry/01"])


def test_the_bounds_of_a_scene_are_a_table():
    loads = (Trial("a/dry", SkinLoad(33.4e3, 186e3, 0.12e-9)), Trial("b", ResistorLoad(55.2e3)))
    bounds = etid.bound(Scene(loads, KNOWN))
    _, skin, resistor = str(bounds).splitlines()
    of = f"± {100 * bounds['a/dry'].relative['r_s']:.2g} %"
    assert skin.split()[:7] == ["a/dry", "SkinRC", "r_s", "33.4", "kΩ", *of.split()[:2]]
    assert resistor.split()[:5] == ["b", "Resistor", "r", "55.2", "kΩ"]
    assert "<td" in (bounds._repr_html_() or "")


def test_the_bound_of_a_resistor_from_its_current_has_a_closed_form():
    """Y = R I, both with noise: the information on ln R is 2 Σ |R I|² / (σ_Y² + R² σ_I²)."""
    r = 55.2e3
    scene = Scene((Trial("a", ResistorLoad(r)),), current_snr_db=50.0, bits=None)
    [found] = etid.bound(scene, delays=False).values()
    waveform = scene.waveform()
    current = waveform.v_th / (r + waveform.z_th)
    noise = waveform.sigma**2 + (r * scene.current_noise(current)) ** 2
    inside = waveform.f < scene.sample_rate / 2
    information = 2 * scene.samples * np.sum(np.abs(r * current[inside]) ** 2) / noise
    assert found.relative["r"] == pytest.approx(information**-0.5, rel=INDEPENDENT)


def test_a_fit_from_a_current_has_the_errors_of_the_bound():
    scene = Scene((Trial("a", DRY),), current_snr_db=60.0, trigger_jitter_rms=50e-9)
    fit = etid.identify_skin(scene.simulate(3)["a"])
    found = np.asarray(fit.stderr.values()) / np.asarray(fit.circuit.values())
    bound = np.array(list(etid.bound(scene)["a"].relative.values()))
    # The noise of 1 700 harmonics is estimated to a few per cent, and the fit leaves out the last.
    np.testing.assert_allclose(found, bound, rtol=0.1)
    truth = np.array(list(scene.truth()["a"].values()))
    assert (np.abs(np.asarray(fit.circuit.values()) / truth - 1) < 4 * bound).all()


@pytest.mark.parametrize(
    ("scene", "text"),
    [
        (Scene((Trial("a", lambda f: 1e5 + 0j * f),), KNOWN), "'a'.*no elements"),
        (Scene((Trial("a", DRY),), KNOWN, snr_db=None, bits=None), "neither noise"),
        (Scene((Trial("a", DRY),)), "no calibration"),
    ],
)
def test_a_scene_without_a_bound_is_told_why(scene, text):
    with pytest.raises(ValueError, match=text):
        etid.bound(scene)


@pytest.mark.parametrize("way", ["voltage", "both", "current"])
def test_jax_differentiates_a_bound_by_pulse_resistor_load_and_noise(way):
    def relative(q):
        width, ohm, r_s, r_p, c_p, snr = q * typical
        load = etid.SkinRC(r_s, r_p, c_p)
        known = () if way == "current" else (Trial("calibration/0", ResistorLoad(ohm)),)
        driver = TransformerDriver(width=width)
        noise = {"snr_db": snr, "bits": None}
        if way != "voltage":
            noise["current_snr_db"] = snr
        scene = Scene((Trial("a", load),), known, driver=driver, **noise)
        return jnp.stack(list(etid.bound(scene)["a"].relative.values()))

    typical = np.array([0.7e-3, 50e3, 33.4e3, 186e3, 0.12e-9, 60.0])
    at, step = np.ones(typical.size), 2e-5 * np.eye(typical.size)
    found, slopes = jax.jit(lambda q: (relative(q), jax.jacfwd(relative)(q)))(at)
    np.testing.assert_allclose(found, relative(at), rtol=1e-9)
    # Zeros of the pulse move with its width: third order leaves 2e-6, and rounding 1e-7.
    differences = [(relative(at + one) - relative(at - one)) / 4e-5 for one in step]
    np.testing.assert_allclose(slopes.T, differences, rtol=1e-5, atol=1e-6 * np.abs(found).max())


def test_the_covariance_of_a_bound_is_that_of_the_elements():
    bound = etid.bound(etid.scenes.paper_dry())["typical/dry/01"]
    np.testing.assert_allclose(np.sqrt(np.diagonal(bound.cov)), list(bound.stderr.values()))
    relative = np.sqrt(np.diagonal(bound.log_cov))
    np.testing.assert_allclose(relative, list(bound.relative.values()))
    np.testing.assert_allclose(relative * bound.circuit.values(), list(bound.stderr.values()))
