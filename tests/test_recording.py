import copy
import pickle
from typing import Any

import numpy as np
import pytest

from etid.recordings import hdf5
from etid.recordings.recording import Recording, RecordingError, Samples
from etid.recordings.study import Study

RATES = {"sample_rate": 200e3, "pulse_rate": 60.0}


def recording(length=100, **fields):
    ramp = np.arange(length, dtype=float)
    arguments: dict[str, Any] = {"v_th": ramp, "v_out": ramp / 2, **RATES, **fields}
    return Recording(**arguments)


def study():
    return Study.from_recordings(
        [
            recording(path="calibration/98k8", r_load=98.8e3),
            recording(path="s01/dry/0", subject="s01", condition="dry", trial=0),
            recording(path="s01/dry/1", subject="s01", condition="dry", trial=1),
            recording(path="s02/damp", subject="s02", condition="damp", electrode="E17"),
        ]
    )


def test_values_follow_the_conversion_of_nwb():
    codes = np.array([-2, 0, 3], "i2")
    samples = Samples(codes, conversion=-0.5, offset=1.0)
    codes[0] = 7
    assert samples.stored.dtype == np.int16
    assert samples.values.tolist() == [2.0, 1.0, -0.5]
    assert samples.resolution == 0.5
    assert Samples(samples.values, conversion=-0.25).resolution is None  # no codes
    for array in (samples.stored, samples.values):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_recording_cannot_be_assigned_to():
    with pytest.raises(AttributeError):
        recording().r_load = 1.0  # type: ignore[misc]  # what must fail
    with pytest.raises(TypeError):
        recording().samples["v_th"] = Samples(np.zeros(3))  # type: ignore[index]  # what must fail


def test_labels_become_text_and_one_calibration_a_tuple():
    one = recording(10_000, trial=np.int64(3), subject=7, calibration="/calibration/98k8")
    assert (one.trial, one.subject, one.calibration) == ("3", "7", ("calibration/98k8",))
    assert (one.duration, one.periods, one.time[1]) == (0.05, 3.0, 1 / 200e3)
    assert not one.is_calibration
    assert recording(r_load=98.8e3).is_calibration


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"v_out": lambda: Samples(np.zeros(3), 0.0)}, "conversion: is 0"),
        ({"v_out": lambda: Samples(np.zeros(3), 1.0, float("inf"))}, "offset: is inf"),
        ({"v_out": np.zeros(99)}, "numbers of samples differ: v_th 100, v_out 99"),
        ({"current": np.zeros(99)}, "current 99"),
        ({"v_th": np.zeros((2, 50))}, r"v_th: has shape \(2, 50\), must be \(time,\)"),
        ({"v_th": np.zeros(0), "v_out": np.zeros(0)}, "at least one sample"),
        ({"v_th": np.zeros(100, complex)}, "v_th: has dtype complex128"),
        ({"v_th": np.zeros(100, bool)}, "v_th: has dtype bool"),
        ({"v_th": np.array(["a"] * 100)}, "v_th: has dtype <U1"),
        (
            {"v_out": np.zeros(100, "i2")},
            r"v_out: holds integers .*Wrap converter codes in Samples",
        ),
        ({"sample_rate": 0}, "sample_rate: is 0 hertz, must be > 0"),
        ({"sample_rate": float("nan")}, "sample_rate: is nan, must be a finite"),
        ({"pulse_rate": -60.0}, "pulse_rate: is -60 hertz"),
        ({"pulse_rate": float("inf")}, "pulse_rate: is inf"),
        ({"pulse_rate": 100e3}, "pulse_rate: is 100000 Hz, must be below half the sample rate"),
        ({"pulse_rate": 1e-310}, "pulse_rate: is 1e-310 Hz; .* longer than a record may be"),
        ({"r_load": 0.0}, "r_load: is 0 ohm"),
        ({"r_load": float("inf")}, "r_load: is inf"),
        ({"adc_range": (1.0, -1.0)}, "adc_range: .*increasing"),
        ({"adc_range": (1.0,)}, "adc_range: .*two"),
        ({"adc_range": (0.0, float("nan"))}, "adc_range: is nan"),
        ({"r_load": 1e3, "calibration": "c"}, "calibration: .*has none itself"),
        ({"subject": "a\0b"}, "subject: .*UTF-8"),
        ({"path": "a//b"}, "path: .*cannot be the path"),
        ({"path": "a/v_th"}, "path: .*cannot be the path"),
    ],
)
def test_static_mistakes_are_named(fields, message):
    def made():
        given: dict[str, Any] = {n: of() if callable(of) else of for n, of in fields.items()}
        return recording(**given)

    with pytest.raises(ValueError, match=message):
        made()


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "pickle"]
)
def test_a_copy_holds_the_same_cannot_be_changed_and_opens_its_file(copied, tmp_path, monkeypatch):
    codes = Samples(np.array([1, -2, 3], "i2"), 0.5, 1.0)
    one = recording(3, v_th=codes, path="s01", subject="s01", adc_range=(-1.0, 2.0))
    again = copied(one)
    assert again.metadata == one.metadata
    assert again.samples["v_th"].stored.dtype == np.int16
    np.testing.assert_array_equal(again.v_th, one.v_th)
    np.testing.assert_array_equal(again.v_out, one.v_out)
    with pytest.raises(ValueError, match="read-only"):
        again.samples["v_th"].stored[0] = 1
    study().write(tmp_path / "study.h5")
    monkeypatch.chdir(tmp_path)
    with hdf5.read("study.h5") as whole, copied(whole.where(subject="s01")) as part:
        whole.close()
        assert list(part) == ["s01/dry/0", "s01/dry/1"]
        np.testing.assert_array_equal(part["s01/dry/1"].v_out, study()["s01/dry/1"].v_out)


