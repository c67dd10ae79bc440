import json

import numpy as np
import pytest
import scipy.io

from etid.files.importing import import_file
from etid.recordings import hdf5
from etid.recordings.recording import RecordingError
from tests import lab_files
from tests.lab_files import matlab

TABLE = {"v_th": "th", "v_out": "out", "sample_rate": 200e3, "pulse_rate": 60.0, "scale": 0.0535}
TH = np.array([0.0, 0.25, 2.5, 2.25, 0.0])


def imported(source, **arguments):
    return lab_files.imported(source, **arguments)[0]


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "one.csv"
    rows = [f"{n / 200e3!r},{v!r},{v / 2!r},{v / 1e3!r}" for n, v in enumerate(TH.tolist())]
    path.write_text("\n".join(["t,th, out,i", *rows, ""]), encoding="utf-8")
    return path


def test_all_reference_scenes_become_the_volts_of_their_own_formula(reference_data, tmp_path):
    folder = reference_data("spice_recordings")
    scenes = json.loads((folder / "truth.json").read_text("utf-8"))["scenes"]
    assert len(scenes) == 18
    for name, truth in scenes.items():
        target = tmp_path / "scene.h5"
        import_file(folder / f"{name}.npz", target)
        assert hdf5.check(target) == []
        with np.load(folder / f"{name}.npz") as raw, hdf5.read(target) as study:
            assert len(study.loaded) == len(truth["trials"])
            assert [one.r_load for one in study.calibrations.recordings()] == truth["R_ref"]
            volts = raw["lsb"] / raw["scale"]
            for trial, one in enumerate(study.loaded.recordings()):
                assert one.path == f"loaded/{trial}"
                assert one.calibration == tuple(study.calibrations)
                assert one.sample_rate == truth["fs"]
                assert (one.condition, one.trial) == (name, str(trial))
                assert one.samples["v_out"].stored.dtype == np.int16
                assert one.samples["v_th"].resolution == volts
                assert one.adc_range == (-32768 * volts, 32767 * volts)
                np.testing.assert_array_equal(one.v_th, raw["adc_th"][trial] * volts)
                np.testing.assert_array_equal(one.v_out, raw["adc_out"][trial] * volts)
            first = study["calibration/0"]
            np.testing.assert_array_equal(first.samples["v_out"].stored, raw["adc_ref"][0])
            np.testing.assert_array_equal(first.samples["v_th"].stored, raw["adc_th"][0])


def archive(path, **changes):
    content = {
        "adc_th": np.arange(12, dtype="i2").reshape(2, 6),
        "adc_out": np.arange(12, dtype="i2").reshape(2, 6),
        "adc_ref": np.arange(6, dtype="i2").reshape(1, 6),
        "R_ref": [98.8e3],
        "fs": 200e3,
        "f0": 60.0,
        "scale": 0.0535,
        "lsb": 1e-3,
    }
    content |= changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"adc_ref": None}, r"adc_ref: there is no 'adc_ref'; the names are 'adc_th', 'adc_out'"),
        ({"adc_out": np.zeros((3, 6), "i2")}, r"adc_th \(2, 6\), adc_out \(3, 6\)"),
        ({"adc_out": np.zeros(6, "i2")}, "shapes do not fit"),
        ({"adc_ref": np.zeros((1, 5), "i2")}, "shapes do not fit each other: adc_th"),
        ({"R_ref": [1.0, 2.0]}, "shapes do not fit"),
        ({"fs": 0.0}, "sample_rate: is 0 hertz"),
        ({"scale": 0.0}, "scale: is 0"),
        ({"fs": [1.0, 2.0]}, "fs: .*one number"),
        ({"fs": "fast"}, "fs: .*one number"),
        ({"adc_th": np.zeros((2, 6))}, "adc_th: .*same integer dtype"),
        ({"adc_th": np.array([{}, {}])}, "cannot be read.*pickle"),
    ],
)
def test_a_wrong_archive_is_explained(changes, message, tmp_path):
    path = archive(tmp_path / "a.npz", **changes)
    with pytest.raises(RecordingError, match=message) as caught:
        import_file(path, tmp_path / "a.h5")
    assert caught.value.file == str(path)
    assert not (tmp_path / "a.h5").exists()


