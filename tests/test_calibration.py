import dataclasses
import hashlib

import jax
import numpy as np
import pytest

import etid
from etid.cli import main
from etid.commands import calibrate as command
from etid.simulation.calibration import MORE, MOST, NOW
from etid.simulation.scenes import Trial
from etid.simulation.transformer import ResistorLoad


@pytest.fixture(scope="module")
def scene():
    return etid.scenes.paper_dry(snr_db=60.0)


@pytest.fixture(scope="module")
def study(scene):
    return scene.simulate(seed=0)


@pytest.fixture(scope="module")
def today(study):
    return etid.calibrate(study["calibration/98k8"])


def stderrs(fit):
    values = np.array(fit.circuit.values())
    return dict(zip(fit.circuit.names(), np.sqrt(np.diagonal(fit.cov)) / values, strict=True))


@pytest.mark.slow
def test_the_worth_of_a_second_resistor_is_that_of_a_real_one(scene, study):
    today = etid.calibrate(study["calibration/98k8"])
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
    # Half as large, but for what the weak prior of Z_th already tells at this noise.
    half = {name: error / 2 for name, error in today.expected[skin][NOW].items()}
    assert today.expected[skin][MORE] == pytest.approx(half, rel=0.05)


def test_the_same_driver_on_another_day_has_not_moved_and_a_wrong_resistor_is_named(scene, today):
    day = scene.simulate(seed=5)["calibration/98k8"]
    again = etid.calibrate(day, former=today.driver)
    assert again.moved < 4
    assert "differs from the former driver by" in str(again)
    assert "would be wrong" not in str(again)
    found = etid.calibrate(day.replace(r_load=93.9e3), former=today.driver)
    assert found.moved > 100
    assert found.r_load == pytest.approx(98.8e3, rel=1e-3)
    assert "a resistor of 98.8 kΩ in place of 93.9 kΩ would explain it" in str(found)
    assert found.shifts["dry"]["r_p"] == pytest.approx(98.8 / 93.9 - 1, rel=0.05)


def test_skin_in_place_of_the_resistor_is_no_other_resistor(scene, today):
    skin = scene.simulate(seed=5)["typical/dry/02"].replace(r_load=98.8e3, calibration=())
    found = etid.calibrate(skin, former=today.driver)
    assert found.moved > 100
    assert found.r_load is None
    assert "no other resistor explains it: were 98.8 kΩ connected" in str(found)


def test_the_line_on_what_helps_is_that_of_the_least_known_element(today):
    names = "r_s", "r_p", "c_p"
    known = {"dry": {NOW: (0.02, 0.001, 0.001), MORE: (0.01, 5e-4, 5e-4)}}
    known["damp"] = {
        NOW: (0.031, 0.01, 0.01),
        MORE: (0.0155, 5e-3, 5e-3),
        "also with 10 kΩ": (0.008, 0.009, 0.01),
    }
    by_skin = {
        skin: {what: dict(zip(names, errors, strict=True)) for what, errors in by.items()}
        for skin, by in known.items()
    }
    text = str(dataclasses.replace(today, expected=by_skin, times=9.6))
    words = "least known is r_s of damp skin, ± 3.1 %; what helps most: also with 10 kΩ, ± 0.8 %"
    assert words in text
    assert "1 % takes 10 times as many periods" in text
    text = str(dataclasses.replace(today, expected=by_skin, times=np.inf))
    assert f"not even {MOST:g} times as many periods make it 1 %" in text


def test_the_command_writes_a_driver_and_a_picture(study, today, tmp_path, capsys, monkeypatch):
    source, driver, picture = (tmp_path / name for name in ("study.h5", "driver.h5", "z.svg"))
    study.write(source)
    formers, orders = [], []

    def fake(_, *, order, former):
        orders.append(order)
        formers.append(former)
        return today

    monkeypatch.setattr(command, "calibrate", fake)
    assert main(["calibrate", str(source), "-o", str(driver), "--picture", str(picture)]) == 0
    assert "standard errors to expect of typical skin" in capsys.readouterr().out
    assert picture.read_text("utf-8").lstrip().startswith("<?xml")
    again = tmp_path / "again.h5"
    command_line = ["calibrate", str(driver), "-o", str(again), "--former", str(driver)]
    assert main([*command_line, "--order", "4"]) == 0
    assert orders == [5, 4]
    frequency = np.geomspace(100.0, 80e3, 20)
    assert formers[0] is None
    of_4 = etid.identify_driver(study["calibration/98k8"], order=4).response(frequency)
    np.testing.assert_array_equal(formers[1].response(frequency), of_4)
    etid.Study.from_recordings([study["typical/dry/01"].replace(calibration=())]).write(source)
    assert main(["calibrate", str(source), "-o", str(tmp_path / "none.h5")]) == 1
    assert "holds no recording with a known resistor" in capsys.readouterr().err


