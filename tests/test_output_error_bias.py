"""Output error says where the noise of its input biases it."""

import dataclasses

import numpy as np
import pytest

import etid


@pytest.mark.parametrize(("snr_db", "usable"), [(20.0, False), (30.0, False), (60.0, True)])
def test_noise_of_the_input_biases_it(snr_db, usable):
    """At 20 dB |Z_th| was 100 standard errors off at 30 kHz, and successful."""
    preset = etid.scenes.paper_dry(snr_db=snr_db)
    study = dataclasses.replace(preset, trials=preset.trials[:3]).simulate(seed=1)
    how = {"method": "output_error", "throw": False}
    driver = etid.identify_driver(study["calibration/98k8"], **how)
    assert driver.usable == usable
    # Behind a driver that the default has found, the load alone is biased.
    right = etid.identify_driver(study["calibration/98k8"])
    fits = [etid.identify_skin(study[f"typical/dry/0{number}"], right, **how)
            for number in (1, 2, 3)]  # fmt: skip
    assert {fit.usable for fit in fits} == {usable}
    truth = np.array([33.4e3, 186e3, 0.12e-9])
    for fit in fits:
        off = (np.array(fit.circuit.values()) - truth) / np.array(fit.stderr.values())
        assert fit.verdict in ("successful", "biased", "insensitive")
        assert not fit.usable or np.abs(off).max() < 4