def test_labels_of_an_archive_may_be_given_and_nothing_else(tmp_path):
    path = archive(tmp_path / "a.npz")
    one = imported(path, subject="s01", condition="dry")["loaded/1"]
    assert (one.subject, one.condition) == ("s01", "dry")
    with pytest.raises(RecordingError, match=r"scale: is not an argument for npz files"):
        import_file(path, tmp_path / "b.h5", scale=1)


def test_a_table_becomes_one_recording_in_volts(table):
    one = imported(table, **TABLE, current="i", subject="s01", condition="dry")["loaded/0"]
    # one rounding in 1/scale and one in the product
    np.testing.assert_allclose(one.v_th, TH / 0.0535, rtol=3e-16, atol=0)
    np.testing.assert_allclose(one.v_out, TH / 2 / 0.0535, rtol=3e-16, atol=0)
    np.testing.assert_array_equal(one.current, TH / 1e3)
    assert (one.sample_rate, one.subject, one.condition) == (200e3, "s01", "dry")
    assert one.samples["v_th"].resolution is None


def test_a_known_resistor_makes_it_a_calibration(table):
    assert imported(table, **TABLE, r_load=98.8e3)["calibration/0"].r_load == 98.8e3


def test_the_rate_comes_from_a_uniform_time_column(table):
    arguments = {**TABLE, "sample_rate": None, "time": "t"}
    # four steps of times printed to 17 digits
    assert imported(table, **arguments)["loaded/0"].sample_rate == pytest.approx(200e3, rel=1e-14)