def test_calibrations_that_are_given_twice_are_named_by_their_files(study, tmp_path, capsys):
    files = [tmp_path / "a.h5", tmp_path / "b.h5"]
    for file in files:
        study.write(file)
    assert main(["calibrate", *map(str, files), "-o", str(tmp_path / "driver.h5")]) == 1
    place = "{}:calibration/98k8".format
    words = f"{place(files[1])}: has the same samples as {place(files[0])}. Pass each"
    assert words in capsys.readouterr().err


def test_a_driver_is_written_with_its_calibrations_and_read_again(study, tmp_path):
    calibration = study["calibration/98k8"]
    driver = etid.identify_driver(calibration, method="steiglitz_mcbride", throw=False)
    driver.write(tmp_path / "driver.h5")
    with etid.read(tmp_path / "driver.h5") as written:
        [stored] = written.calibrations.recordings()
    np.testing.assert_array_equal(stored.v_out, calibration.v_out)
    again = etid.read_driver(tmp_path / "driver.h5", order=5)
    known = etid.identify_driver(calibration)
    np.testing.assert_array_equal(again.response(np.array([1e3])), known.response(np.array([1e3])))
    mapped = jax.tree.map(lambda leaf: leaf, driver)
    with pytest.raises(ValueError, match=r"write the one that etid\.identify_driver"):
        mapped.write(tmp_path / "mapped.h5")


def test_a_file_is_fitted_with_the_driver_of_another(scene, today, tmp_path, capsys):
    source, driver, fits = (tmp_path / name for name in ("day.h5", "driver.h5", "fits.h5"))
    today.driver.write(driver)
    day = [one for one in scene.simulate(seed=3).loaded.recordings()][:3]
    etid.Study.from_recordings(one.replace(calibration=()) for one in day).write(source)
    assert main(["fit", str(source), "--driver", str(driver), "-o", str(fits)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"driver.h5/calibration/98k8 {today.driver.order} successful" in printed
    found = etid.StudyFits.read(fits)
    assert list(found.drivers) == [("driver.h5/calibration/98k8",)]
    assert found.settings is not None
    assert found.settings.driver == str(driver)
    assert found.settings.source_sha256 == hashlib.sha256(source.read_bytes()).hexdigest()
    expected = etid.identify_skins(day, today.driver)
    np.testing.assert_allclose(found.fits.circuit.r_p, expected.circuit.r_p, rtol=1e-6)
    assert main(["report", str(fits), "-o", str(tmp_path / "page.html")]) == 0
    assert "hold no driver" not in (tmp_path / "page.html").read_text("utf-8")
    with etid.read(source) as study:
        assert not study.calibrations


def two_sessions(study):
    first = study["calibration/98k8"]
    return [first.replace(path=f"calibration/{day}", session=day) for day in ("d1", "d2")]


def two_named(study):
    first = study["calibration/98k8"]
    known = [first.replace(path=f"calibration/{day}") for day in ("d1", "d2")]
    skin = study["typical/dry/01"]
    return known + [
        skin.replace(path=f"loaded/{one.path[-2:]}", calibration=(one.path,)) for one in known
    ]


@pytest.mark.parametrize(
    ("held", "options", "message"),
    [
        (lambda study: [study["typical/dry/01"].replace(calibration=())], [], "no recording with"),
        (two_sessions, [], "holds calibrations of sessions d1, d2. Write those of one"),
        (two_named, [], "holds calibrations of several drivers"),
        (None, [], "there is no such file"),
        (lambda study: [study["calibration/98k8"]], ["--joint"], "remove --driver, or --joint"),
        (
            lambda study: [study["calibration/98k8"]],
            ["--method", "steiglitz_mcbride", "--order", "auto"],
            "order 'auto' needs maximum likelihood",
        ),
    ],
)
def test_refusals_of_the_driver_of_another_file(study, tmp_path, capsys, held, options, message):
    driver = tmp_path / "driver.h5"
    study.write(tmp_path / "day.h5")
    if held is not None:
        etid.Study.from_recordings(held(study)).write(driver)
    command = ["fit", str(tmp_path / "day.h5"), "--driver", str(driver)]
    assert main([*command, "-o", str(tmp_path / "fits.h5"), *options]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "fits.h5").exists()


def test_a_discrete_driver_of_another_sample_rate_is_refused_for_each_recording(study, tmp_path):
    known = study["calibration/98k8"]
    slower = {"v_th": known.v_th[::2], "v_out": known.v_out[::2], "adc_range": None}
    slow = known.replace(**slower, sample_rate=known.sample_rate / 2)
    etid.Study.from_recordings([slow]).write(tmp_path / "driver.h5")
    study.write(tmp_path / "day.h5")
    options = {"driver": tmp_path / "driver.h5", "order": 5, "method": "steiglitz_mcbride"}
    found = etid.fit_file(tmp_path / "day.h5", tmp_path / "fits.h5", **options)
    assert not found.fits.counts().get("successful")
    assert "same sample rate" in found.fits.notes[0]