def test_an_error_says_where_what_and_what_to_do_and_survives_pickling():
    error = RecordingError(
        "is 0 Hz", file="a.h5", path="s01", field="sample_rate", remedy="Mend it"
    )
    assert str(error) == "a.h5, 's01', sample_rate: is 0 Hz. Mend it."
    again = pickle.loads(pickle.dumps(error))
    parts = again.file, again.path, again.field, again.remedy
    assert (str(again), parts) == (str(error), ("a.h5", "s01", "sample_rate", "Mend it"))


def test_a_study_is_an_ordered_mapping_of_paths_from_which_labels_select():
    paths = ["calibration/98k8", "s01/dry/0", "s01/dry/1", "s02/damp"]
    assert list(study()) == [one.path for one in study().recordings()] == paths
    assert len(study()) == 4
    assert "/s02/damp/" in study()
    assert "s02" not in study()
    assert study()["/s02/damp"].electrode == "E17"
    assert repr(study()) == "<Study: 1 calibration, 3 loaded>"
    for labels, expected in (
        ({"subject": "s01"}, paths[1:3]),
        ({"subject": "s01", "trial": 1}, paths[2:3]),
        ({"condition": "damp", "electrode": "E17"}, paths[3:]),
        ({"subject": "s03"}, []),
        ({}, paths),
    ):
        assert list(study().where(**labels)) == expected


def test_wrong_paths_are_refused_and_answered_with_those_that_are_near():
    for path, message in (
        ("s01/dry", r"group of 2 recordings: 's01/dry/0' … 's01/dry/1'"),
        ("s02/dump", r"no recording 's02/dump'.*'s02/damp'"),
    ):
        with pytest.raises(KeyError, match=message):
            study()[path]
    for paths, message in ((["a", "a"], "two recordings"), (["a", "a/b/c"], "inside another")):
        with pytest.raises(RecordingError, match=message):
            Study.from_recordings([recording(path=path) for path in paths])
