import numpy as np
import pytest

import etid
from etid.cli import main
from etid.files.folder import import_folder
from etid.files.importing import import_file
from etid.files.labels import labelled
from etid.files.pattern import pattern
from etid.recordings.recording import RecordingError
from etid.recordings.resistance import resistance

OPTIONS = {"v_th": "open", "v_out": "skin", "time": "t", "scale": 0.5, "pulse_rate": 60.0}
PATTERNS = ("{session}_cal_{r_load}.csv", "{subject}_{session}_{trial}.csv")


def pulses(size):
    return np.where(np.arange(1000) % 300 < 100, size, 0.0)


@pytest.fixture
def folder(tmp_path):
    """Two days with a calibration each, a recording each, and a file that is something else."""
    root = tmp_path / "folder"
    root.mkdir()
    for number, day in enumerate(("d1", "d2")):
        for name, part in ((f"{day}_cal_98k8", 0.5), (f"s01_{day}_07", 0.3 + 0.1 * number)):
            table = np.column_stack([np.arange(1000) / 18e3, pulses(1.0), pulses(part)])
            np.savetxt(
                root / f"{name}.csv", table, delimiter=",", header="t,open,skin", comments=""
            )
    (root / "notes.txt").write_text("cold hands", "utf-8")
    return root


def test_names_become_labels_and_the_mapping_beside_the_file_imports_the_same(folder, tmp_path):
    target = tmp_path / "study.h5"
    found = import_folder(folder, target, PATTERNS, **OPTIONS)
    import_file(folder, tmp_path / "again.h5", found.mapping)
    assert target.read_bytes() == (tmp_path / "again.h5").read_bytes()
    assert found.unmatched == ["notes.txt"]
    assert "4 files, 2 of them with a known resistor" in str(found)
    assert "s01_d2_07.csv → s01/d2/07: subject s01, session d2, trial 07" in str(found)
    with etid.read(target) as study:
        assert [one.r_load for one in study.calibrations.recordings()] == [98.8e3] * 2
        second = study["s01/d2/07"]
        assert (second.subject, second.session, second.trial) == ("s01", "d2", "07")
        assert second.calibration == ("calibration/d2/98800",)
        np.testing.assert_allclose(second.v_out, 2 * pulses(0.4))


