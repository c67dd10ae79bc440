"""Exported files, read back by the programs they are for."""

import csv
import dataclasses
import json
import re
import sys

import h5py
import numpy as np
import pandas
import pytest
from pyarrow import parquet

import etid
from etid import cli
from etid.files import exporting
from etid.results.fit import Limited
from etid.results.fits import Fits
from tests import pictures

COUNT = 12
ELEMENTS = {"r_s": "ohm", "r_p": "ohm", "c_p": "farad"}


@pytest.fixture(scope="module")
def fits():
    """Fits of several verdicts with a note that a table has to quote."""
    notes = np.array([""] * COUNT, object)
    notes[4] = 'is "flat", to a µV\nand has no pulse'
    return dataclasses.replace(pictures.fits(), notes=notes)


@pytest.fixture
def file(fits, tmp_path):
    path = tmp_path / "fits.h5"
    fits.write(path)
    return path


@pytest.fixture(params=[1000, 5])
def parts(request, monkeypatch):
    """At once, and in three parts."""
    monkeypatch.setattr(exporting, "ROWS", request.param)


def test_a_csv_table_has_every_digit_its_units_in_the_names_and_changes_if_asked(
    fits, file, parts, tmp_path
):
    target = tmp_path / "table.csv"
    command = ["export", str(file), "-o", str(target)]
    assert cli.main([*command, "--all"]) == 0
    with target.open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    table = fits.table()
    units = ELEMENTS | {f"{name}_stderr": unit for name, unit in ELEMENTS.items()}
    heads = [f"{name} [{units[name]}]" if name in units else name for name in table]
    assert list(rows[0]) == heads
    assert len(rows) == COUNT
    for head, column in zip(heads, table.values(), strict=True):
        found = [row[head] for row in rows]
        if np.asarray(column).dtype.kind in "fi":
            np.testing.assert_array_equal(np.array(found, float), column)
        else:
            assert found == list(column)
    assert cli.main([*command, "--force"]) == 0
    left_out = {"r_s_change", "r_p_change", "c_p_change", "amplitude_change"}
    left_out |= {"rrse", "chi2", "steps", "remarks"}
    assert set(table) - {head.partition(" ")[0] for head in pandas.read_csv(target)} == left_out


