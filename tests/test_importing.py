import json
import re

import numpy as np
import pytest
import scipy.io

from benchmarks.spice import mapping_of
from etid.files.importing import import_file
from etid.recordings import hdf5
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


def variables(path, **content):
    return matlab(path / "m.mat", 5, **content)


def of_a_vax(path, **content):
    """A file of Matlab 4 with the order of bytes of a VAX."""
    scipy.io.savemat(path / "m.mat", content, format="4")
    data = bytearray((path / "m.mat").read_bytes())
    data[:4] = (2000).to_bytes(4, "little")
    (path / "m.mat").write_bytes(data)
    return path / "m.mat"


def test_all_reference_scenes_become_the_volts_of_their_own_formula(reference_data, tmp_path):
    folder = reference_data("spice_recordings")
    scenes = json.loads((folder / "truth.json").read_text("utf-8"))["scenes"]
    assert len(scenes) == 18
    for name, truth in scenes.items():
        target = tmp_path / "scene.h5"
        import_file(folder / f"{name}.npz", target, mapping_of(folder / f"{name}.npz"))
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
                # one rounding each of the scale, its inverse and the product
                assert one.samples["v_th"].resolution == pytest.approx(volts, rel=1e-15)
                assert one.adc_range == pytest.approx((-32768 * volts, 32767 * volts), rel=1e-15)
                np.testing.assert_allclose(one.v_th, raw["adc_th"][trial] * volts, rtol=1e-15)
                np.testing.assert_allclose(one.v_out, raw["adc_out"][trial] * volts, rtol=1e-15)
            first = study["calibration/0"]
            np.testing.assert_array_equal(first.samples["v_out"].stored, raw["adc_ref"][0])
            np.testing.assert_array_equal(first.samples["v_th"].stored, raw["adc_th"][0])


def archive(path, **content):
    np.savez(path / "a.npz", **content)
    return path / "a.npz"


@pytest.mark.parametrize(
    ("make", "content", "message"),
    [
        (archive, {"th": np.array([{}, {}]), "out": TH}, "cannot be read.*pickle"),
        (
            variables,
            {"th": TH, "out": TH[:3]},
            "v_th: 5 samples .'th'., v_out: 3 samples .'out'",
        ),
        (
            variables,
            {"th": np.ones((2, 5)), "out": TH},
            "v_th: 2 trials of 5 samples .*v_out: 5 s",
        ),
        (
            variables,
            {"th": np.ones((2, 3, 4)), "out": np.ones((2, 3, 4))},
            "array of 2 x 3 x 4 numb",
        ),
        (variables, {"th": np.ones((400, 3)), "out": np.ones((400, 3))}, "Rows are.*transpose"),
        (variables, {"scope": {"th": TH}}, "the names are 'scope.th'"),
        (of_a_vax, {"th": TH, "out": TH / 2}, "VAX or Cray"),
    ],
)
def test_wrong_arrays_are_explained(make, content, message, tmp_path, recwarn):
    lab_files.refused(make(tmp_path, **content), None, message, **TABLE)
    assert not recwarn.list


def test_a_table_becomes_one_recording_in_volts(table):
    labels = {"subject": "s01", "condition": "dry"}
    one = imported(table, **TABLE, current="i", **labels)["loaded/0"]
    # one rounding in 1/scale and one in the product
    np.testing.assert_allclose(one.v_th, TH / 0.0535, rtol=3e-16, atol=0)
    np.testing.assert_allclose(one.v_out, TH / 2 / 0.0535, rtol=3e-16, atol=0)
    np.testing.assert_array_equal(one.current, TH / 1e3)
    assert (one.sample_rate, one.subject, one.condition) == (200e3, "s01", "dry")
    assert one.samples["v_th"].resolution is None
    by_time = {**TABLE, "sample_rate": None, "time": "t", "r_load": 98.8e3}
    known = imported(table, **by_time)["calibration/0"]
    assert known.r_load == 98.8e3
    # four steps of times printed to 17 digits
    assert known.sample_rate == pytest.approx(200e3, rel=1e-14)