def test_each_file_has_its_own_units_and_notes(folder, tmp_path):
    known, other = folder / "d1_cal_98k8.csv", folder / "s01_d1_07.csv"
    known.write_text(known.read_text("utf-8").replace("skin", "skin [mV]"), "utf-8")
    other.write_text(other.read_text("utf-8")[:-5], "utf-8")
    found = import_folder(folder, tmp_path / "study.h5", PATTERNS, **OPTIONS)
    lines = str(found).splitlines()
    (note,) = (i for i, line in enumerate(lines) if "the file may have been cut off" in line)
    assert lines[note - 1].startswith("s01_d1_07.csv → ")
    assert "  v_out   'skin' in mV (file), divided by 0.5: 'd1_cal_98k8.csv'" in lines
    assert "  v_th    'open' in V (command), divided by 0.5" in lines
    import_file(folder, tmp_path / "again.h5", found.mapping)
    assert (tmp_path / "study.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()


def test_the_command_replaces_no_mapping_unasked(folder, tmp_path, capsys):
    (tmp_path / "study.toml").write_text("mine", "utf-8")
    words = ["import", str(folder), "-o", str(tmp_path / "study.h5"), "--labels", PATTERNS[0]]
    assert main([*words, "--labels", PATTERNS[1]]) == 1
    assert "study.toml: this file exists; add --force" in capsys.readouterr().err
    options = [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    assert main([*words, "--labels", PATTERNS[1], *options, "--force"]) == 0
    assert "left out, matches no pattern: notes.txt" in capsys.readouterr().out


def test_the_command_imports_a_folder_by_the_mapping_that_another_has_left(folder, tmp_path):
    found = import_folder(folder, tmp_path / "study.h5", PATTERNS, **OPTIONS)
    assert found.mapping == tmp_path / "study.toml"
    words = ["import", str(folder), "-o", str(tmp_path / "again.h5")]
    assert main([*words, "--mapping", str(found.mapping)]) == 0
    assert (tmp_path / "study.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()


def test_a_table_names_resistors_of_files_whose_names_do_not(folder):
    (folder / "calibrations.csv").write_text("file, ohm\nd1_cal_98k8.csv, 21k62\n", "utf-8")
    found, unmatched = labelled(folder, ["{subject}_{session}_{trial}.csv"])
    assert found["d1_cal_98k8.csv"]["r_load"] == 21.62e3
    assert unmatched == ["notes.txt"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("d1_cal_98k8.csv, 98800\nd1_cal_98k8.csv, 21k62", "file: lists 'd1_cal_98k8.csv' twice"),
        ("d1_cal_98k8.csv, 21k62", "ohm: says 21620 ohm of 'd1_cal.*', whose name says 98800 ohm"),
        ("s01_d1_07.csv, 98.8 kOhm", r"ohm: is '98.8 kOhm'.* Write it as 98800, 98k8 or 98.8k\.$"),
    ],
)
def test_refusals_of_the_table_of_resistors(folder, rows, message):
    (folder / "calibrations.csv").write_text(f"file, ohm\n{rows}\n", "utf-8")
    with pytest.raises(RecordingError, match=rf"calibrations\.csv, {message}"):
        labelled(folder, PATTERNS)


def test_a_name_that_could_be_read_in_two_ways_does_not_match():
    expression = pattern("{subject}_{condition}_{trial}.csv")
    match = expression.fullmatch("s01_dry_3.csv")
    assert match is not None
    assert match.groupdict() == {"subject": "s01", "condition": "dry", "trial": "3"}
    for name in (
        "s01_dry_wet_3.csv",  # which of them is the condition?
        "s01_dry_3.1.csv",
        "x/s01_dry_3.csv",
        "s01_dry_3.csv.bak",
        "s01__3.csv",
    ):
        assert expression.fullmatch(name) is None, name


def test_a_label_may_contain_the_letters_of_the_text_before_it():
    match = pattern("day-{subject}_{trial}.csv").fullmatch("day-anna_3.csv")
    assert match is not None
    assert match.groupdict() == {"subject": "anna", "trial": "3"}


def test_resistances_are_written_as_in_electronics():
    texts = {"98800": 98.8e3, "98k8": 98.8e3, "98.8k": 98.8e3, "4R7": 4.7, "1M": 1e6}
    assert {text: resistance(text) for text in texts} == pytest.approx(texts)


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        (["{subjekt}_{trial}.csv"], "subjekt: is no label, did you mean subject"),
        (["{subject}{trial}.csv"], "no text between two labels"),
        (["{trial}_{trial}.csv"], "a label twice"),
        (["all.csv"], "has no label"),
        (["{subject}.mat"], r"none of its 6 files matches '{subject}.mat'.*'d1_cal_98k8.csv'"),
        (["{subject}_{r_load}_{trial}.csv"], "r_load: is 'cal', which is no resistance"),
        (["s01_{session}_{trial}.csv", "d1_{session}_{r_load}.csv"], "no calibration has its"),
    ],
)
def test_refusals_of_a_folder(folder, tmp_path, patterns, message):
    (folder / "other.txt").write_text("", "utf-8")
    with pytest.raises(RecordingError, match=message):
        import_folder(folder, tmp_path / "study.h5", patterns, **OPTIONS)


ARRAY = {"v_th": "open", "v_out": "CH{electrode}", "sample_rate": 18e3, "pulse_rate": 60.0}


def array(path, *electrodes, part=0.1):
    """A file with a channel for each electrode, whose number times `part` is its voltage."""
    table = np.column_stack([pulses(1.0), *(pulses(part * n) for n in electrodes)])
    header = ",".join(["open", *(f"CH{n}" for n in electrodes)])
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    return path


