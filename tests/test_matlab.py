"""Arrays of structures, cells and matrices of channels in MATLAB files, under MATLAB's names."""

import pathlib
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

import etid
from etid.files.readers import matlab
from tests.lab_files import imported, refused
from tests.lab_files import matlab as plain

TH = np.arange(30.0)
FIELDS: dict[str, Any] = {"sample_rate": 2e5, "pulse_rate": 60.0, "scale": 1.0}


def written(path, version):
    """Structures, cells and matrices; what is in a cell of version 7.3 is elsewhere in the file."""
    trials = [{"th": TH, "out": TH / (k + 2), "more": {"name": "x", "v": TH * k}} for k in range(3)]
    cells = [TH, TH / 2, {"v": TH / 3}]
    matrix, stack = np.stack([TH, TH / 2, TH / 4], axis=1), np.stack([TH, TH / 5])
    if version == 5:
        array = np.zeros((1, 3), [("th", object), ("out", object), ("more", object)])
        for k, one in enumerate(trials):
            array[0, k] = tuple(one.values())
        cell = np.empty((3, 1), object)
        cell[:, 0] = cells
        content = {"trials": array, "run": {"cells": cell}, "m": matrix, "stack": stack}
        scipy.io.savemat(path, content | {"one": 5.0})
        return path
    plain(path, version, m=matrix, stack=stack, one=np.array(5.0))
    with h5py.File(path, "r+") as file:
        count = 0

        def stored(value):
            nonlocal count
            name, count = f"#refs#/{count}", count + 1
            if isinstance(value, dict):
                group = file.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for field, one in value.items():
                    if isinstance(one, str):
                        one = np.array([[*map(ord, one)]], "u2").T
                    group[field] = np.atleast_2d(one).T if np.ndim(one) == 1 else one
                    kind = "char" if field == "name" else "double"
                    group[field].attrs["MATLAB_class"] = np.bytes_(kind)
            else:
                file[name] = np.atleast_2d(value).T
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
            return file[name].ref

        def references(name, values, kind=None):
            array = np.array([stored(value) for value in values], h5py.ref_dtype)[:, None]
            file.create_dataset(name, data=array)
            if kind:
                file[name].attrs["MATLAB_class"] = np.bytes_(kind)

        file.create_group("trials").attrs["MATLAB_class"] = np.bytes_("struct")
        for field in ("th", "out", "more"):  # its fields are references without a class
            references(f"trials/{field}", [one[field] for one in trials])
        file.create_group("run").attrs["MATLAB_class"] = np.bytes_("struct")
        references("run/cells", cells, "cell")
    return path


@pytest.mark.parametrize("version", [5, 7.3])
def test_channels_have_the_names_of_matlab(version, tmp_path):
    path = written(tmp_path / "a.mat", version)
    expected = {
        "trials(2).out": TH / 3, "trials(3).more.v": TH * 2, "run.cells{1}": TH,
        "run.cells{2}": TH / 2, "run.cells{3}.v": TH / 3, "m(:,1)": TH, "m(:,3)": TH / 4,
        "stack(2,:)": TH / 5,
    }  # fmt: skip
    with matlab.opened(path, tmp_path) as contents:
        for name, values in expected.items():
            assert name in contents.names
            channel = contents.channel(name)
            found = np.concatenate([channel.read(0, 0, 7), channel.read(0, 7, TH.size)])
            np.testing.assert_array_equal(found, values, err_msg=name)
        assert contents.channel("stack").shape == (2, 30)
        assert "stack(:,1)" not in contents.names  # an instant of both trials
    for name, message in (
        ("trials(1).more.name", "is a (text|char array), must be an array of real numbers"),
        ("one", "is one number, must be an array of real numbers"),
        ("trials(4).out", "the names are "),
    ):
        refused(path, None, message, v_th="m(:,1)", v_out=name, **FIELDS)


@pytest.mark.parametrize("version", [5, 7.3])
def test_a_command_or_a_pattern_may_name_them(version, tmp_path):
    path = written(tmp_path / "a.mat", version)
    recordings, [used] = imported(path, v_th="m(:,1)", v_out="run.cells{2}", **FIELDS)
    np.testing.assert_array_equal(recordings["loaded/0"].v_out, TH / 2)
    assert str(used.signals["v_th"]).startswith("'m(:,1)' in V")
    given = {"v_th": "m(:,1)", "v_out": "trials({trial}).out", **FIELDS}
    recordings, _ = imported(path, **given)
    assert [one.trial for one in recordings.values()] == ["1", "2", "3"]
    np.testing.assert_array_equal(recordings["loaded/3"].v_out, TH / 4)


def test_a_channel_of_a_matrix_may_be_in_another_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(pathlib.Path("open.mat"), 5)
    path = tmp_path / "skin.csv"
    path.write_text("skin\n" + "\n".join(map(str, TH / 2)) + "\n")
    recordings, _ = imported(path, v_th="open.mat:m(:,1)", v_out="skin", **FIELDS)
    np.testing.assert_array_equal(recordings["loaded/0"].v_th, TH)


def test_cells_that_lead_in_a_circle_end(tmp_path):
    path = plain(tmp_path / "a.mat", 7.3, m=TH)
    with h5py.File(path, "r+") as file:
        loop = file.create_dataset("loop", (1, 1), h5py.ref_dtype)
        loop.attrs["MATLAB_class"] = np.bytes_("cell")
        loop[0, 0] = loop.ref
    with matlab.opened(path, tmp_path) as contents:
        assert contents.names == ("m",)


def test_recorded_files_of_others_are_read_as_scipy_reads_them(reference_data):
    path = reference_data("ecog_stim") / "20f8a3_stimOutput.mat"
    whole = scipy.io.loadmat(path, simplify_cells=True)["dataStruct"]["pair_21_20"]["stim_data"]
    name = "dataStruct.pair_21_20.stim_data"
    with matlab.opened(path, path.parent) as contents:
        for pulse in (1, 17):
            (found,) = contents.channel(f"{name}(:,{pulse})").blocks()
            np.testing.assert_array_equal(found, whole[:, pulse - 1])
    path = reference_data("battery_pulses") / "LGM50_5Ah_Pulse.mat"
    content = scipy.io.loadmat(path, simplify_cells=True)["LGM50_5Ah_Pulse"]
    own = content["T25"]["SoC5"]["Cell1"]["data"]["Voltage"]
    with matlab.opened(path, path.parent) as contents:
        (found,) = contents.channel("LGM50_5Ah_Pulse.T25.SoC5.Cell1.data.Voltage").blocks()
    np.testing.assert_array_equal(found, own)


def test_a_matrix_that_is_no_stack_says_how_to_name_its_columns(tmp_path):
    long = np.repeat(TH[:, None], 2, axis=1)
    path = plain(tmp_path / "a.mat", 5, th=np.tile(long, (20, 1)), out=np.tile(long, (20, 1)))
    with pytest.raises(etid.RecordingError, match=r"name one column, as in m\(:,2\)"):
        etid.import_file(path, tmp_path / "a.h5", v_th="th", v_out="out", **FIELDS)
