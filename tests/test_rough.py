"""The laboratory whose driver and skin are not as the fits assume."""

import dataclasses

import numpy as np
import pytest

from benchmarks.paper import rough
from etid.simulation.falling import FallingResistance
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad, TransformerDriver, loading

F = 60.0 * np.arange(1, 5001)


@pytest.mark.parametrize("condition", ["dry", "damp"])
def test_a_resistance_that_does_not_fall_is_linear(condition):
    skin, driver = TYPICAL[condition], TransformerDriver()
    linear = 60.0 * driver.v_th_spectrum(F) * loading(skin(F), driver.z_th(F))
    still = FallingResistance(skin.r_p, skin.c_p, ResistorLoad(skin.r_s), 0.0)
    # The sum of a fixed point of the size of the voltage: rounding errors remain.
    np.testing.assert_allclose(still.voltage(driver, F), linear, atol=1e-12 * abs(linear).max())


def test_a_resistance_falls_as_stated():
    """What does not flow through the capacitor is v (1 + k (v / v₀)²) / R at all times."""
    skin, driver, fall = TYPICAL["damp"], TransformerDriver(), 0.2
    falling = FallingResistance(skin.r_p, skin.c_p, ResistorLoad(skin.r_s), fall)
    voltage = falling.voltage(driver, F)
    current = (60.0 * driver.v_th_spectrum(F) - voltage) / driver.z_th(F)
    across = voltage - skin.r_s * current
    through = current - 2j * np.pi * F * skin.c_p * across
    v, i = (np.fft.irfft(np.append(0.0, of), 2**14, norm="forward") for of in (across, through))
    expected = v / skin.r_p * (1 + fall / (1 - fall) * (v / abs(v).max()) ** 2)
    # No direct current passes a transformer; neither sum has one.
    error = i - i.mean() - (expected - expected.mean())
    assert np.sqrt(np.mean(error**2)) < 1e-3 * np.sqrt(np.mean(i**2))  # harmonics end at 300 kHz


def test_an_exact_skin_is_its_own_nearest_circuit(monkeypatch):
    for name, value in (("SECOND", 1e-9), ("FALL", 0.0)):
        monkeypatch.setattr(rough, name, value)
    skin = SkinLoad(12e3, 90e3, 0.3e-9)
    scene = rough.RoughScene((Trial("s01/dry/01", skin, subject="s01"),))
    near = scene.truth()["s01/dry/01"]
    # Least squares end at steps of 1e-8.
    assert near == pytest.approx(dataclasses.asdict(skin), rel=1e-5)


def test_fingertips_alone_are_rough():
    trials = (Trial("built/01", TYPICAL["dry"]), Trial("s01/dry/01", TYPICAL["dry"], subject="s01"))
    truth = rough.RoughScene(trials).truth()
    assert truth["built/01"] == dataclasses.asdict(TYPICAL["dry"])
    # Part of the second layer counts as R_s, and R_p is below that at small voltages.
    assert truth["s01/dry/01"]["r_s"] > 1.1 * TYPICAL["dry"].r_s
    assert truth["s01/dry/01"]["r_p"] < 0.9 * TYPICAL["dry"].r_p