def test_each_channel_of_an_array_becomes_the_recording_of_an_electrode(tmp_path):
    source, target = array(tmp_path / "array.csv", 1, 2, 3), tmp_path / "study.h5"
    import_file(source, target, subject="s01", scale=1.0, **ARRAY)
    with etid.read(target) as study:
        assert [one.electrode for one in study.recordings()] == ["1", "2", "3"]
        np.testing.assert_allclose(study["loaded/3"].v_out, pulses(0.3))
    with pytest.raises(RecordingError, match=r"no channel matches 'E\{electrode\}'"):
        import_file(source, target, scale=1.0, **{**ARRAY, "v_out": "E{electrode}"})
    import_file([source, array(tmp_path / "more.csv", 1)], target, scale=1.0, **ARRAY)
    with etid.read(target) as study:
        assert list(study) == [*(f"loaded/array/{n}" for n in (1, 2, 3)), "loaded/more/1"]


@pytest.mark.parametrize(
    ("electrodes", "own"), [((), ()), ((1, 2), ("98800/1", "98800/2")), ((2,), ("98800/2",) * 2)]
)
def test_each_electrode_of_an_array_gets_its_own_calibration_or_the_only_one(
    electrodes, own, tmp_path
):
    root, target, again = tmp_path / "folder", tmp_path / "study.h5", tmp_path / "again.h5"
    root.mkdir()
    skin, known = array(root / "s01_07.csv", 1, 2), {}
    if electrodes:
        known[array(root / "cal_98k8.csv", *electrodes)] = 98.8e3
    patterns = ("cal_{r_load}.csv", "{subject}_{trial}.csv")
    found = import_folder(root, target, patterns, scale=1.0, **ARRAY)
    assert "s01_07.csv → s01/07/1 … s01/07/2: subject s01, trial 07; 1000 samples" in str(found)
    import_file(root, again, found.mapping)
    assert target.read_bytes() == again.read_bytes()
    import_file([skin, *known], again, calibrations=known, scale=1.0, **ARRAY)
    with etid.read(target) as study, etid.read(again) as files:
        named = [one.calibration for one in study.loaded.recordings()]
        assert named == ([(f"calibration/{path}",) for path in own] or [(), ()])
        by_name = [one.calibration for one in files.loaded.recordings()]
        assert by_name == [tuple(n.replace("98800", "cal_98k8") for n in of) for of in named]


def test_an_electrode_without_a_calibration_among_several_is_refused(tmp_path):
    array(tmp_path / "cal_98k8.csv", 1, 2)
    array(tmp_path / "s01_07.csv", 1, 3)
    patterns = ("cal_{r_load}.csv", "{subject}_{trial}.csv")
    message = (
        "s01_07.csv, 's01/07/3', calibration: none of the 2 calibrations in 'calibration/98800'"
        " has its electrode '3'"
    )
    with pytest.raises(RecordingError, match=message):
        import_folder(tmp_path, tmp_path / "study.h5", patterns, scale=1.0, **ARRAY)
    assert not (tmp_path / "study.h5").exists()


def channel(path, name, *columns):
    """A file with one channel, or several."""
    names = name.split(",")
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=",".join(names), comments="")


ONE = {"v_out": "CH2", "sample_rate": 18e3, "pulse_rate": 60.0, "scale": 1.0}


@pytest.fixture
def apart(tmp_path):
    """A folder with V_th in files of its own: one for all, and one for each trial."""
    root = tmp_path / "apart"
    root.mkdir()
    channel(root / "open.csv", "CH1", pulses(9.0))
    for trial, height in (("1", 1.0), ("2", 2.0)):
        channel(root / f"open_{trial}.csv", "CH1", pulses(height))
        channel(root / f"skin_{trial}.csv", "CH2", pulses(height / 2))
    channel(root / "open_98k8.csv", "CH1", pulses(4.0))
    channel(root / "cal_98800.csv", "CH2", pulses(3.0))
    return root


