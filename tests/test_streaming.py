"""A file in parts: killed, resumed, spread over processes and a cluster, the result is the same."""

import concurrent.futures
import contextlib
import importlib
import os
import pathlib
import signal
import subprocess
import sys
import time
from typing import Any

import h5py
import numpy as np
import pytest
from tqdm import tqdm

import etid
from etid.identify import file as streaming
from etid.identify.file import ResumeError, fit_file
from etid.results.study_fits import StudyFits
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

# What is tested is the parts, not the fits, and it compiles fastest.
METHOD = "steiglitz_mcbride(iterations=1)"
PART = 4
COUNT = 14  # three whole parts and a half

# Worker processes run programs as users' do.


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    trials = tuple(
        Trial(f"loaded/{i}", SkinLoad(r_s=33.4e3 + 1e3 * i, r_p=186e3, c_p=0.12e-9))
        for i in range(COUNT)
    )
    scene = Scene(trials, (Trial("calibration/0", ResistorLoad(98.8e3)),), samples=3334)
    file = tmp_path_factory.mktemp("streaming") / "study.h5"
    scene.simulate(seed=1).write(file)
    return file


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch):
    monkeypatch.setattr(streaming, "PART", PART)


@pytest.fixture(scope="module")
def whole(source):
    with etid.read(source) as study:
        return etid.identify_study(study, method=METHOD)


def same(file: pathlib.Path, expected: StudyFits) -> None:
    """All columns and attributes of a file, bit for bit."""
    expected.write(file.with_name("expected.h5"))
    with h5py.File(file) as found, h5py.File(file.with_name("expected.h5")) as wanted:
        assert set(found) == set(wanted)
        assert found.attrs.keys() == wanted.attrs.keys()
        for name in wanted.attrs:
            np.testing.assert_array_equal(found.attrs[name], wanted.attrs[name], name)
        for name in wanted:
            np.testing.assert_array_equal(np.asarray(found[name]), np.asarray(wanted[name]), name)


def test_parts_are_the_whole(source, whole, tmp_path):
    """The processes of a cluster outlive a run, and with them what they have identified."""
    for name, own in (("alone.h5", False), ("first.h5", True), ("second.h5", True)):
        target = tmp_path / name
        with concurrent.futures.ThreadPoolExecutor(1) as executor:
            options: dict[str, Any] = {"executor": executor} if own else {}
            outcome = fit_file(source, target, method=METHOD, **options)
        same(target, whole)
        assert len(outcome.fits) == COUNT
        for drivers in (outcome.drivers, StudyFits.read(target).drivers):
            assert set(drivers) == {("calibration/0",)}
        assert [p.name for p in tmp_path.iterdir() if "parts" in p.name] == []


def test_an_interrupted_run_goes_on_where_it_was(source, whole, tmp_path, monkeypatch):
    """Three interruptions, and no part is fitted twice but the one it was at."""
    target = tmp_path / "fits.h5"
    fitted, real = [], streaming.identify_part

    def interrupted(drivers, paths, *rest):
        fitted.append(paths[0])
        if len(fitted) in (2, 4, 5):
            raise KeyboardInterrupt
        return real(drivers, paths, *rest)

    monkeypatch.setattr(streaming, "identify_part", interrupted)
    for attempt in range(3):
        with pytest.raises(KeyboardInterrupt):
            fit_file(source, target, method=METHOD, resume=attempt > 0)
        assert not target.exists()
    fit_file(source, target, method=METHOD, resume=True)
    firsts = [f"loaded/{PART * number}" for number in (0, 1, 1, 2, 2, 2, 3)]
    assert fitted == firsts
    same(target, whole)


class Same(etid.SkinRC):
    """Other elements, with the same typical values."""


def edited(factor):
    """A circuit that its user edits between two runs."""

    class Edited(etid.SkinRC):
        def impedance(self):
            return etid.resistor(self.r_s * factor)

    return Edited()


