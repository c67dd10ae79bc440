"""Tables of text as programs write them: suffixes, blanks, lines above, columns of one name."""

import pathlib

import numpy as np
import pytest

import etid
from etid.cli import main
from etid.files.readers import delimited
from tests.lab_files import imported, refused

GIVEN = {"sample_rate": 2e5, "pulse_rate": 60.0, "scale": 1.0}
TH, OUT = np.array([1.0, 3.0, 5.0]), np.array([2.0, 4.0, 6.0])


def column(path, name, **told):
    """The numbers of one column of a table."""
    with delimited.opened(path, path.parent, **told) as contents:
        contents.prepare({name})
        return np.concatenate(list(contents.channel(name).blocks()))


@pytest.mark.parametrize("suffix", [".txt", ".dat", ".CSV"])
def test_a_table_of_text_is_read_whatever_its_suffix(suffix, tmp_path):
    path = tmp_path / f"finger{suffix}"
    path.write_text("open,skin\n1,2\n3,4\n5,6\n")
    recordings, _ = imported(path, v_th="open", v_out="skin", **GIVEN)
    np.testing.assert_array_equal(recordings["loaded/0"].v_th, TH)
    path.write_text("open;skin\n1,0;2\n3,0;4\n5,0;6\n")
    told = {"delimiter": ";", "decimal": ","}
    refused(path, None, "--delimiter ';' --decimal ','", v_th="open", v_out="skin", **GIVEN)
    recordings, _ = imported(path, v_th="open", v_out="skin", **GIVEN, **told)
    np.testing.assert_array_equal(recordings["loaded/0"].v_out, OUT)


ALIGNED = "  open    skin\n  1.0     2.0\n 3.0  \t 4.0\n  5.0e0   6.0\n"


def test_blanks_between_the_cells_are_confirmed_and_then_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(ALIGNED)
    names = {"v_th": "open", "v_out": "skin"}
    refused(path, None, "columns open, skin.*add --delimiter ' '", **names, **GIVEN)
    recordings, _ = imported(path, delimiter=" ", **names, **GIVEN)
    np.testing.assert_array_equal(recordings["loaded/0"].v_th, TH)
    np.testing.assert_array_equal(recordings["loaded/0"].v_out, OUT)


def test_names_that_contain_blanks_are_not_shifted(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("V open (V)  V skin (V)\n1 2\n3 4\n5 6\n")
    names = {"v_th": "1", "v_out": "2"}
    refused(path, None, "columns 1, 2.*--delimiter ' ' --header-line 0", **names, **GIVEN)
    recordings, _ = imported(path, delimiter=" ", header_line=0, **names, **GIVEN)
    np.testing.assert_array_equal(recordings["loaded/0"].v_out, OUT)


@pytest.mark.parametrize(
    ("text", "name", "delimiter"),
    [
        ("a title\nN 15 0 1 1 M\n1\n3\n5\n", "1", " "),
        ("1\n3\n5\n", "1", " "),
        ("rate,9,1,2\n,,3,4\n,,5,6\n", "3", ","),  # a preamble beside the numbers
    ],
)
def test_lines_above_a_table_without_names_are_no_rows(text, name, delimiter, tmp_path):
    path = tmp_path / "a.dat"
    path.write_text(text)
    np.testing.assert_array_equal(column(path, name, header_line=0, delimiter=delimiter), TH)


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("1,\n3,4\n5,6\n", "2", "line 1 has '' in column 2"),  # a row without a cell
        ("model,7\n1,2\n3,4\n5,6\n", "1", "line 1 has 'model' in column 1"),
    ],
)
def test_a_first_line_that_may_be_a_row_is_not_left_out(text, name, message, tmp_path):
    path = tmp_path / "a.dat"
    path.write_text(text)
    with pytest.raises(etid.RecordingError, match=message):
        column(path, name, header_line=0)


def test_the_classic_record_of_a_hair_dryer_is_read(reference_data):
    path = reference_data("hair_dryer") / "IB01AD.dat"
    numbers = column(path, "1", delimiter=" ", header_line=0)
    assert numbers.size == 2000  # 1000 of the input, then 1000 of the output
    np.testing.assert_array_equal(numbers[:3], [6.41, 3.41, 6.41])
    assert set(numbers[:1000]) == {3.41, 6.41}  # the heater has two settings
    assert numbers[1000:].std() > 0.1


TWICE = "TIME,CH1,TIME,CH1\ns,V,s,mV\n0,1,0,2\n5e-6,3,5e-6,4\n1e-5,5,1e-5,6\n"


def test_columns_of_one_name_are_told_by_their_place(tmp_path):
    path = tmp_path / "scope.csv"
    path.write_text(TWICE)
    fields = {"pulse_rate": 60.0, "scale": 1.0}
    refused(
        path, None, r"v_th: 2 columns have the name 'CH1'\. .*: 'CH1#2' or 'CH1#4'",
        v_th="CH1", v_out="CH1#4", time="TIME#1", **fields,
    )  # fmt: skip
    recordings, [used] = imported(path, v_th="CH1#2", v_out="CH1#4", time="TIME#3", **fields)
    np.testing.assert_array_equal(recordings["loaded/0"].v_th, TH)
    np.testing.assert_allclose(recordings["loaded/0"].v_out, 1e-3 * OUT)
    assert str(used.signals["v_out"]) == "'CH1#4' in mV (file)"


def test_a_column_that_is_not_named_is_not_proposed(tmp_path, capsys):
    """The first column of a table is often the time."""
    path = tmp_path / "scope.csv"
    path.write_text("t,CH1,CH2\n0,1,2\n5e-6,3,4\n")
    assert main(["import", str(path), "-o", str(tmp_path / "a.h5")]) == 1
    error = capsys.readouterr().err
    assert "the channels are 't', 'CH1', 'CH2'" in error
    assert "as in --v-th NAME --v-out NAME --pulse-rate 60 --scale 1;" in error


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"delimiter": ";;"}, "delimiter: is ';;', must be one character"),
        ({"decimal": "x"}, "decimal: is 'x', must be '.' or ','"),
        ({"decimal": ",", "header_line": 1}, "decimal: is ',', must be another character than the"),
        ({"header_line": -1}, "header_line: is -1, must be the number of a line"),
        ({"encoding": "utf9"}, "encoding: is 'utf9', must be an encoding of Python"),
    ],
)
def test_what_cannot_be_the_way_of_a_table_is_named(told, message, tmp_path):
    path = pathlib.Path(tmp_path / "a.csv")
    path.write_text("open,skin\n1,2\n3,4\n")
    refused(path, None, message, v_th="open", v_out="skin", **GIVEN, **told)
