"""The benchmarks themselves: what they measure on, and that each runs and says what it should."""

import csv

import h5py
import numpy as np
import pytest

import etid
from benchmarks import scale
from benchmarks.large_file import LAYOUTS, SAMPLES, large_file
from benchmarks.provenance import write_csv

FEW = 12  # recordings


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_large_file_follows_the_schema_and_is_made_once(layout, tmp_path):
    path = large_file(tmp_path, FEW, layout)
    assert etid.check(path) == []
    with etid.read(path) as study:
        assert len(study.loaded) == FEW
        assert len(study.calibrations) == 1
        first, second = (study[f"s0000/skin/{row}"] for row in (0, 1))
    assert first.v_out.size == SAMPLES
    assert round(first.periods, 6) == 3
    assert (first.v_out != second.v_out).any()
    before = path.stat().st_mtime_ns
    assert large_file(tmp_path, FEW, layout).stat().st_mtime_ns == before


def test_the_layouts_hold_the_same_samples(tmp_path):
    stacks = []
    for layout in LAYOUTS:
        with h5py.File(large_file(tmp_path, FEW, layout)) as file:
            stacks.append(np.asarray(file["s0000/skin/v_out"]))
    np.testing.assert_array_equal(stacks[0], stacks[1])
    np.testing.assert_array_equal(stacks[0], stacks[2])


def test_files_are_compared_bit_by_bit(tmp_path):
    one, other = tmp_path / "one.h5", tmp_path / "other.h5"
    for path, last in (one, 2.0), (other, np.nextafter(2.0, 3.0)):
        with h5py.File(path, "w") as file:
            file["x"] = [np.nan, last]
            file["note"] = ["a text", "another"]
    assert scale._same(one, one)
    assert not scale._same(one, other)


def test_a_table_says_where_it_comes_from(tmp_path):
    write_csv(tmp_path / "deep" / "table.csv", [{"what": "a, b", "seconds": 1.5}])
    with (tmp_path / "deep" / "table.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["what"], row["seconds"], row["etid"]) == ("a, b", "1.5", etid.__version__)
    assert row["commit"]
    assert row["machine"]


@pytest.mark.slow
def test_scale_measures_everything_and_a_killed_run_loses_nothing(tmp_path):
    plan = scale.Plan(tmp_path, 60, 6, ("equation_error",), "equation_error")
    rows = list(scale.rows(plan))
    assert len(rows) == 3 * 3 + 4  # three ways to read three layouts, fitted by 1, 2, 1, 1 process
    assert all(row["seconds"] > 0 and row["memory_mb"] > 0 for row in rows)
    resumed = scale.resume(plan)
    assert resumed.passed
    assert resumed.parts == 10
    assert resumed.killed_at == sorted(resumed.killed_at)