def test_a_run_of_other_settings_is_not_resumed(source, tmp_path, monkeypatch):
    target = tmp_path / "fits.h5"

    def fail(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(streaming, "identify_part", fail)
        with pytest.raises(KeyboardInterrupt):
            fit_file(source, target, method=METHOD, order=4)
    with pytest.raises(ResumeError, match="another order; start again with --force in place of"):
        fit_file(source, target, method=METHOD, resume=True)
    for circuit, what in ((Same(), "circuit"), (etid.SkinRC(r_s=10e3), "start")):
        with pytest.raises(ResumeError, match=f"another {what};"):
            fit_file(source, target, method=METHOD, order=4, circuit=circuit, resume=True)
    os.utime(source)
    with pytest.raises(ResumeError, match="another source date"):
        fit_file(source, target, method=METHOD, order=4, resume=True)
    fit_file(source, target, method=METHOD)  # anew
    assert etid.Fits.read(target).counts()


def test_parts_of_a_circuit_that_was_edited_are_not_kept(source, tmp_path, monkeypatch):
    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(streaming, "identify_part", fail)
    for factor, end in ((1.0, KeyboardInterrupt), (1.0, KeyboardInterrupt), (2.0, ResumeError)):
        with pytest.raises(end, match="another circuit" if end is ResumeError else None):
            fit_file(source, tmp_path / "fits.h5", circuit=edited(factor), resume=True)


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize(
    "contents", [{"thesis.txt": "x"}, {"000000.h5": "x"}, {"run.json": "[]"}, {"run.json": "{"}]
)
def test_a_folder_that_holds_no_parts_is_left_alone(source, tmp_path, contents, resume):
    folder = tmp_path / "fits.h5.parts"
    folder.mkdir()
    for name, text in contents.items():
        (folder / name).write_text(text)
    with pytest.raises(ResumeError, match=r"run\.json: is missing or damaged.*move or delete"):
        fit_file(source, tmp_path / "fits.h5", method=METHOD, resume=resume)
    assert {one.name: one.read_text() for one in folder.iterdir()} == contents


RUN = """
import sys, jax
jax.config.update("jax_enable_x64", True)
from etid.identify import file as streaming
streaming.PART = int(sys.argv[3])
streaming.fit_file(sys.argv[1], sys.argv[2], method=sys.argv[4], resume=len(sys.argv) > 5)
"""


@pytest.mark.slow
def test_kill_minus_nine_three_times(source, whole, tmp_path):
    target = tmp_path / "fits.h5"
    parts = tmp_path / "fits.h5.parts"
    command = [sys.executable, "-c", RUN, str(source), str(target), str(PART), METHOD]
    for wanted in (1, 2, 3):
        with subprocess.Popen([*command, "resume"]) as process:
            deadline = time.monotonic() + 120
            while len(list(parts.glob("*.h5"))) < wanted and time.monotonic() < deadline:
                time.sleep(0.001)
            process.send_signal(signal.SIGKILL)
        assert len(list(parts.glob("*.h5"))) >= wanted
    subprocess.run([*command, "resume"], check=True)
    same(target, whole)


def test_a_lost_worker_keeps_what_is_done(source, tmp_path):
    class Broken(concurrent.futures.Executor):
        parts = 0

        def submit(self, fn, /, *args, **kwargs):
            future = concurrent.futures.Future()
            self.parts += 1
            if self.parts == 3:
                future.set_exception(concurrent.futures.BrokenExecutor("killed"))
            else:
                future.set_result(fn(*args))
            return future

    target = tmp_path / "fits.h5"
    with pytest.raises(ResumeError, match="go on with --resume"):
        fit_file(source, target, method=METHOD, executor=Broken())
    part = tmp_path / "fits.h5.parts" / "000001.h5"
    part.write_bytes(b"torn")
    with pytest.raises(etid.RecordingError, match=r"000001\.h5.*Delete this part, and go on with"):
        fit_file(source, target, method=METHOD, resume=True)
    part.unlink()
    fit_file(source, target, method=METHOD, resume=True)
    assert len(etid.Fits.read(target)) == COUNT


def _has_semaphore():
    return hasattr(tqdm.get_lock(), "mp_lock")


def test_a_worker_that_ctrl_c_ends_leaks_no_semaphore():
    with streaming.processes(1) as executor:
        assert not executor.submit(_has_semaphore).result()


@pytest.mark.slow
def test_a_cluster_gives_the_same_though_a_worker_is_killed(source, whole, tmp_path):
    """A real scheduler and two worker processes, of which one is killed while it works."""
    distributed: Any = importlib.import_module("distributed")
    target = tmp_path / "fits.h5"
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        # Both are armed; the first that fits a part dies of it.
        client.run(_arm, tmp_path / "died")
        before = set(client.run(os.getpid).values())
        fit_file(source, target, method=METHOD, executor=client.get_executor(retries=5))
        client.wait_for_workers(2, timeout=60)
        assert len(before - set(client.run(os.getpid).values())) == 1
    assert (tmp_path / "died").exists()
    same(target, whole)


def _arm(marker: pathlib.Path) -> None:
    """Make this process kill itself at its first part, if no other has done so."""
    real = streaming.identify_part

    def deadly(*arguments):
        with contextlib.suppress(FileExistsError):
            marker.touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments)

    streaming.identify_part = deadly
