"""A driver that failed: the command and the file say which one, why, and with which number."""

import json

import numpy as np
import pytest

import etid
from etid import cli
from etid.results.verdicts import message


@pytest.fixture(scope="module")
def records():
    """A calibration with 98.8 kΩ and a dry fingertip."""
    study = etid.scenes.paper_dry(bits=None).simulate(seed=5)
    return study["calibration/98k8"], study["typical/dry/01"]


def louder(one):
    """More at the load than without it: the work of no passive driver."""
    return one.v_out * np.std(one.v_th) / np.std(one.v_out) * 1.004


SLIPS = {
    "98.8 for 98.8 kΩ": (
        lambda one: [one.replace(r_load=98.8)],
        "implausible",
        "With r_load 98.8 ohm, |Z_th| is 12.69 ohm at 1 kHz.",
    ),
    "a current that nobody stated": (
        lambda one: [one.replace(v_out=louder(one), adc_range=None)],
        "nonphysical",
        "",
    ),
    "a driver that warms up": (
        lambda one: [one.replace(v_out=one.v_out * np.linspace(1.0, 1.05, one.v_out.size))],
        "changed",
        "",
    ),
    "one resistor of two is 9 % wrong": (
        lambda one: [one, one.replace(path="other", r_load=90e3, v_out=1.000001 * one.v_out)],
        "resistors_disagree",
        "r_load 90 kΩ is -8.9",
    ),
    "a flat record": (lambda one: [one.replace(v_out=0 * one.v_out)], "flat", "in v_out"),
    "exchanged channels": (
        lambda one: [one.replace(v_out=one.v_th, v_th=one.v_out)],
        "misaligned",
        "",
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_the_command_says_why_the_driver_failed(records, tmp_path, capsys, slip):
    """It said "1 driver, 0 failed" and named a verdict that was printed nowhere."""
    change, verdict, number = SLIPS[slip]
    calibration, skin = records
    known = change(calibration)
    skin = skin.replace(calibration=tuple(one.path for one in known))
    etid.Study.from_recordings([*known, skin]).write(tmp_path / "study.h5")
    command = ["fit", str(tmp_path / "study.h5"), "-o", str(tmp_path / "fits.h5"), "--force"]

    assert cli.main(command) == 1
    printed = capsys.readouterr().out.splitlines()
    names = ", ".join(one.path for one in known)
    assert "1 driver, 1 failed" in printed
    (why,) = (line for line in printed if line.startswith(f"  {names}: "))
    assert f"{verdict}. " in why
    assert message(verdict) in why
    assert number in why
    assert "nan" not in "\n".join(printed)

    cli.main([*command, "--json"])
    (driver,) = json.loads(capsys.readouterr().out)["drivers"]
    told = driver.get("note") or driver["error"]
    assert message(verdict) in told
    assert number in told

    found = etid.StudyFits.read(tmp_path / "fits.h5")  # the note of a fit names the cause, too
    assert verdict in found.fits.notes[0]
    assert message(verdict) in found.fits.notes[0]


def test_a_fit_that_knows_its_driver_says_why_it_failed(records):
    calibration, skin = records
    driver = etid.identify_driver(calibration.replace(r_load=98.8), throw=False)
    with pytest.raises(etid.IdentificationError, match=r"Its driver: implausible\. ") as raised:
        etid.identify_skin(skin, driver)
    assert "With r_load 98.8 ohm" in str(raised.value.outcome)
