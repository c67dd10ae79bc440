"""HDF5 files that are good, but not as they are: unclosed, cut off, of fits, or with a filter."""

import pathlib
import re
import subprocess
import sys
from typing import Any

import h5py
import numpy as np
import pytest
from h5py import h5d, h5p, h5s, h5t, h5z  # type: ignore[attr-defined]  # without stubs

import etid
from benchmarks.specimens import study_fits
from etid.cli import main
from etid.recordings import untrusted

EXAMPLE = pathlib.Path(__file__).parents[1] / "data_schema" / "example.h5"
CRASH = """
import os, sys, h5py, numpy
file = h5py.File(sys.argv[1], "w", libver="latest")
file.attrs.update(schema="etid/recording", schema_version="1.0")
file["a"] = numpy.zeros(1000)
if sys.argv[2] == "swmr":
    file.swmr_mode = True
file.flush()
os._exit(0)
"""


@pytest.mark.parametrize("mode", ["write", "swmr"])
def test_a_file_that_was_not_closed_is_refused_with_what_clears_it(mode, tmp_path):
    path = tmp_path / "study.h5"
    subprocess.run([sys.executable, "-c", CRASH, str(path), mode], check=True)
    (problem,) = etid.check(path)
    assert "h5clear" in problem.message  # the library's own words
    assert "The file is damaged or was not closed" in problem.remedy


def test_a_file_that_is_cut_off_ends_the_command_with_a_message(tmp_path):
    """Not with a segmentation fault, which the library causes if its objects outlive the end."""
    path = tmp_path / "study.h5"
    path.write_bytes(EXAMPLE.read_bytes()[:30_000])
    words = [sys.executable, "-m", "etid", "check", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert "truncated file: eof = 30000" in done.stdout
    assert "copy or record it again" in done.stdout


def test_a_damaged_header_ends_the_command_with_a_message(tmp_path):
    path = tmp_path / "study.h5"
    with h5py.File(path, "w", libver="earliest") as file:
        root = file.id.get_filesize()
    data = bytearray(path.read_bytes())
    data[96:200] = bytes(104)  # the header of its root, as of a program that never wrote it
    path.write_bytes(data)
    assert root > 200
    words = [sys.executable, "-m", "etid", "check", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert "The file is damaged or was not closed" in done.stdout


@pytest.fixture
def filtered(tmp_path):
    """A recording whose output is compressed by a filter that the library lacks."""
    path = tmp_path / "study.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update(schema="etid/recording", schema_version="1.0")
        group = file.create_group("loaded/0")
        group.attrs.update(kind="loaded", sample_rate=2e5, pulse_rate=60.0)
        group["v_th"] = np.zeros(100)
        how = h5p.create(h5p.DATASET_CREATE)
        how.set_chunk((100,))
        how.set_filter(32001, h5z.FLAG_OPTIONAL, (2, 2, 8, 800, 5, 1, 0))
        space = h5s.create_simple((100,))
        written = h5d.create(group.id, b"v_out", h5t.NATIVE_DOUBLE, space, how)
        written.write_direct_chunk((0,), bytes(400))
        for name in ("v_th", "v_out"):
            group[name].attrs["unit"] = "volt"
    return path


def test_a_filter_that_the_library_lacks_is_named(filtered, monkeypatch):
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    (problem,) = etid.check(filtered)
    assert (problem.path, problem.field) == ("loaded/0", "v_out")
    assert "is compressed by filter 32001" in problem.message
    assert "pip install hdf5plugin" in problem.remedy
    assert "damaged" not in str(problem)


def test_hdf5plugin_is_used_where_it_is_installed(filtered, tmp_path, monkeypatch):
    """It registers its filters when it is imported; here an empty module stands for it."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "hdf5plugin.py").write_text("")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "packages"), *sys.path])
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    del sys.modules["hdf5plugin"]  # and it is put back at the end
    monkeypatch.setattr(untrusted.h5z, "filter_avail", lambda code: "hdf5plugin" in sys.modules)
    with untrusted.guarded(str(filtered)) as opened:
        file: Any = opened
        untrusted.check_size(file["loaded/0/v_th"])
        assert "hdf5plugin" not in sys.modules  # only for a filter that is needed
        untrusted.check_size(file["loaded/0/v_out"])
        assert "hdf5plugin" in sys.modules


COMMANDS = (
    "check {fits}",
    "fit {fits} -o new.h5",
    "fit {study} -o new.h5 --driver {fits}",
    "calibrate {fits} -o new.h5",
    "calibrate {study} -o new.h5 --former {fits}",
    "merge {fits} {study} -o new.h5",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_of_fits_is_called_what_it_is(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    study_fits().write("fits.h5")
    assert main(command.format(fits="fits.h5", study=EXAMPLE).split()) == 1
    said = "".join(capsys.readouterr())
    assert "fits.h5, schema: is a file of fits, not of recordings. Name the file of rec" in said
    assert "etid report and etid export take a file of fits" in said
    assert not re.search("needs the attributes|damaged", said)
    assert [path.name for path in tmp_path.iterdir()] == ["fits.h5"]


def test_a_file_of_etid_needs_no_import(tmp_path, capsys):
    assert main(["import", str(EXAMPLE), "-o", str(tmp_path / "a.h5")]) == 1
    assert "one that etid has written needs no import. Use it as it is" in capsys.readouterr().err