def times(*stamps):
    return "\n".join(["t,th,out", *(f"{t},1,2" for t in stamps)])


BY_TIME = {"sample_rate": None, "time": "t"}
ROWS = "t,th,out,i\n0,1,2,3\n1,4,5,6\n"
COMMAS, SAID = "t;th;out\n0;1,5;2,5\n1;{};1,5\n", {"delimiter": ";", "decimal": ","}
SHIFTED = "t,th,out{0}\n0,1.5,2.5{0}\n{1}\n0,1.5,2.5{0}\n"


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        ("", {}, r"the file is empty\. Export"),
        ("th,out\n", {}, "the table has no rows"),
        ("th,out\n1,2\n\n3,x\n", {}, "line 4 has 'x' in column 2, must be a number.*write NaN"),
        ("th,out\n" + 70000 * "1,2\n" + "3,x\n", {}, "line 70002 has 'x' in column 2"),
        ("th,out\n1,2\n3,\n", {}, "line 3 has '' in column 2"),
        ("th,out\n1,2\n3\n", {}, "line 3 has 1 cell;"),
        ("th;out\n1;2\n", {}, "there is no 'th'; the names are 'th;out'"),
        ("th,out,th\n1,2,3\n", {}, "2 columns have the name 'th'.*: 'th#1' or 'th#3'"),
        ("th,out\n1,2\n\xff", {}, "cannot be read"),
        (times(*range(9), *range(60, 70)), BY_TIME, r"uniform: samples.* sample 9, from 8 to 60 s"),
        (times(*(t + t**2 / 20 for t in range(9))), BY_TIME, "time: is not uniform: sample"),
        (times(0, 1, 2, 2, 3), BY_TIME, "time: is not uniform"),
        (times(0, -1, -2, -3, -4), BY_TIME, "time: does not increase"),
        (times(0, 1, np.nan, 3, 4), BY_TIME, "time: is not uniform"),
        (times(*[np.nan] * 5), BY_TIME, "time: does not increase"),
        (COMMAS.format("1.234"), SAID, "line 3 has the cell '1.234', but the decimal sign is a"),
        (COMMAS.format("-12.345.678"), SAID, "line 3 has the cell '-12.345.678', but"),
        (COMMAS.format("0.5"), SAID, "line 3 has the cell '0.5', but the decimal sign is a comma"),
        (SHIFTED.format(",", "0.0,-1,23,4,56"), {}, "line 3 has 5 cells; the table has"),
        (SHIFTED.format("", "0.0,-1,23,4,56"), {}, "line 3 has 5 cells; the table has"),
        (SHIFTED.format(",", "0.0,1,5,2.5"), {}, "line 3 has 4 cells; the table has"),
        (SHIFTED.format("", "0.0,1,5,2.5"), {}, "line 3 has 4 cells; the table has"),
        (SHIFTED.format(",", "-1.23,4.56"), {}, "line 3 has 2 cells; the table has"),
        (SHIFTED.format("", "-1.23,4.56"), {}, "line 3 has 2 cells; the table has"),
        (ROWS, {"sample_rate": None}, "one of time and sample_rate"),
        (ROWS, {"time": "t"}, "one of time and sample_rate"),
    ],
)
def test_a_wrong_table_is_explained(text, changes, message, tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode("latin-1"))
    lab_files.refused(path, None, message, **{**TABLE, **changes})


BARE = {**TABLE, "scale": 1.0}
COUNT = 30
V_TH = np.round(np.random.default_rng(8).normal(size=COUNT), 3)
V_OUT = V_TH / 2


def rows(sign=".", between=",", end=""):
    """Times, V_th and V_out in text."""
    lines = [
        between.join(f"{x:.6f}".replace(".", sign) for x in (i * 5e-6, a, b)) + end
        for i, (a, b) in enumerate(zip(V_TH, V_OUT, strict=True))
    ]
    return [f"{line}\n" for line in lines]


