"""Known resistors that are wrong: several contradict each other, or none can be meant."""

import numpy as np
import pytest

import etid
from etid.results.driver import ContinuousDriver
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

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


def test_two_resistors_agree_within_the_tolerance_that_is_stated(calibrations):
    first, second = calibrations
    wrong = [first.replace(r_load=1.012 * KNOWN[0]), second.replace(r_load=0.99 * KNOWN[1])]
    verdicts, found = [], []
    for tolerance in (None, 1e-3, 1e-2):
        told = None if tolerance is None else etid.Instrument(r_load=tolerance)
        driver = etid.identify_driver(wrong, instrument=told, throw=False)
        assert isinstance(driver, ContinuousDriver)
        verdicts.append(driver.verdict)
        found.append(driver)
    # 2.2 % are 1.6 standard deviations of the difference of two errors of 1 %, 16 of 0.1 %.
    assert verdicts == ["resistors_disagree", "resistors_disagree", "successful"]
    off, error = np.asarray(found[-1].calibration.mismatch)
    np.testing.assert_allclose(error, np.sqrt(2) * 1e-2, rtol=0.02)  # noise adds little
    np.testing.assert_allclose(off, [0.022, -0.022], rtol=0.05)  # the square of 2 %, and noise
    # The driver is between those of both resistors: the error of each is estimated.
    errors = found[-1].calibration.errors
    assert errors is not None
    of_resistors = np.asarray(errors)[3:5]
    np.testing.assert_allclose(of_resistors, [-1.1, 1.1], atol=0.1)


@pytest.mark.parametrize(("across", "order"), [(0.0, 5), (2e-12, 5), (0.0, 3)])
def test_a_capacitance_across_one_of_two_resistors_is_seen_and_named(across, order):
    """At 60 dB 1 pF across the only resistor makes C_p of dry skin wrong by 3.8 %, unseen."""
    loads = etid.ParallelRC(KNOWN[0], across) if across else ResistorLoad(KNOWN[0])
    trials = (Trial("0", loads), Trial("1", ResistorLoad(KNOWN[1])))
    study = Scene(trials, snr_db=60.0).simulate(seed=1)
    known = [study[str(i)].replace(r_load=r) for i, r in enumerate(KNOWN)]
    driver = etid.identify_driver(known, order=order, throw=False)
    assert isinstance(driver, ContinuousDriver)
    c, error = np.asarray(driver.calibration.across)
    if across:
        assert driver.verdict == "resistors_disagree"
        assert abs(c[0] - across) < SIGMAS * error[0]
        assert error[0] < 0.2e-12
        assert "pF across it" in str(driver)
        return
    # A pole that is missing imitates a capacitance; the likelier of both is named.
    assert driver.verdict == ("successful" if order == 5 else "order_too_low")
    assert order != 5 or (np.abs(c) < SIGMAS * error).all()


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
