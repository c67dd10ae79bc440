"""A disk that is full: one line, status 1, every file as it was, and `--resume` continues."""

import json
import os
import pathlib
import subprocess
import sys

import pytest

import etid
from benchmarks.specimens import study_fits
from etid import cli
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

resource = pytest.importorskip("resource", reason="only POSIX limits the size of files")

# Runs the command of each line while no file may exceed a size, as on a disk with this much space.
# One process for all: HDF5 would crash at its end, and importing etid takes long.
COMMANDS = """
import contextlib, io, json, resource, sys
from benchmarks.specimens import study_fits
from etid import cli
from etid.identify import file as streaming

streaming.PART, streaming._fit = 6, lambda *_: study_fits()
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
for line in sys.stdin:
    size, arguments = json.loads(line)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, unlimited[1]))
    with contextlib.redirect_stderr(io.StringIO()) as errors, contextlib.redirect_stdout(None):
        status = cli.main(arguments)
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    print(json.dumps([status, errors.getvalue()]), flush=True)
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    skin = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    trials = tuple(Trial(f"s01/{i}", skin) for i in range(14))
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=400)
    path = tmp_path_factory.mktemp("full") / "study.h5"
    scene.simulate(seed=3).write(path)
    return path


@pytest.fixture(scope="module")
def on_disk_of():
    """Status and stderr of a command while files may have so many bytes."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", COMMANDS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        to, back = process.stdin, process.stdout
        assert to is not None
        assert back is not None

        def run(size, *arguments):
            print(json.dumps([size, [*map(str, arguments)]]), file=to, flush=True)
            return tuple(json.loads(back.readline()))

        yield run
        _, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")


@pytest.mark.parametrize(
    ("command", "name", "parts"),
    [
        # A file whose metadata, first samples, last samples or end cannot be written.
        ("simulate", "out.h5", (0, 0.001, 0.5, 0.999)),
        ("merge", "out.h5", (0, 0.001, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.99, 0.999)),
        ("fit", "out.h5", (0, 0.001, 0.01, 0.1, 0.3)),  # the parts
        ("fit", "out.h5", (0.9, 0.99, 0.999)),  # the whole
        ("export", "out.csv", (0, 0.5)),
        ("export", "out.parquet", (0, 0.5, 0.999)),
        ("export", "out.cir", (0.5,)),
    ],
)
def test_a_full_disk_ends_a_command_in_one_line_and_changes_no_file(
    study, on_disk_of, tmp_path, command, name, parts
):
    fits, target = tmp_path / "fits.h5", tmp_path / name
    study_fits().write(fits)
    arguments = {
        "simulate": ("simulate", "paper_dry", "-o", target),
        "merge": ("merge", study, "-o", target),
        "fit": ("fit", study, "-o", target),
        "export": ("export", fits, "-o", target),
    }[command]
    if name == "out.cir":
        arguments += ("--path", "loaded/0")
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    assert on_disk_of(unlimited, *arguments)[0] == 0
    before = target.read_bytes()
    for part in parts:
        status, errors = on_disk_of(int(part * len(before)), *arguments, "--force")
        assert status == 1
        (line,) = errors.splitlines()
        assert line.startswith(f"etid: error: {target}")
        assert "cannot be written (" in line
        assert "File too large" in line
        assert line.endswith("Check folder, permissions and disk space.")
        assert target.read_bytes() == before
        assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_a_run_on_a_full_disk_is_resumed(study, on_disk_of, tmp_path):
    unlimited, kept = resource.getrlimit(resource.RLIMIT_FSIZE)[1], tmp_path / "fits.h5.parts"
    command = ("fit", study, "-o", tmp_path / "fits.h5")
    assert on_disk_of(500, *command)[0] == 1
    assert [path.name for path in kept.iterdir()] == []
    part = tmp_path / "part.h5"
    study_fits().write(part)
    # The whole is larger than a part.
    assert on_disk_of(int(1.2 * part.stat().st_size), *command)[0] == 1
    names = {path.name for path in kept.iterdir()}
    assert names >= {"000000.h5", "000001.h5", "000002.h5"}
    status, errors = on_disk_of(unlimited, *command)
    assert (status, "14 of 14 recordings are fitted and kept" in errors) == (1, True)
    assert on_disk_of(unlimited, *command, "--resume") == (0, "")
    assert len(etid.Fits.read(tmp_path / "fits.h5")) == 18
    assert not kept.exists()


def test_an_import_blames_the_folder_of_its_output_and_not_its_input(on_disk_of, tmp_path):
    table, folder = tmp_path / "table.csv", tmp_path / "out"
    folder.mkdir()
    table.write_text("open,skin\n" + "0.5,0.25\n" * 1000, "utf-8")
    arguments = ("--v-th=open", "--v-out=skin", "--sample-rate=2e5", "--pulse-rate=60", "--scale=1")
    status, errors = on_disk_of(5000, "import", table, "-o", folder / "out.h5", *arguments)
    assert status == 1
    assert errors.startswith(f"etid: error: {folder}: cannot be written (File too large")
    assert not [*folder.iterdir()]


def test_a_device_is_not_replaced_by_a_file(capsys):
    assert cli.main(["simulate", "paper_dry", "-o", os.devnull, "--force"]) == 1
    assert "this is a device or a pipe; name a file" in capsys.readouterr().err
    assert not pathlib.Path(os.devnull).is_file()