def test_no_text_of_a_csv_table_is_a_formula(fits, tmp_path):
    """Programs for spreadsheets compute cells that begin so; `=cmd|' /C calc'!A0` even runs."""
    texts = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1"]
    labels = {**fits.labels, "subject": np.resize(np.array(texts, object), len(fits))}
    Fits(fits.fit, labels, fits.notes).write(tmp_path / "fits.h5")
    etid.export_fits(tmp_path / "fits.h5", tmp_path / "fits.csv")
    with (tmp_path / "fits.csv").open(newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert [row["subject"] for row in rows[:5]] == [f"'{text}" for text in texts]
    assert rows[0]["path"] == "recording/00"


def test_a_parquet_table_has_its_units_in_the_metadata(fits, file, parts, tmp_path):
    target = tmp_path / "table.parquet"
    etid.export_fits(file, target, all=True)
    pandas.testing.assert_frame_equal(
        pandas.read_parquet(target), fits.to_pandas(), check_dtype=False
    )
    schema = parquet.read_schema(target)
    assert schema.field("c_p_stderr").metadata == {b"unit": b"farad"}
    assert schema.field("verdict").metadata is None
    assert schema.field("steps").type == "int64"
    about = {b"circuit": b"etid:SkinRC", b"method": b"maximum_likelihood"}
    assert about.items() <= schema.metadata.items()


def test_without_pyarrow_the_error_names_the_file_of_the_user(file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    target = tmp_path / "l.parquet"
    with pytest.raises(etid.RecordingError, match=f"^{re.escape(str(target))}: needs the package"):
        etid.export_fits(file, target)


@pytest.mark.parametrize("read", [pandas.read_csv, pandas.read_parquet])
def test_a_long_table_has_a_row_for_each_element(fits, parts, tmp_path, read):
    change = np.random.default_rng(5).normal(size=(COUNT, 4))
    changed = dataclasses.replace(fits.fit, change=change, change_stderr=np.ones_like(change))
    fits = dataclasses.replace(fits, fit=changed)
    fits.write(tmp_path / "fits.h5")
    target = tmp_path / f"long.{read.__name__.removeprefix('read_')}"
    options = {}
    if read is pandas.read_csv:
        options = {"keep_default_na": False, "na_values": ["nan"], "dtype": {"trial": str}}
    etid.export_fits(tmp_path / "fits.h5", target, long=True, all=True)
    found = read(target, **options)
    pandas.testing.assert_frame_equal(found, fits.to_pandas(long=True), check_dtype=False)
    assert len(found) == 3 * COUNT
    for column, expected in (("value", fits.circuit.c_p), ("change", change[:, 2])):
        wide = found.pivot(index="path", columns="element", values=column).loc[fits.labels["path"]]
        np.testing.assert_array_equal(wide["c_p"], expected)
    assert not {"r_s", "r_s_stderr", "r_s_change"} & set(found)
    etid.export_fits(tmp_path / "fits.h5", target, long=True)
    left_out = {"change", "amplitude_change", "rrse", "chi2", "steps", "remarks"}
    assert set(found) - set(read(target, **options)) == left_out


@pytest.mark.parametrize("long", [False, True])
def test_a_table_of_all_columns_says_what_bounds_do(fits, parts, tmp_path, long):
    """It has the columns of `Fits.table`, in their order."""
    outside = np.zeros((COUNT, 3))
    outside[2, 0] = -1.5
    limits = Limited(np.full((COUNT, 3), 1e3), np.full((COUNT, 3), np.inf), outside)
    bounded = dataclasses.replace(fits, fit=dataclasses.replace(fits.fit, limits=limits))
    bounded.write(tmp_path / "fits.h5")
    etid.export_fits(tmp_path / "fits.h5", tmp_path / "all.parquet", all=True, long=long)
    found, table = parquet.read_table(tmp_path / "all.parquet"), bounded.table(long=long)
    assert found.column_names == list(table)
    for name, column in table.items():
        np.testing.assert_array_equal(found[name].to_numpy(zero_copy_only=False), column, name)
    said = [text for text in found["at_bound"].to_pylist() if text]
    words = "Without bounds, r_s would be 1.5 standard errors below 1 kΩ."
    assert said == [words] * (3 if long else 1)
    etid.export_fits(tmp_path / "fits.h5", tmp_path / "few.parquet", long=long)
    assert not {"at_bound", "outside"} & {
        *parquet.read_table(tmp_path / "few.parquet").column_names
    }


def test_a_circuit_of_impedance_py_has_the_identified_values(fits, file, tmp_path):
    target = tmp_path / "skin.json"
    etid.export_circuit(file, target, "recording/07")
    elements = fits[7].circuit
    assert json.loads(target.read_text("utf-8")) == {
        "Name": "recording/07, by etid",
        "Circuit String": "R0-p(R1,C1)",
        "Initial Guess": [float(value) for value in (elements.r_s, elements.r_p, elements.c_p)],
        "Constants": {},
        "Fit": False,
    }


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("recording/04", 'is insensitive, not usable; its circuit is not exported. is "flat"'),
        ("path 99", "there is no fit of 'path 99'; the fits are of 'recording/00', "),
        (None, "say which recording; the fits are of 'recording/00', "),
    ],
)
def test_a_circuit_that_is_not_there_or_no_success_is_not_written(path, words, file, tmp_path):
    for suffix in exporting.CIRCUITS:
        with pytest.raises(ValueError, match=re.escape(words)):
            etid.export_circuit(file, tmp_path / f"a{suffix}", path)
        assert not (tmp_path / f"a{suffix}").exists()


def test_a_missing_package_is_named_with_its_extra(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert cli.main(["export", "fits.h5", "-o", "t.parquet"]) == 1
    assert re.search(r"needs the package pyarrow.*'etid\[parquet", capsys.readouterr().err)
    assert [*tmp_path.glob("t.*")] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("absent.h5 -o t.csv", "absent.h5: there is no such file"),
        ("garbage.h5 -o t.csv", "garbage.h5: is not an HDF5 file"),
        ("study.h5 -o t.csv", "schema: is 'etid/recording', not 'etid/fits'"),
        ("fits.h5 -o t.xlsx", "t.xlsx: the file is not written as .xlsx; name it t.csv"),
        ("fits.h5 -o t.abc", "t.abc: fits are exported as .csv or .parquet, not '.abc'"),
        ("study.h5 -o t.nwb", "t.nwb: the file is not written as .nwb; name it t.csv"),
        ("fits.h5 -o t.csv --path path", "t.csv: --path is only for .cir and"),
        ("fits.h5 -o t.cir", "say which recording"),
        ("short.h5 -o t.csv", "chi2: the column is missing"),
        ("fits.h5 -o t.json --long", "t.json: --long is only for .csv and .parquet"),
        ("fits.h5 -o t.cir --all", "t.cir: --all is only for .csv and .parquet"),
    ],
)
def test_what_cannot_be_exported_is_one_line(arguments, words, file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "garbage.h5").write_bytes(b"no HDF5")
    etid.Study({}).write(tmp_path / "study.h5")
    (tmp_path / "short.h5").write_bytes(file.read_bytes())
    with h5py.File(tmp_path / "short.h5", "a") as content:
        del content["chi2"]
    before = sorted(tmp_path.iterdir())
    assert cli.main(["export", *arguments.split()]) == 1
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 1
    assert words in complaints[0]
    assert sorted(tmp_path.iterdir()) == before
