import dataclasses

import numpy as np
import pytest

import etid
from etid.cli import main
from etid.commands import calibrate as command
from etid.simulation import calibration
from etid.simulation.calibration import MORE, NOW
from etid.simulation.scenes import Trial
from etid.simulation.transformer import ResistorLoad


@pytest.fixture(scope="module")
def scene():
    return etid.scenes.paper_dry(snr_db=60.0)


@pytest.fixture(scope="module")
def without_further():
    """Another resistor is not tried."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "_with_resistor", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def today(scene, without_further):
    return etid.calibrate(scene.simulate(seed=0)["calibration/98k8"])


def stderrs(fit):
    values = np.array(fit.circuit.values())
    return dict(zip(fit.circuit.names(), np.sqrt(np.diagonal(fit.cov)) / values, strict=True))


@pytest.mark.slow
def test_the_worth_of_a_second_resistor_is_that_of_a_real_one(scene):
    today = etid.calibrate(scene.simulate(seed=0)["calibration/98k8"])
    second = Trial("calibration/10k", ResistorLoad(10e3))
    both = dataclasses.replace(scene, calibration=(*scene.calibration, second)).simulate(seed=4)
    driver = etid.identify_driver([*both.calibrations.recordings()], order=today.driver.order)
    found = stderrs(etid.identify_skin(both["typical/dry/02"], driver))
    assert today.expected["dry"]["also with 10 kΩ"] == pytest.approx(found, rel=0.15)
    assert found["c_p"] < 0.9 * today.expected["dry"][NOW]["c_p"]


@pytest.mark.parametrize("skin", ["dry", "damp"])
def test_expected_errors_are_those_of_recordings_of_skin(today, skin):
    study = getattr(etid.scenes, f"paper_{skin}")(snr_db=60.0).simulate(seed=3)
    found = stderrs(etid.identify_skin(study[f"typical/{skin}/02"], today.driver))
    # The noise of each record is estimated to 5 %, and that of the calibration is in both.
    assert today.expected[skin][NOW] == pytest.approx(found, rel=0.15)
    half = {name: error / 2 for name, error in today.expected[skin][NOW].items()}
    assert today.expected[skin][MORE] == pytest.approx(half)


def test_the_same_driver_on_another_day_has_not_moved(scene, today):
    again = etid.calibrate(scene.simulate(seed=5)["calibration/98k8"], former=today.driver)
    assert again.moved < 4
    assert "differs from the former driver by" in str(again)
    assert "would be wrong" not in str(again)


def test_a_wrong_resistor_is_named(scene, today):
    wrong = scene.simulate(seed=5)["calibration/98k8"].replace(r_load=93.9e3)
    found = etid.calibrate(wrong, former=today.driver)
    assert found.moved > 100
    assert found.r_load == pytest.approx(98.8e3, rel=1e-3)
    assert "a resistor of 98.8 kΩ in place of 93.9 kΩ would explain it" in str(found)
    assert found.shifts["dry"]["r_p"] == pytest.approx(98.8 / 93.9 - 1, rel=0.05)


def test_the_command_writes_a_driver_and_a_picture(scene, today, tmp_path, capsys, monkeypatch):
    study, driver, picture = (tmp_path / name for name in ("study.h5", "driver.h5", "z.svg"))
    scene.simulate(seed=0).write(study)
    formers = []
    monkeypatch.setattr(command, "calibrate", lambda _, former: formers.append(former) or today)
    assert main(["calibrate", str(study), "-o", str(driver), "--picture", str(picture)]) == 0
    assert "standard errors to expect of skin" in capsys.readouterr().out
    assert picture.read_text("utf-8").lstrip().startswith("<?xml")
    again = tmp_path / "again.h5"
    assert main(["calibrate", str(driver), "-o", str(again), "--former", str(driver)]) == 0
    frequency = np.geomspace(100.0, 80e3, 20)
    assert formers[0] is None
    np.testing.assert_array_equal(formers[1].response(frequency), today.driver.response(frequency))


def test_a_file_without_calibrations_is_refused(scene, tmp_path, capsys):
    study = tmp_path / "study.h5"
    skin = scene.simulate(seed=0)["typical/dry/01"].replace(calibration=())
    etid.Study.from_recordings([skin]).write(study)
    assert main(["calibrate", str(study), "-o", str(tmp_path / "driver.h5")]) == 1
    assert "holds no recording with a known resistor" in capsys.readouterr().err