@pytest.mark.parametrize(
    ("stamps", "message"),
    [
        ([0, 1, 2, 4, 5], "time: is not uniform: sample"),
        ([0, 1, 2, 2, 3], "time: is not uniform"),
        ([0, -1, -2, -3, -4], "time: does not increase"),
        ([0, 1, np.nan, 3, 4], "time: is not uniform"),
        ([np.nan] * 5, "time: does not increase"),
    ],
)
def test_times_that_are_no_clock_are_refused(stamps, message, tmp_path):
    path = tmp_path / "t.csv"
    rows = [f"{t},1,2" for t in stamps]
    path.write_text("\n".join(["t,th,out", *rows]), encoding="utf-8")
    with pytest.raises(RecordingError, match=message):
        import_file(path, tmp_path / "t.h5", **{**TABLE, "sample_rate": None, "time": "t"})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v_th": "Vth"}, r"v_th: there is no 'Vth'; the names are 't', 'th', 'out', 'i'"),
        ({"v_out": None}, "v_out: is not given, and is not guessed"),
        ({"pulse_rate": None}, "pulse_rate: is not given"),
        ({"scale": None}, "scale: is not given.*1 if the values are those at the terminal"),
        ({"sample_rate": None}, "one of time and sample_rate"),
        ({"time": "t"}, "one of time and sample_rate"),
    ],
)
def test_a_wrong_argument_is_explained(changes, message, table, tmp_path):
    with pytest.raises(RecordingError, match=message) as caught:
        import_file(table, tmp_path / "a.h5", **{**TABLE, **changes})
    assert caught.value.file == str(table)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "there is no 'th'; the names are none"),
        ("th,out\n", "the table has no rows"),
        ("th,out\n1,2\n3,x\n", "cannot be read .*'x'"),
        ("th,out\n1,2\n3,\n", "cannot be read"),
        ("th,out\n1,2\n3\n", "line 3 has 1 cells"),
        ("th;out\n1;2\n", "there is no 'th'; the names are 'th;out'"),
        ("th,out,th\n1,2,3\n", "two channels have the name 'th'"),
        ("th,out\n1,2\n\xff", "cannot be read"),
    ],
)
def test_a_wrong_table_is_explained(text, message, tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(RecordingError, match=message):
        import_file(path, tmp_path / "t.h5", **TABLE)


def test_a_byte_order_mark_and_quoted_names_are_no_obstacle(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text('"th","out"\r\n1,2\r\n3,4\r\n', encoding="utf-8-sig")
    assert imported(path, **TABLE)["loaded/0"].v_out.size == 2


@pytest.mark.parametrize("version", [5, 7.3])
def test_matlab_trials_are_rows_and_codes_stay_integers(version, tmp_path):
    codes = np.arange(8, dtype="i2").reshape(2, 4)
    path = matlab(tmp_path / "m.mat", version, th=codes[:1], out=codes)
    recordings = imported(path, **{**TABLE, "scale": 1000.0})
    assert list(recordings) == ["loaded/0", "loaded/1"]
    for trial, one in enumerate(recordings.values()):
        assert one.samples["v_out"].stored.dtype == np.int16
        np.testing.assert_array_equal(one.samples["v_out"].stored, codes[trial])
        np.testing.assert_array_equal(one.samples["v_th"].stored, codes[0])
        assert (one.trial, one.samples["v_out"].conversion) == (str(trial), 1e-3)


@pytest.mark.parametrize("version", [5, 7.3])
def test_a_matlab_column_is_one_trial(version, tmp_path):
    path = matlab(tmp_path / "m.mat", version, th=TH[:, None], out=TH[:, None] / 2)
    one = imported(path, **{**TABLE, "scale": 1, "r_load": 1e4})["calibration/0"]
    np.testing.assert_array_equal(one.v_out, TH / 2)


def test_a_field_of_a_matlab_structure_has_a_dotted_name(tmp_path):
    path = matlab(tmp_path / "m.mat", 5, scope={"th": TH, "out": TH / 2, "who": "me"})
    arguments = {**TABLE, "v_th": "scope.th", "v_out": "scope.out"}
    assert imported(path, **arguments)["loaded/0"].v_th.size == 5
    with pytest.raises(RecordingError, match=r"the names are 'scope.th', 'scope.out', 'scope.who'"):
        import_file(path, tmp_path / "a.h5", **TABLE)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"th": TH, "out": TH[:3]}, r"th \(5,\), out \(3,\)"),
        ({"th": np.ones((2, 5)), "out": TH}, "shapes do not fit"),
        ({"th": np.ones((2, 3, 4)), "out": np.ones((2, 3, 4))}, "shapes do not fit"),
        ({"th": np.ones((400, 3)), "out": np.ones((400, 3))}, "Rows are trials.*transpose"),
    ],
)
def test_matlab_variables_that_cannot_be_records_are_explained(variables, message, tmp_path):
    path = matlab(tmp_path / "m.mat", 5, **variables)
    with pytest.raises(RecordingError, match=message):
        import_file(path, tmp_path / "a.h5", **TABLE)


def test_matlab_4_files_of_a_vax_are_refused_and_the_library_is_silent(tmp_path, recwarn):
    path = tmp_path / "m.mat"
    scipy.io.savemat(path, {"th": TH, "out": TH / 2}, format="4")
    data = bytearray(path.read_bytes())
    data[:4] = (2000).to_bytes(4, "little")  # the order of bytes of a VAX
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="VAX or Cray"):
        import_file(path, tmp_path / "a.h5", **TABLE)
    assert not recwarn.list


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="no such file"):
        import_file(tmp_path / "none.csv", tmp_path / "a.h5")
    (tmp_path / "a.docx").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"cannot import files with the suffix '.docx'"):
        import_file(tmp_path / "a.docx", tmp_path / "a.h5")
