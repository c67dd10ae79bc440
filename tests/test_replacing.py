"""Files that are written whole or not at all."""

import pytest

from etid.recordings.recording import RecordingError
from etid.recordings.replacing import replacing


def test_a_file_is_as_it_was_until_all_is_written(tmp_path):
    target = tmp_path / "fits.csv"
    target.write_text("before")
    with replacing(target) as partial:
        partial.write_text("after")
        assert target.read_text() == "before"
        assert partial.suffix == ".csv"
    assert target.read_text() == "after"
    assert [path.name for path in tmp_path.iterdir()] == ["fits.csv"]


def test_a_writer_that_fails_leaves_nothing(tmp_path):
    target = tmp_path / "fits.csv"
    target.write_text("before")

    def fail():
        with replacing(target) as partial:
            partial.write_text("half")
            raise OSError("disk full")

    with pytest.raises(RecordingError, match=r"fits\.csv: cannot be written \(disk full\)"):
        fail()
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["fits.csv"]


def test_two_processes_may_write_one_file_at_once(tmp_path):
    target = tmp_path / "fits.csv"
    with replacing(target) as first, replacing(target) as second:
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # the outer block ends last
