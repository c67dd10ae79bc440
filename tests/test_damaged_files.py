"""Damaged files end in an answer or in one error of etid's own."""

import re
from typing import Any

import h5py
import numpy as np
import pytest

import etid
from benchmarks import fuzz
from benchmarks.specimens import study_fits
from etid.cli import main
from etid.commands import check
from etid.recordings import hdf5, limits
from etid.results.study_fits import StudyFits

FEW = 4  # files of each kind


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return fuzz.good_files(tmp_path_factory.mktemp("good"))


@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_a_damaged_file_is_read_or_refused(good, kind, tmp_path):
    for seed in range(FEW):
        assert fuzz.judge(tmp_path, kind, good[kind], seed) in ("read", "refused"), seed


@pytest.mark.parametrize("kind", fuzz.KINDS)
def test_a_good_file_is_read(good, kind, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "damaged", lambda data, _: data)
    assert fuzz.judge(tmp_path, kind, good[kind], 0) == "read"


# Recordings


@pytest.fixture
def texts(good, tmp_path):
    """A study with texts of variable length, as h5py writes them by itself."""
    path = tmp_path / "study.h5"
    path.write_bytes(good["h5py"])
    return path


def test_a_heap_whose_objects_go_in_a_circle_is_an_error_and_no_hang(texts):
    data = bytearray(texts.read_bytes())
    place = data.find(b"GCOL\x01") + 16
    data[place : place + 16] = bytes(16)  # a free object of size 0
    texts.write_bytes(data)
    assert "the heap of texts" in hdf5.check(texts)[0].message
    with pytest.raises(etid.RecordingError, match="the heap of texts"):
        etid.read(texts)


def dies(file):
    """Ends its process as a crash of the HDF5 library does."""
    import os
    import signal

    os.kill(os.getpid(), signal.SIGKILL)


def test_a_file_that_ends_its_reader_is_reported_as_damaged(texts, monkeypatch, capsys):
    monkeypatch.setattr(check, "_faults", dies)
    assert main(["check", str(texts)]) == 1
    assert capsys.readouterr().out == (
        f"{texts}: the process that read it has crashed, or took too much time or memory. "
        "The file is damaged or was not closed: copy or record it again.\n"
    )


def stored_again(path, *arguments, **options):
    """Another dataset `s01/dry/v_out` with its attributes; where its first chunk is."""
    with h5py.File(path, "r+") as file:
        attributes = dict(file["s01/dry/v_out"].attrs)
        del file["s01/dry/v_out"]
        data = file.create_dataset("s01/dry/v_out", *arguments, **options)
        data.attrs.update(attributes)
        file.flush()
        return data.id.get_chunk_info(0).byte_offset if data.id.get_num_chunks() else None


@pytest.mark.parametrize(
    ("shape", "chunks", "message"),
    [
        ((limits.SAMPLES + 1,), (64,), "samples are read"),
        ((limits.TRIALS + 1, 64), (64, 64), "trials of"),
        ((limits.FREE,), (64,), "only 0 bytes are stored"),
    ],
)
def test_what_is_declared_beyond_a_limit_is_refused_before_it_is_read(
    texts, shape, chunks, message
):
    stored_again(texts, shape, "i2", chunks=chunks)
    (problem,) = hdf5.check(texts)
    assert (problem.path, problem.field) == ("s01/dry", "v_out")
    assert problem.remedy
    assert re.search(message, problem.message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.create_group("/".join("g" * (limits.DEPTH + 2))), "groups deep"),
        (lambda f: f.__setitem__("s01/x", h5py.SoftLink("/s01/x")), "too many links"),
    ],
)
def test_depth_and_links_have_limits(texts, change, message):
    with h5py.File(texts, "r+", libver="latest") as file:
        change(file)
    assert any(message in problem.message for problem in hdf5.check(texts))


def test_a_damaged_chunk_costs_its_own_recording(texts):
    """Its checksum no longer fits, as after a bad sector; that is seen when samples are read."""
    with h5py.File(texts) as opened:
        file: Any = opened
        codes = file["s01/dry/v_out"][()]
    offset = stored_again(texts, data=codes, chunks=codes.shape, fletcher32=True)
    assert offset is not None
    with texts.open("r+b") as raw:
        raw.seek(offset + 50)
        raw.write(b"\xff\x00\xff")
    with etid.read(texts) as study:
        with pytest.raises(etid.RecordingError, match="'s01/dry', v_out: "):
            study["s01/dry/0"]
        assert study["calibration/0"].v_out.size > 0


# Files of fits


@pytest.fixture
def fits(tmp_path):
    path = tmp_path / "fits.h5"
    study_fits().write(path)
    return path


def column(name, values):
    def change(file):
        del file[name]
        if values is not None:
            file[name] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (column("chi2", None), "chi2: the column is missing"),
        (column("steps", np.zeros(6)), "steps: is of type float64, must be integer"),
        (column("cov", np.zeros((6, 2, 2))), "cov: has shape"),
        (column("verdict", ["fine"] * 6), "verdict: 'fine' is not a verdict"),
        (column("drivers", ["{"]), r"drivers\[0\]: holds a driver that cannot be read"),
        (column("drivers", ["[" * 10**5]), r"drivers\[0\]: holds a driver .*RecursionError"),
        (column("drivers", ['{"calibrations": 1}']), "calibrations is 1, must be paths"),
        (lambda file: file.attrs.update(order="five"), "order: is 'five', must be"),
        (lambda file: file.attrs.update(start="x"), "start: is 'x', must be"),
    ],
)
def test_wrong_fits_are_one_error_that_names_file_column_and_remedy(fits, change, message):
    with h5py.File(fits, "r+") as file:
        change(file)
    with pytest.raises(etid.RecordingError, match=message) as caught:
        StudyFits.read(fits)
    assert caught.value.file == str(fits)
    assert caught.value.remedy


# Files of other formats


def test_matlab_that_declares_a_huge_shape_is_refused_at_once(good, tmp_path):
    path = tmp_path / "rig.mat"
    path.write_bytes(good["mat"])
    with h5py.File(path, "r+") as file:
        del file["skin"]
        data = file.create_dataset("skin", (2**40, 1), "f8", chunks=(64, 1))
        data.attrs["MATLAB_class"] = np.bytes_("double")
    with pytest.raises(etid.RecordingError, match="only 0 bytes are stored"):
        etid.import_file(path, tmp_path / "out.h5", fuzz.MAPPING)


@pytest.mark.parametrize(
    "text", ["v_th = " + "[" * 10**4, ".".join("a" * 30_000) + " = 1", "a = " + "{a=" * 10**4]
)
def test_a_deep_mapping_is_refused_at_once(tmp_path, text):
    path = tmp_path / "deep.toml"
    path.write_text(text)
    (tmp_path / "rig.csv").write_text("open,skin\n1,2\n")
    with pytest.raises(etid.RecordingError, match="is not TOML") as caught:
        etid.import_file(tmp_path / "rig.csv", tmp_path / "out.h5", path)
    assert caught.value.file == str(path)
