"""A driver from its impedance in place of a calibration."""

import dataclasses

import numpy as np
import pytest

import etid
from etid.recordings.errors import RecordingError
from etid.simulation.transformer import TransformerDriver

F = np.geomspace(60.0, 8e4, 60)
Z_TH = TransformerDriver().z_th(F)
RATE = 200e3


def study(name, seed=0, **settings):
    """One recording behind the transformer, and its true elements."""
    preset = getattr(etid.scenes, f"paper_{name}")(**settings)
    scene = dataclasses.replace(preset, trials=preset.trials[:1])
    [path] = [trial.path for trial in scene.trials]
    return scene.simulate(seed)[path], np.array(list(scene.truth()[path].values()))


@pytest.mark.parametrize("name", ["dry", "damp"])
@pytest.mark.parametrize("samples", [10_000, 6_200])
def test_of_a_netlist(name, samples):
    driver = etid.driver_of_response(F, Z_TH, sample_rate=RATE)
    assert driver.usable
    one, truth = study(name, snr_db=60.0, samples=samples, trigger_jitter_rms=50e-9)
    fit = etid.identify_skin(one, driver)
    z = (np.array(fit.circuit.values()) - truth) / np.array(fit.stderr.values())
    assert np.abs(z).max() < 4


def test_errors_contain_those_of_the_analyser():
    """At 80 dB nearly all of them are its errors, one draw for each skin."""
    rng, squares = np.random.default_rng(3), []
    records = {name: study(name, snr_db=80.0) for name in ("dry", "damp")}
    for _ in range(20):
        noise = rng.standard_normal((2, F.size))
        z_th = Z_TH * np.exp(0.003 * (noise[0] + 1j * noise[1]))
        driver = etid.driver_of_response(F, z_th, sample_rate=RATE, stderr=0.003)
        assert driver.usable
        for one, truth in records.values():
            fit = etid.identify_skin(one, driver)
            squares.append(((fit.circuit.values() - truth) / fit.stderr.values()) ** 2)
    # Chi-square of 20 draws: 0.999 of its means are within 0.27 and 2.4.
    assert ((np.mean(squares, 0) > 0.27) & (np.mean(squares, 0) < 2.4)).all()


def test_standard_errors_of_z_th_are_those_of_the_analyser():
    rng, found = np.random.default_rng(5), []
    at = np.array([300.0, 3e3, 3e4])
    true = TransformerDriver().z_th(at)
    for _ in range(20):
        noise = rng.standard_normal((2, F.size))
        z_th = Z_TH * np.exp(0.01 * (noise[0] + 1j * noise[1]))
        driver = etid.driver_of_response(F, z_th, sample_rate=RATE, stderr=0.01)
        off = np.log(driver.response(at) / true)
        found.append(np.stack([off.real, off.imag]) / driver.log_response_stderr(at))
    # 1.1 to 1.2 in the mean of 120 draws: poles that little shows follow the noise. The six numbers
    # of a draw depend on each other; chi-square of 40 has 0.999 of its means below 1.84.
    assert 0.44 < np.mean(np.square(found)) < 1.84


def test_too_few_poles_are_a_misfit():
    for stderr in (0.0, 1e-4):
        driver = etid.driver_of_response(F, Z_TH, sample_rate=RATE, stderr=stderr, order=2)
        assert driver.verdict == "misfit"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"z_th": Z_TH[1:]}, "z_th"),
        ({"frequency": 0 * F}, "frequency"),
        ({"z_th": np.nan * Z_TH}, "z_th"),
        ({"stderr": -1.0}, "stderr"),
        ({"sample_rate": 0.0}, "sample_rate"),
        ({"order": 0}, "order"),
        ({"frequency": F[:5], "z_th": Z_TH[:5]}, "z_th"),
    ],
)
def test_refusals(change, field):
    given = {"frequency": F, "z_th": Z_TH, "sample_rate": RATE} | change
    with pytest.raises(RecordingError) as raised:
        etid.driver_of_response(given.pop("frequency"), given.pop("z_th"), **given)
    assert raised.value.field == field
