"""A file of columns: what is written is read, and what is wrong is one error that names it."""

import h5py
import numpy as np
import pytest

from etid.recordings import limits
from etid.recordings.errors import RecordingError
from etid.results.hdf5_table import check_same_length, opened_table, write_table

KIND = "etid/test", "1.2"
COLUMNS = {
    "name": np.array(["a", "Ω", ""]),
    "size": np.array([1.5, np.nan, -np.inf]),
    "count": np.array([1, 2, 3]),
    "matrix": np.arange(12.0).reshape(3, 2, 2),
    "single": np.array([1.0, 2.0, 3.0], np.float32),
    "half": np.array([True, False, True]),
}
ATTRIBUTES = dict(zip(("schema", "schema_version"), KIND, strict=True)) | {
    "number": 3.5,
    "list": ["x", "y"],
    "texts": np.array([b"x", b"y"]),
}


@pytest.fixture
def path(tmp_path):
    written = tmp_path / "table.h5"
    write_table(written, COLUMNS, units={"size": "Ω"}, attributes=ATTRIBUTES)
    return written


def test_columns_units_and_attributes_are_kept(path):
    with h5py.File(path) as file:
        assert {name: dict(file[name].attrs) for name in file if dict(file[name].attrs)} == {
            "size": {"unit": "Ω"}
        }
    with opened_table(path, *KIND) as table:
        assert table.attributes == set(ATTRIBUTES)
        assert table.text("schema") == KIND[0]
        assert table.attribute("number") == 3.5
        assert table.attribute("list") == table.attribute("texts") == ["x", "y"]
        assert "size" in table
        assert "other" not in table
        kinds = {"name": "text", "size": "number", "count": "integer", "single": "number"}
        for name, kind in kinds.items():
            column = table.column(name, kind)
            np.testing.assert_array_equal(table.read(column), COLUMNS[name])
            np.testing.assert_array_equal(table.read(column, slice(1, 2)), COLUMNS[name][1:2])
        assert table.column("count", "number").shape == (3,)  # an integer is a number
        matrix = table.column("matrix", "number", (2, 2))
        np.testing.assert_array_equal(table.read(matrix), COLUMNS["matrix"])


@pytest.mark.parametrize(
    ("method", "arguments", "words"),
    [
        ("column", ("other", "number"), "the column is missing"),
        ("column", ("name", "number"), "is text, must be number"),
        ("column", ("name", "integer"), "is text, must be integer"),
        ("column", ("size", "text"), "is of type float64, must be text"),
        ("column", ("size", "integer"), "is of type float64, must be integer"),
        ("column", ("half", "number"), "is of type bool, must be number"),
        ("column", ("matrix", "number"), r"has shape \(3, 2, 2\), must be \(fit\)"),
        ("column", ("matrix", "number", (2, 3)), r"must be \(fit, 2, 3\)"),
        ("column", ("matrix", "number", (4,)), r"must be \(fit, 4\)"),
        ("column", ("size", "number", (1,)), r"has shape \(3,\), must be \(fit, 1\)"),
        ("column", ("group", "number"), "is not a column"),
        ("column", ("empty", "number"), r"has shape None, must be \(fit\)"),
        ("column", ("scalar", "number"), r"has shape \(\), must be \(fit\)"),
        ("column", ("wide", "number"), "is of type complex128, must be number"),
        ("column", ("elsewhere", "number"), "is a link to another file"),
        ("attribute", ("other",), "is missing"),
        ("attribute", ("wide",), "has dtype complex128"),
        ("text", ("number",), "is 3.5, must be text"),
        ("text", ("list",), r"is \['x', 'y'\], must be text"),
    ],
)
def test_a_wrong_column_or_attribute_is_one_error_that_names_it(path, method, arguments, words):
    with h5py.File(path, "a") as file:
        file.create_group("group")
        file["empty"] = h5py.Empty("f8")
        file["scalar"] = 1.0
        file["wide"] = np.ones(3, complex)
        file["elsewhere"] = h5py.ExternalLink("other.h5", "/size")
        file.attrs["wide"] = 1j
    with opened_table(path, *KIND) as table:
        with pytest.raises(RecordingError, match=words) as raised:
            getattr(table, method)(*arguments)
        assert raised.value.field == arguments[0]
        assert raised.value.file == str(path)


def test_more_rows_than_are_read_are_refused(path, monkeypatch):
    with opened_table(path, *KIND) as table:
        monkeypatch.setattr(limits, "FITS", 3)
        table.column("size", "number")
        monkeypatch.setattr(limits, "FITS", 2)
        with pytest.raises(RecordingError, match="has 3 rows, at most 2 are read"):
            table.column("size", "number")


@pytest.mark.parametrize(
    ("name", "value", "words", "remedy"),
    [
        ("schema", "etid/recording", "is 'etid/recording', not", "file of recordings"),
        ("schema", "etid/else", "is 'etid/else', not", "Name another file"),
        ("schema", None, "is None, not", "Name another file"),
        ("schema_version", "9.0", "is 9.0, this version of etid reads 1.x", "Fit the recordings"),
        ("schema_version", None, "is missing", "Fit the recordings"),
    ],
)
def test_a_file_of_another_schema_is_refused(path, name, value, words, remedy):
    with h5py.File(path, "a") as file:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = value
    with pytest.raises(RecordingError, match=words) as raised, opened_table(path, *KIND):
        pass
    assert remedy in str(raised.value)


def test_columns_of_different_lengths_are_refused(path):
    with opened_table(path, *KIND) as table:
        check_same_length(table, {})
        check_same_length(table, {"a": np.zeros(3), "b": np.zeros((3, 2))})
        with pytest.raises(RecordingError, match="has 2 rows, a has 3") as raised:
            check_same_length(table, {"a": np.zeros(3), "b": np.zeros(3), "c": np.zeros(2)})
        assert raised.value.field == "c"