def test_v_th_of_all_trials_may_be_a_file_of_the_folder(apart, tmp_path, monkeypatch):
    target, again = tmp_path / "study.h5", tmp_path / "again.h5"
    patterns = ["skin_{trial}.csv", "cal_{r_load}.csv"]
    found = import_folder(apart, target, patterns, v_th="open.csv:CH1", **ONE)
    assert found.unmatched == ["open_1.csv", "open_2.csv", "open_98k8.csv"]
    with etid.read(target) as study:
        assert {one.v_th.max() for one in study.recordings()} == {9.0}
        assert study["loaded/2"].v_out.max() == 1.0
    import_file(apart, again, found.mapping)
    assert target.read_bytes() == again.read_bytes()
    # A path from the current folder names the same file.
    monkeypatch.chdir(tmp_path)
    found = import_folder(apart, again, patterns, v_th="apart/open.csv:CH1", **ONE)
    assert found.unmatched == ["open_1.csv", "open_2.csv", "open_98k8.csv"]
    channel(tmp_path / "open.csv", "CH1", pulses(8.0))
    with pytest.raises(
        RecordingError, match=r"there is a file 'open\.csv' in the folder .* and in"
    ):
        import_folder(apart, again, patterns, v_th="open.csv:CH1", **ONE)


def test_v_th_may_have_a_file_for_each_trial_and_resistor(apart, tmp_path):
    target, again = tmp_path / "study.h5", tmp_path / "again.h5"
    words = ["import", str(apart), "-o", str(target), "--v-th", "open_{trial}.csv:CH1"]
    words += ["--labels", "cal_{r_load}.csv", "--labels", "{condition}_{trial}.csv"]
    options = [f"--{name.replace('_', '-')}={value}" for name, value in ONE.items()]
    assert main([*words, *options]) == 0
    with etid.read(target) as study:
        heights = {path: (one.v_th.max(), one.v_out.max()) for path, one in study.items()}
    assert heights == {
        "calibration/98800": (4.0, 3.0), "skin/1": (1.0, 0.5), "skin/2": (2.0, 1.0),
    }  # fmt: skip
    import_file(apart, again, target.with_suffix(".toml"))
    assert target.read_bytes() == again.read_bytes()


@pytest.mark.parametrize(
    ("v_th", "patterns", "message"),
    [
        ("open_{subject}.csv:CH1", "skin_{trial}.csv", "has the subject of this file, whose name"),
        ("opn_{trial}.csv:CH1", "skin_{trial}.csv", "v_th: no file of the folder matches 'opn_"),
        ("opn.csv:CH1", "skin_{trial}.csv", "v_th: there is no file 'opn.csv' in the folder"),
        ("open.csv:CH3", "skin_{trial}.csv", "there is no 'open.csv:CH3'; the names are 'CH2', 'o"),
        ("open_{trail}.csv:CH1", "skin_{trial}.csv", "trail: is no label, did you mean trial"),
    ],
)
def test_refusals_of_a_further_file(v_th, patterns, message, apart, tmp_path):
    with pytest.raises(RecordingError, match=message) as caught:
        import_folder(apart, tmp_path / "study.h5", patterns, v_th=v_th, **ONE)
    assert caught.value.remedy
    assert not (tmp_path / "study.h5").exists()


def test_a_single_file_does_not_fill_in_labels(apart, tmp_path):
    for v_th, remedy in (("open_{trial}.csv:CH1", "for a folder, with --labels"), ("a.csv:b", "")):
        with pytest.raises(RecordingError, match=rf"there is no file .* current folder.*{remedy}"):
            import_file(apart / "skin_1.csv", tmp_path / "study.h5", v_th=v_th, **ONE)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ([], "is a folder; a pattern must say what the names of its files mean. Name their labels"),
        (
            ["--labels", "{trial}.csv", "--calibration", "a.csv", "98k8"],
            "a folder is imported alone",
        ),
    ],
)
def test_the_command_says_what_a_folder_needs(more, message, folder, tmp_path, capsys):
    assert main(["import", str(folder), "-o", str(tmp_path / "a.h5"), *more]) == 1
    assert message in capsys.readouterr().err