def noticed(path, **given):
    """The recording of a file, and the notices."""
    recordings, [used] = lab_files.imported(path, **{**BARE, **given})
    return recordings["loaded/0"], used.notices


def refused(path, message, **given):
    assert lab_files.refused(path, None, message, **{**BARE, **given}).remedy


def test_notes_quotes_and_delimiters_at_the_end_are_no_fault(tmp_path):
    ends = ["\n", ",\n", ",fine\n", ',"fine, though"\n', ",,\n"]
    lines = [line[:-1] + ends[i % len(ends)] for i, line in enumerate(rows())]
    lines = [re.sub(r"^([^,]*)", r'"\1"', line) if i % 3 else line for i, line in enumerate(lines)]
    one, notices = noticed(
        lab_files.table(tmp_path, "t,th,out,note\n" + "".join(lines)), time="t", sample_rate=None
    )
    np.testing.assert_array_equal(one.v_th, V_TH)
    np.testing.assert_allclose(one.v_out, V_OUT, rtol=0, atol=1e-12)
    assert notices == ()


@pytest.mark.parametrize(("sign", "between", "end"), [(".", ",", ""), (",", ";", ";")])
def test_a_table_that_ends_inside_a_number_is_taken_with_a_notice(sign, between, end, tmp_path):
    told = {} if sign == "." else {"delimiter": between, "decimal": sign}
    text = between.join(["t", "th", "out"]) + end + "\n" + "".join(rows(sign, between, end))
    whole = text.rstrip(end + "\n")
    for shown in (text, whole):  # a line break is often missing
        assert noticed(lab_files.table(tmp_path, shown), **told)[1] == ()
    one, [notice] = noticed(lab_files.table(tmp_path, whole[:-4]), **told)
    last = whole[:-4].rpartition(between)[2]
    assert notice.startswith(f"the last number, '{last}', is shorter than those above")
    assert one.v_out[-1] == float(last.replace(",", "."))
    refused_end = whole.rpartition(between)[0]
    refused(lab_files.table(tmp_path, refused_end), "has 2 cells; the table has", **told)


def test_a_last_number_that_is_shorter_than_some_above_may_be_whole(tmp_path):
    text = "th,out\n0.125,0.0625\n0.5,0.25\n0.25,{}"
    for last, noticed_one in (("0.125", False), ("0.25", False), ("0.2", True)):
        path = lab_files.table(tmp_path, text.format(last))
        assert bool(noticed(path)[1]) == noticed_one, last


def test_the_preamble_of_an_oscilloscope_is_compared_with_its_table(tmp_path):
    body = "t [s],th [V],out [V]\n" + "".join(rows())

    def scope(length, interval):
        said = f"Model,DPO\nRecord Length,{length}\nSample Interval,{interval}\n"
        return lab_files.table(tmp_path, said + body)

    told: dict = {"time": "t", "header_line": 4, "sample_rate": None}
    assert noticed(scope(30, "5e-06,s"), **told)[1] == ()
    assert noticed(scope("3.0e+01", "5,us"), **told)[1] == ()
    without, _ = noticed(scope(30, "5e-06"), header_line=4, sample_rate=None)
    assert without.sample_rate == 200e3
    _, [used] = lab_files.imported(scope(40, "5e-06"), **{**BARE, **told})
    notice = "the table has 30 rows, its preamble declares 40 samples"
    assert str(used).endswith(f"\n  note: {notice}")
    refused(scope(30, "1e-05"), "is 200000 Hz from the time 't', but 100000 Hz from the f", **told)


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
    column = matlab(tmp_path / "c.mat", version, th=TH[:, None], out=TH[:, None] / 2)
    np.testing.assert_array_equal(
        imported(column, **TABLE | {"scale": 1})["loaded/0"].v_out, TH / 2
    )
