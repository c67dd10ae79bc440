"""The commands of docs/week.md, as a user types them."""

import pathlib
import re
import shlex

import numpy as np
import pytest

import etid
from etid.cli import main
from etid.simulation.scenes import Scene, SkinLoad, Trial
from etid.simulation.transformer import ResistorLoad

PAGE = pathlib.Path(__file__).parents[1] / "docs" / "week.md"
RATE, SCALE = 200e3, 0.0535
ELECTRODES = {1: 150e3, 2: 190e3}  # R_p


def commands():
    """The commands of the page that are not Python, in their order."""
    fence = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    blocks = [text for language, text in fence.findall(PAGE.read_text("utf-8")) if not language]
    lines = "".join(blocks).replace("\\\n", " ").replace("E{1..98}", "E1 E2").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.startswith("etid ")]


def write(path, loads, seed, periods=3.1):
    """A file as the page describes it: the voltages, and a trigger for each electrode."""
    size = round(periods * RATE / 60)
    trials = tuple(Trial(f"{number}", load) for number, load in loads.items())
    scene = Scene(trials, sample_rate=RATE, samples=size, snr_db=50.0, start=0.75 / 60)
    study = scene.simulate(seed)
    both = [(study[f"{number}"].v_th, study[f"{number}"].v_out) for number in loads]
    v_th, v_out = SCALE * np.concatenate(both, axis=1)
    trigger = np.tile(np.arange(size) == 100, len(loads))  # a pulse comes after 833 samples
    table = np.column_stack([v_th, v_out, trigger])
    np.savetxt(path, table, "%.6g,%.6g,%d", ",", header="CH1,CH2,CH3", comments="")


@pytest.fixture
def week(tmp_path, monkeypatch):
    """The files of two days, in a folder from which the commands run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "week").mkdir()
    for seed, day in enumerate(("d1", "d2")):
        write(tmp_path / "week" / f"{day}_98k8.csv", {0: ResistorLoad(98.8e3)}, 10 + seed, 3)
        skins = {n: SkinLoad(33.4e3, r_p, 0.12e-9) for n, r_p in ELECTRODES.items()}
        write(tmp_path / "week" / f"s01_index_{day}.csv", skins, 20 + seed)


def test_the_imports_of_the_page_make_recordings_of_each_electrode(week, capsys):
    words = [one for one in commands() if one[1] in ("import", "check")]
    assert [one[1] for one in words] == ["import", "import", "import", "check", "import"]
    for one in words:
        assert main(one[1:]) == 0, (one, capsys.readouterr().err)
    assert "week.h5: 6 recordings, no faults" in capsys.readouterr().out
    with etid.read("week.h5") as study, etid.read("d1.h5") as known:
        assert [one.r_load for one in known.recordings()] == [98.8e3]
        for one in study.loaded.recordings():
            assert one.calibration == (f"calibration/{one.session}/98800",)
            assert (one.subject, one.site, one.v_out.size) == ("s01", "index", 10_000)


@pytest.mark.slow
def test_every_command_of_the_page_runs_on_files_as_it_describes_them(week, capsys):
    words = commands()
    assert [one[1] for one in words] == [
        "import", "calibrate", "import", "calibrate", "import", "check", "fit", "import", "fit",
        "report", "export",
    ]  # fmt: skip
    for one in words:
        assert main(one[1:]) == 0, (one, capsys.readouterr().err)
    for file, sessions in (("fits.h5", {"d1", "d2"}), ("finger_fits.h5", {""})):
        fits = etid.Fits.read(file)
        assert fits.counts() == {"successful": len(ELECTRODES) * len(sessions)}
        assert {*fits.labels["session"].tolist()} == sessions
        for number, r_p in ELECTRODES.items():
            of = fits.where(electrode=f"E{number}")
            # Five standard errors: fewer than one in a million by chance.
            assert (abs(of.circuit.r_p - r_p) < 5 * of.stderr.r_p).all()
    assert "s01,d2,index,,E2" in pathlib.Path("fits.csv").read_text("utf-8")
    assert pathlib.Path("fits.html").stat().st_size > 10_000
