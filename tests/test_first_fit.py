"""From the files of a laboratory to a first fit: the commands of the guide."""

import ast
import pathlib
import re
import shlex

import numpy as np
import pytest

import etid
from etid import cli

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "first_fit.md"
DAMP = {"r_s": 6.1e3, "r_p": 17.4e3, "c_p": 0.66e-9}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finger and two resistors, each in a CSV table of volts with two columns."""
    from etid.simulation.scenes import Scene, Trial
    from etid.simulation.transformer import ResistorLoad, SkinLoad

    scene = Scene(
        (Trial("finger", SkinLoad(**DAMP)),),
        (Trial("calib", ResistorLoad(98.8e3)), Trial("calib2", ResistorLoad(21.62e3))),
        bits=None,
    )
    folder = tmp_path_factory.mktemp("lab")
    for path, one in scene.simulate(seed=4).items():
        table = np.column_stack([one.v_th, one.v_out])
        np.savetxt(folder / f"{path}.csv", table, "%.9g", ",", header="open,out", comments="")
    return folder


def test_the_commands_of_the_guide_lead_to_a_fit(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    commands = re.findall(r"^etid ((?:.*\\\n)*.*)", PAGE.read_text("utf-8"), flags=re.MULTILINE)
    assert [command.split()[0] for command in commands] == ["import", "fit"]
    for command in commands:
        assert cli.main(shlex.split(command.replace("\\\n", " "))) == 0, capsys.readouterr().err
    fit = etid.Fits.read("fits.h5")[0]
    assert fit.verdict == "successful"
    for name, truth in DAMP.items():  # five standard errors: 1 in 10⁶ by chance
        assert abs(getattr(fit.circuit, name) - truth) < 5 * getattr(fit.stderr, name)


def test_files_are_named_by_their_stems_and_name_their_calibrations(folder, tmp_path):
    target = tmp_path / "study.h5"
    given = {"v_th": "open", "v_out": "out", "sample_rate": 2e5, "pulse_rate": 60.0, "scale": 1.0}
    files = {folder / "calib.csv": 98.8e3, folder / "calib2.csv": 21.62e3}
    etid.import_file(folder / "finger.csv", target, calibrations=files, **given)
    with etid.read(target) as study:
        names = ("calibration/calib", "calibration/calib2")
        assert set(study) == {*names, "loaded/finger"}
        assert study["loaded/finger"].calibration == names
        assert [study[name].r_load for name in names] == [98.8e3, 21.62e3]
        assert not np.array_equal(study[names[0]].v_th, study[names[1]].v_th)
    with pytest.raises(etid.RecordingError, match="together with a mapping"):
        etid.import_file(folder / "finger.csv", target, {}, calibrations=files)


@pytest.mark.parametrize(
    ("head", "row", "encoding", "flags"),
    [
        ("open;out\n", "{};{}\n", "utf-8", "--delimiter ';'"),
        ("Zeit µs;a\n\nopen;out\n", "{};{}\n", "cp1252", "--header-line 3 --encoding 'cp1252'"),
        ('"Model","TBS1052B"\nopen,out\n(V),(V)\n', "{},{}\n", "utf-8", "--header-line 2"),
        ("open\tout\n", "{}\t{}\n", "utf-16", "--delimiter '\\t' --encoding 'utf-16'"),
        ("open;out\n", "C{};{}\n", "utf-8", "--delimiter ';' --decimal ','"),
    ],
)
def test_another_dialect_is_shown_and_confirmed_by_flags(head, row, encoding, flags, tmp_path):
    values = np.random.default_rng(0).normal(size=(500, 2))
    text = head + "".join(row.replace("C", "").format(*pair) for pair in values.tolist())
    if "C" in row:
        text = text.replace(".", ",")
    file, target = tmp_path / "t.csv", tmp_path / "t.h5"
    file.write_text(text, encoding=encoding)
    given = {"v_th": "open", "v_out": "out", "sample_rate": 2e5, "pulse_rate": 60.0, "scale": 1.0}
    with pytest.raises(etid.RecordingError, match="Nothing is guessed") as caught:
        etid.import_file(file, target, **given)
    assert flags in str(caught.value)
    found = re.findall(r"--([a-z-]+) ('[^']*'|\d+)", str(caught.value))
    told = {name.replace("-", "_"): ast.literal_eval(value) for name, value in found}
    etid.import_file(file, target, **given, **told)
    with etid.read(target) as study:
        np.testing.assert_allclose(study["loaded/0"].v_out, values[:, 1], rtol=1e-12)


def test_a_calibration_is_not_split_as_the_trials_are(folder, tmp_path):
    target, table = tmp_path / "study.h5", np.genfromtxt(folder / "finger.csv", delimiter=",")[1:]
    rest, trigger = np.zeros((4000, 3)), np.arange(len(table)) < 100
    trial = np.column_stack([table, 5.0 * trigger])
    np.savetxt(
        tmp_path / "long.csv",
        np.concatenate([rest, trial, rest, trial, rest]),
        "%.9g",
        ",",
        header="open,out,trigger",
        comments="",
    )
    given = {"v_th": "open", "v_out": "out", "sample_rate": 2e5, "pulse_rate": 60.0, "scale": 1.0}
    for split in ("pulses", "trigger"):
        calibrations = {folder / "calib.csv": 98.8e3}
        etid.import_file(
            tmp_path / "long.csv", target, calibrations=calibrations, split=split, **given
        )
        with etid.read(target) as study:
            assert set(study) == {"calibration/calib", "loaded/long/0", "loaded/long/1"}
            assert study["loaded/long/1"].periods == pytest.approx(3, abs=1e-3)


MAPPING = """
v_th = {channel = "open", unit = "V"}
v_out = {channel = "out", unit = "V"}
pulse_rate = 60.0
sample_rate = 200e3
scale = 1.0
[[recording]]
file = "finger.csv"
subject = "s01"
[[recording]]
file = "calib.csv"
r_load = 98.8e3
"""


def test_a_mapping_describes_several_files(folder, tmp_path):
    target, mapping = tmp_path / "study.h5", tmp_path / "lab.toml"
    mapping.write_text(MAPPING, encoding="utf-8")
    etid.import_file([folder / "finger.csv", folder / "calib.csv"], target, mapping)
    with etid.read(target) as study:
        assert set(study) == {"calibration/calib", "loaded/finger"}
        assert study["loaded/finger"].subject == "s01"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "calib.csv"', 'file = "other.csv"', "file: is 'other.csv'; the files are 'fing"),
        ('file = "calib.csv"\n', "", "file: is None; .* Give each .*recording.* the name of one"),
        ('file = "calib.csv"', 'file = "finger.csv"', "no recording is in 'calib.csv'"),
        ('file = "calib.csv"', 'file = "calib.csv"\npath = "loaded/finger"', "has this path"),
    ],
)
def test_a_mapping_that_does_not_fit_its_files_is_explained(old, new, message, folder, tmp_path):
    mapping = tmp_path / "lab.toml"
    mapping.write_text(MAPPING.replace(old, new), encoding="utf-8")
    files = [folder / "finger.csv", folder / "calib.csv"]
    with pytest.raises(etid.RecordingError, match=message):
        etid.import_file(files, tmp_path / "study.h5", mapping)
    assert not (tmp_path / "study.h5").exists()
