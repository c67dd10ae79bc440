"""Known resistors that are wrong: several contradict each other, or none can be meant."""

import numpy as np
import pytest

import etid
from etid.results.driver import ContinuousDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

pytestmark = pytest.mark.usefixtures("run_as_for_users")

KNOWN = (98.8e3, 216.6e3)
SIGMAS = 5.0  # one in 2 million for a normal error


@pytest.fixture(scope="module")
def calibrations():
    trials = tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(KNOWN))
    study = Scene(calibration=trials, snr_db=60.0).simulate(seed=1)
    return [study[trial.path] for trial in trials]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "method"), [(1.0, None), (1.05, None), (0.95, None), (1.05, "output_error")]
)
def test_of_two_resistors_one_that_is_5_percent_wrong_is_seen(calibrations, factor, method):
    """It made every element wrong by 2 to 4 %, at chi2 5 or 1.5."""
    first, second = calibrations
    wrong = first.replace(r_load=factor * KNOWN[0])
    driver = etid.identify_driver([wrong, second], method=method, throw=False)
    assert isinstance(driver, ContinuousDriver)
    assert driver.calibration.mismatch is not None
    off, error = np.asarray(driver.calibration.mismatch)
    # Twice a standard error of 0.03 %; a step of Newton is off by the square of 5 %.
    assert np.all(error < 0.001)
    np.testing.assert_allclose(off[0], np.log(factor), atol=SIGMAS * error[0] + (factor - 1) ** 2)
    np.testing.assert_allclose(off[1], -off[0], rtol=0.2, atol=SIGMAS * error[1])
    assert driver.verdict == ("successful" if factor == 1 else "resistors_disagree")
    assert "r_load 216.6 kΩ is " in str(driver)


def test_a_resistor_in_kilohm_beside_one_in_ohm_is_seen(calibrations):
    first, second = calibrations
    with pytest.raises(etid.IdentificationError, match="resistors_disagree") as raised:
        etid.identify_driver([first.replace(r_load=98.8), second])
    assert "'calibration/0' 0.0" in str(raised.value)  # [kohm]: 13 ohm, for 13 kohm


@pytest.mark.parametrize("r_load", [98.8, 1e-3, 1e12])
def test_a_resistor_of_another_unit_makes_an_implausible_driver(calibrations, r_load):
    """One resistor is as good as another to chi2: what is not believed is the impedance."""
    calibration = calibrations[0].replace(r_load=r_load)
    with pytest.raises(
        etid.IdentificationError,
        match=r"implausible.*r_load is not in ohm.* With r_load .*, \|Z_th\| is .* at 1 kHz",
    ):
        etid.identify_driver(calibration)
    believed = etid.identify_driver(calibration, plausible=(0.0, np.inf))
    assert believed.verdict == "successful"
