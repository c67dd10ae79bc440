"""Two processes that compute one file: the second is refused, and changes nothing."""

import json
import subprocess
import sys

import pytest

import etid
from benchmarks.specimens import study_fits
from etid import cli
from etid.identify import file as streaming
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


def test_the_second_fit_is_refused_until_the_first_is_killed(command, tmp_path, capsys):
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
                f"etid: error: {tmp_path}/fits.h5: another program is writing it. "
                "Wait until it has ended, or name another file.\n"
            )
        assert contents(tmp_path) == before
    finally:
        first.kill()
        first.communicate()
    assert (tmp_path / ".fits.h5.lock").exists()  # which locks nothing now
    assert cli.main([*command, "--force"]) == 0
    assert len(etid.Fits.read(tmp_path / "fits.h5")) == 12
    assert {path.name for path in tmp_path.iterdir()} == {"study.h5", "fits.h5"}


def test_other_files_of_a_folder_are_free(tmp_path):
    with claimed(tmp_path / "a.h5"), claimed(tmp_path / "b.h5"):
        pass
    with claimed(tmp_path / "a.h5"):  # again
        pass
    assert list(tmp_path.iterdir()) == []
