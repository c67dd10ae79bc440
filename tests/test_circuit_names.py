"""Fits of a circuit of one's own in files: which circuit it is, report, export, the command."""

import csv
import dataclasses
import sys

import h5py
import numpy as np
import pytest

import etid
from benchmarks.ladder import rung
from etid import cli
from etid.circuits import lookup
from etid.simulation.scenes import Trial

DONE, WRONG_DATA, WRONG_USAGE = 0, 1, 2
SIGMAS = 5.0  # one in 2e6; with a fixed seed a test passes always or never
MODULE = '''
import etid
from etid.circuits.elements import Ohm, Second

class Spread(etid.AbstractCircuit):
    """As etid.SkinRC, with other names."""

    outer: Ohm = etid.parameter("ohm", typical=20e3)
    inner: Ohm = etid.parameter("ohm", typical=100e3)
    slow: Second = etid.parameter("second", typical=30e-6)

    def impedance(self):
        capacitor = etid.capacitor(self.slow / self.inner)
        both = etid.parallel(etid.resistor(self.inner), capacitor)
        return etid.series(etid.resistor(self.outer), both)
'''
TRUTH = etid.SkinRC(33.4e3, 186e3, 22e-6 / 186e3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study of two recordings, a module with a circuit, and the fits that the command made."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "lab_skins.py").write_text(MODULE)
    trials = tuple(Trial(f"skin/{i}", TRUTH, subject="s01") for i in range(2))
    dataclasses.replace(rung("dry"), trials=trials).simulate(3).write(folder / "study.h5")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path])
        asked = ("--circuit", "lab_skins:Spread")
        assert cli.main(["fit", "study.h5", "-o", "fits.h5", *asked]) == DONE
        yield folder
    sys.modules.pop("lab_skins", None)


@pytest.fixture
def files(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def test_the_command_fits_a_circuit_of_ones_own(files):
    fits = etid.Fits.read("fits.h5")
    assert type(fits.circuit).__module__ == "lab_skins"
    assert fits.counts() == {"successful": 2}
    error = np.asarray(fits.circuit.values()) - np.array([33.4e3, 186e3, 22e-6])
    assert (np.abs(error) < SIGMAS * np.asarray(fits.stderr.values())).all()
    with h5py.File("fits.h5") as content:
        assert content.attrs["circuit"] == "lab_skins:Spread"


def test_its_fits_are_reported_and_exported(files):
    assert cli.main(["report", "fits.h5"]) == DONE
    page = (files / "fits.html").read_text("utf-8")
    assert "identified as Spread" in page
    assert "slow [µs]" in page
    assert cli.main(["export", "fits.h5", "-o", "fits.csv"]) == DONE
    with open("fits.csv", newline="", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert [float(row["slow [second]"]) for row in rows] == pytest.approx([22e-6] * 2, rel=0.1)
    chosen = ("--path", "skin/1", "--circuit", "lab_skins:Spread")
    starts = {"skin.cir": "* skin/1, by maximum_likelihood\n* Spread", "skin.json": "{"}
    for name, start in starts.items():
        assert cli.main(["export", "fits.h5", "-o", name, *chosen]) == DONE
        assert (files / name).read_text("utf-8").startswith(start)


def test_a_file_imports_nothing_and_says_what_to_import(files, tmp_path, capsys, monkeypatch):
    """A module beside a hostile file must not run because the file is read."""
    (tmp_path / "absent_lab.py").write_text("raise SystemExit('imported')")
    other = tmp_path / "fits.h5"
    other.write_bytes((files / "fits.h5").read_bytes())
    with h5py.File(other, "a") as content:
        content.attrs["circuit"] = "absent_lab:Spread"
    monkeypatch.chdir(tmp_path)
    for arguments in (("report", "fits.h5"), ("export", "fits.h5", "-o", "skin.cir")):
        assert cli.main(arguments) == WRONG_DATA
        (line,) = capsys.readouterr().err.splitlines()
        assert "fits.h5, circuit: is 'absent_lab:Spread'. absent_lab is not imported" in line
        assert line.endswith("add --circuit absent_lab:Spread.")
    assert "absent_lab" not in sys.modules
    assert etid.Fits.read(other, lookup.imported("lab_skins:Spread")).counts()


@pytest.mark.parametrize(
    ("stored", "says"),
    [
        ("etid:SkinOil", "etid has no such circuit: read the file with the version of etid"),
        ("__main__:Mine", "Mine was defined in a script or a notebook"),
        ("os:system", "os is not imported, and etid imports no module because a file names it"),
        ("SkinRC", "This is not a name of a circuit"),
        ("__import__('os').abort():x", "This is not a name of a circuit"),
        ("lab_skins:Other", "lab_skins is not imported"),
    ],
)
def test_an_unknown_circuit_is_one_error(files, tmp_path, stored, says):
    other = tmp_path / "fits.h5"
    other.write_bytes((files / "fits.h5").read_bytes())
    with h5py.File(other, "a") as content:
        content.attrs["circuit"] = stored
    with pytest.raises(etid.RecordingError, match=rf"fits\.h5, circuit: .*{says}"):
        etid.Fits.read(other)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (
            "SkinOil",
            "no circuit 'SkinOil' in etid; did you mean SkinCole? Or use one of ParallelRC, ",
        ),
        ("absent_lab:Mine", "cannot import absent_lab: ModuleNotFoundError"),
        ("lab_skins:Other", "Other of lab_skins is None, not a subclass of etid.AbstractCircuit"),
        ("lab_skins:etid", "not a subclass of etid.AbstractCircuit"),
    ],
)
def test_what_is_no_circuit_is_wrong_usage(files, capsys, name, says):
    with pytest.raises(SystemExit) as stop:
        cli.main(["fit", "study.h5", "-o", "new.h5", "--circuit", name])
    assert stop.value.code == WRONG_USAGE
    assert says in capsys.readouterr().err
