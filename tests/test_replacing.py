"""Files that are written whole or not at all."""

import pytest

import etid
from benchmarks.specimens import study_fits
from etid.recordings.recording import RecordingError
from etid.recordings.replacing import claimed, replace_text, replacing


def test_a_file_is_as_it_was_until_all_is_written(tmp_path):
    target = tmp_path / "fits.csv"
    target.write_text("before")
    with replacing(target) as partial:
        partial.write_text("after")
        assert target.read_text() == "before"
        assert partial.suffix == ".csv"
    assert target.read_text() == "after"
    assert [path.name for path in tmp_path.iterdir()] == ["fits.csv"]


@pytest.mark.parametrize("existing", [True, False])
def test_a_link_stays_and_the_file_behind_it_is_written(tmp_path, existing):
    (tmp_path / "folder").mkdir()
    behind, link = tmp_path / "folder" / "fits.csv", tmp_path / "link.csv"
    if existing:
        behind.write_text("before")
    link.symlink_to("folder/fits.csv")
    replace_text(link, "after")
    assert link.is_symlink()
    assert behind.read_text() == "after"
    assert list(behind.parent.iterdir()) == [behind]


@pytest.mark.parametrize("write", [claimed, replacing])
def test_an_error_names_the_file_of_the_user_alone(tmp_path, write):
    (tmp_path / "folder").touch()
    target = tmp_path / "folder" / "fits.csv"  # no file can be there
    with pytest.raises(RecordingError) as refused, write(target) as partial:
        partial.write_text("")
    assert str(refused.value).startswith(f"{target}: cannot be written (")
    assert str(refused.value).count("fits") == 1


def test_two_processes_may_write_one_file_at_once(tmp_path):
    target = tmp_path / "fits.csv"
    with replacing(target) as first, replacing(target) as second:
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # the outer block ends last


def test_results_are_not_written_under_the_name_of_another_format(tmp_path):
    for result in (study_fits().fits, study_fits(), etid.Study({})):
        with pytest.raises(RecordingError, match=r"not written as \.csv; name it all\.h5"):
            result.write(tmp_path / "all.csv")
    assert list(tmp_path.iterdir()) == []
