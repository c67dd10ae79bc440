"""Two processes that compute one file: the second says who writes it, and changes nothing."""

import json
import os
import platform
import subprocess
import sys

import pytest

import etid
from benchmarks.specimens import study_fits
from etid import cli
from etid.identify import file as streaming
from etid.recordings import replacing
from etid.recordings.errors import RecordingError
from etid.recordings.replacing import claimed
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


HOLDS = """
import sys, time
from etid.recordings.replacing import claimed
with claimed(sys.argv[1]):
    print("holding", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def command(tmp_path, monkeypatch):
    """`etid fit` of six recordings in two parts that are fitted at once."""
    skin = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    trials = tuple(Trial(f"s01/{i}", skin) for i in range(6))
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=400)
    scene.simulate(seed=3).write(tmp_path / "study.h5")
    monkeypatch.setattr(streaming, "PART", 3)
    monkeypatch.setattr(streaming, "_fit", lambda *_: study_fits())
    return ["fit", str(tmp_path / "study.h5"), "-o", str(tmp_path / "fits.h5")]


@pytest.mark.skipif(replacing.fcntl is None, reason="this system has no locks of files")
def test_the_second_fit_says_who_writes_until_the_first_is_killed(command, tmp_path, capsys):
    parts = tmp_path / "fits.h5.parts"
    parts.mkdir()
    (parts / "run.json").write_text(json.dumps({"recordings": 6, "size of a part": 3}))
    (parts / "000000.h5").write_bytes(b"of the first")
    first = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path / "fits.h5")], stdout=subprocess.PIPE, text=True
    )
    try:
        assert first.stdout is not None
        assert first.stdout.readline() == "holding\n"
        before = contents(tmp_path)
        for option in ([], ["--resume"], ["--force"], ["--joint"]):
            assert cli.main([*command, *option]) == 1
            assert capsys.readouterr().err == (
                f"etid: error: {tmp_path}/fits.h5: process {first.pid} on {platform.node()} is "
                "writing it. Wait until it has ended, or name another file.\n"
            )
        assert contents(tmp_path) == before
    finally:
        first.kill()
        first.communicate()
    assert (tmp_path / "fits.h5.lock").exists()  # which locks nothing now
    assert cli.main([*command, "--force"]) == 0
    assert len(etid.Fits.read(tmp_path / "fits.h5")) == 12
    assert {path.name for path in tmp_path.iterdir()} == {"study.h5", "fits.h5"}


def test_other_files_of_a_folder_are_free(tmp_path):
    with claimed(tmp_path / "a.h5"), claimed(tmp_path / "b.h5"):
        pass
    with claimed(tmp_path / "a.h5"):  # again
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_the_user_is_no_lock(tmp_path):
    lock = tmp_path / "fits.h5.lock"
    lock.write_text("my keys")
    with pytest.raises(RecordingError, match=r"fits\.h5\.lock beside it is no lock of etid"):
        with claimed(tmp_path / "fits.h5"):
            pass
    assert lock.read_text() == "my keys"


def test_a_lock_that_is_removed_while_it_is_opened_is_made_anew(tmp_path, monkeypatch):
    """The first process ends between the moments when the second opens and locks its file."""
    flock, stale = replacing.fcntl.flock, []

    def late(held, how):
        if not stale:
            stale.append(os.unlink(tmp_path / "fits.h5.lock"))
        flock(held, how)

    monkeypatch.setattr(replacing.fcntl, "flock", late)
    with claimed(tmp_path / "fits.h5"):
        assert (tmp_path / "fits.h5.lock").read_text() == (
            f"process {os.getpid()} on {platform.node()}"
        )
    assert stale == [None]


def test_a_file_system_without_locks_refuses_nobody(tmp_path, monkeypatch):
    def missing(*_):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(replacing.fcntl, "flock", missing)
    with claimed(tmp_path / "fits.h5"), claimed(tmp_path / "fits.h5"):
        pass
