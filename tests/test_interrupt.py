"""Ctrl-C: a real signal to a real process ends in one line that says what was kept, and in 130."""

import signal
import subprocess
import sys

import pytest

from etid import cli

# The process waits where the signal is to come, after it has said so. A process that a shell starts
# in the background ignores Ctrl-C, and so do those that it starts, were it not for the second line.
WAITS = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from benchmarks.specimens import study_fits
from etid import cli
from etid.identify import file as streaming
from etid.recordings import hdf5

def wait(*_):
    print("waiting", flush=True)
    time.sleep(600)

def fit(drivers, options, total, part):
    return study_fits() if part[0] == "s01/0" else wait()
"""
FIT = f"""{WAITS}
streaming.PART, streaming._fit = 6, fit
sys.exit(cli.main(["fit", sys.argv[1], "-o", sys.argv[2]]))
"""
FIRST = f"""{WAITS}
streaming.read = wait
sys.exit(cli.main(["fit", sys.argv[1], "-o", sys.argv[2]]))
"""

# As a terminal does, it interrupts its workers, too: they have just begun their imports.
WORKERS = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from etid import cli
from etid.identify import file as streaming

def interrupt(futures):
    time.sleep(0.3)
    os.killpg(0, signal.SIGINT)
    time.sleep(600)

streaming.PART, streaming.concurrent.futures.as_completed = 6, interrupt
sys.exit(cli.main(["fit", sys.argv[1], "-o", sys.argv[2], "--workers", "2"]))
"""


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """Status, lines on stderr and folder of each process, which run side by side."""
    from etid.simulation.scenes import Scene, Trial
    from etid.simulation.transformer import ResistorLoad, SkinLoad

    folder = tmp_path_factory.mktemp("interrupted")
    skin = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    trials = tuple(Trial(f"s01/{i}", skin) for i in range(14))
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=400)
    scene.simulate(seed=3).write(folder / "study.h5")
    started = {
        name: subprocess.Popen(
            [sys.executable, "-c", code, folder / "study.h5", folder / f"{name}.h5"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name, code in {"fit": FIT, "first": FIRST}.items()
    }
    found = {}
    for name, process in started.items():
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()  # closes its pipes
        found[name] = process.returncode, errors.splitlines(), folder
    return found


def test_ctrl_c_says_what_was_kept_and_how_to_go_on(interrupted):
    status, errors, folder = interrupted["fit"]
    assert (status, errors) == (
        130,
        [
            f"etid: interrupted: 6 of 14 recordings are fitted and kept in {folder}/fit.h5.parts; "
            "to continue, add --resume to the same command"
        ],
    )
    assert (folder / "fit.h5.parts" / "000000.h5").exists()


def test_what_was_kept_is_not_thrown_away_unasked(interrupted, capsys):
    _, _, folder = interrupted["fit"]
    assert cli.main(["fit", str(folder / "study.h5"), "-o", str(folder / "fit.h5")]) == 1
    error = capsys.readouterr().err
    assert "6 of 14 recordings are fitted and kept" in error
    assert error.endswith("add --resume to continue, or --force to begin again\n")
    assert (folder / "fit.h5.parts" / "000000.h5").exists()


def test_ctrl_c_before_the_first_part_says_that_nothing_was_kept(interrupted):
    status, errors, folder = interrupted["first"]
    assert status == 130
    assert errors == [
        f"etid: interrupted: {folder}/first.h5 was not written, and nothing was kept: run the same "
        "command again"
    ]


def test_workers_that_are_interrupted_in_their_imports_are_silent(interrupted, tmp_path):
    _, _, folder = interrupted["first"]
    command = [sys.executable, "-c", WORKERS, folder / "study.h5", tmp_path / "fits.h5"]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, start_new_session=True
    )
    assert done.returncode == 130
    assert done.stderr.splitlines() == [
        f"etid: interrupted: {tmp_path}/fits.h5 was not written, and nothing was kept: run the "
        "same command again"
    ]
