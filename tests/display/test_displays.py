"""The example of a stream, which `etid simulate --stream` writes and `etid-live --file` plays."""

import json
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest

import etid
from etid import cli
from etid.display import Controller, Tracker
from etid.display import view as views
from etid.display.loop import follow
from etid.display.stream import played
from etid.display.view import LiveView
from etid.simulation import displays
from tests.display.test_live import shown
from tests.display.test_online import TEN

RATE = 200e3
PULSES = 27  # 9 in each part


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Files of recordings and of a stream of ten electrodes, of which the command wrote both."""
    folder = tmp_path_factory.mktemp("stream")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(displays, "ELECTRODES", TEN)
        patched.setattr(displays, "WET", slice(3, 5))
        patched.setattr(displays, "REPEATS", 3)
        study, stream = folder / "study.h5", folder / "pulses.h5"
        command = ["simulate", "paper_dry", "-o", str(study), "--stream", str(stream), "--json"]
        assert cli.main(command) == 0
    return study, stream


@pytest.fixture(scope="module")
def tracker(written):
    with etid.read(written[0]) as study:
        calibration = study["calibration/98k8"]
        driver = etid.identify_driver(calibration)
        return Tracker.of(driver, calibration, electrodes=TEN, change=3e-3)


def test_a_stream_has_skin_that_becomes_wet_and_a_contact_that_is_lost(written, tracker):
    blocks = played(written[1], TEN, RATE, 1e3)
    ticks = list(follow(blocks, Controller.of(tracker), charge=80e-9))
    assert len(ticks) == PULSES
    before, after, last = (tracker.read(ticks[at].state) for at in (8, 17, 26))
    for fits in (before, after):
        assert set(fits.verdicts) == {"successful"}
    wet = (np.arange(TEN) >= 3) & (np.arange(TEN) < 5)
    fell = after.circuit.r_p / before.circuit.r_p
    np.testing.assert_allclose(fell, np.where(wet, 17.4 / 186, 1.0), rtol=0.05)  # some σ
    assert tracker.bad_electrodes(ticks[-1].state) == {TEN - 1: "open"}
    assert last.verdicts[0] == "successful"
    # Noise that came back would be no measurement.
    windows = np.stack([tick.window[0] for tick in ticks[:9]])
    noise = windows[3:] - windows[:-3]  # periods are whole samples after three
    assert abs(np.corrcoef(noise[0], noise[3])[0, 1]) < 0.6  # -1/2 by the shared window
    assert noise.std() == pytest.approx(np.sqrt(2) * 0.00968, rel=0.05)


def test_an_electrode_above_the_cap_of_a_recorded_stream_is_an_alarm(written, tracker, monkeypatch):
    """The pulses of a file carry what they carry: 130 nC through dry skin, more through wet."""
    monkeypatch.setattr(views, "EVERY", 0.0)
    controller, found = Controller.of(tracker, charge_cap=200e-9), {}
    with LiveView(controller, charge=80e-9, controls=False, port=0) as view:
        view._spare = np.inf  # a slow tick is shown, too
        blocks = played(written[1], TEN, RATE, 1e3)
        for tick in follow(blocks, controller, charge=80e-9, view=view):
            if tick.number in (8, 16):
                found[tick.number] = shown(view)
    assert found[8]["words"] == ["good"] * TEN
    assert 100 < min(found[8]["charge"]) < max(found[8]["charge"]) < 200
    above = ["above the charge cap" if at in (3, 4) else "good" for at in range(TEN)]
    assert found[16]["words"] == above
    assert min(found[16]["charge"][3:5]) > 500
    assert any("above the charge cap, at E4, E5" in alarm for alarm in found[16]["alarms"])


def test_the_program_plays_it_to_its_end_and_says_what_the_guide_says(written):
    study, stream = map(str, written)
    command = [sys.executable, "-m", "etid.display", study, "--file", stream, "--json"]
    command += ["--electrodes", "10", "--speed", "100", "--port", "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    counts = {"pulses": PULSES, "incomplete": 0, "late": 0, "pauses": 0, "stopped": False}
    assert told == {"command": "etid-live", "status": 0, "source": stream, **counts}
    page = (pathlib.Path(__file__).parents[2] / "docs" / "command_line.md").read_text("utf-8")
    (row,) = re.findall(r"^\| `etid-live` \| (.*) \|$", page, flags=re.MULTILINE)
    assert told.keys() - {"command", "status"} <= set(re.findall(r"`(\w+)`", row))
