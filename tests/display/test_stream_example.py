"""A stream: whole windows from any blocks, and losses that are counted; and the example of one."""

import importlib.util
import pathlib
import socket
import sys
import threading
import time

import h5py
import numpy as np
import pytest

from etid.display import stream
from etid.display.clock import Clock
from tests.display.test_online import DRY, calibrated, loaded, scene

PATH = pathlib.Path(__file__).parents[2] / "examples" / "stream_display.py"


def blocks(v, size, without=()):
    for number, first in enumerate(range(0, v.shape[1], size)):
        if number not in without:
            yield first, v[:, first : first + size]


@pytest.mark.parametrize("size", [7, 33, 34, 100, 1000])
def test_windows_do_not_depend_on_the_blocks(size):
    v = np.arange(2 * 1000.0).reshape(2, 1000)
    pulses = stream.Pulses(Clock(33.4, np.zeros(33)), 2)
    found = [(number, window.copy()) for number, window in pulses.cut(blocks(v, size))]
    assert [number for number, _ in found] == list(range(29 + (round(29 * 33.4) + 33 <= 1000)))
    for number, window in found:
        begin = round(number * 33.4)
        np.testing.assert_array_equal(window, v[:, begin : begin + 33])
    assert (pulses.late, pulses.missing) == (0, 0)


def test_missing_and_late_blocks_are_counted_and_only_their_pulses_suffer():
    v = np.ones((2, 1000))
    pulses = stream.Pulses(Clock(33.4, np.zeros(33)), 2)
    kept = list(blocks(v, 50, without=(4,)))
    late = [*kept[:8], (200, v[:, 200:250]), *kept[8:]]
    bad = [number for number, w in pulses.cut(late) if np.isnan(w).any()]
    assert bad == [6, 7]  # samples 200 to 249
    assert (pulses.late, pulses.missing) == (1, 2)
    with pytest.raises(ValueError, match="3 electrodes, not 2"):
        list(pulses.cut([(0, np.ones((3, 50)))]))


def test_a_counter_that_begins_anew_begins_new_windows():
    v = np.arange(2 * 2000.0).reshape(2, 2000)
    pulses, size = stream.Pulses(Clock(33.4, np.zeros(33)), 2), 50
    again = [*blocks(v, size), *blocks(v[:, :500], size)]
    found = list(pulses.cut(again))
    numbers = [number for number, _ in found]
    assert numbers == [*range(59), *range(14)]
    for number, window in found:
        begin = round(number * 33.4)
        np.testing.assert_array_equal(window, v[:, begin : begin + 33])
    assert (pulses.late, pulses.missing) == (0, 0)


def test_a_block_that_is_late_by_less_than_a_pause_is_no_new_beginning():
    v = np.arange(2 * 2000.0).reshape(2, 2000)
    pulses, known = stream.Pulses(Clock(33.4, np.zeros(33)), 2), list(blocks(v, 50))
    late = [*known[:30], known[30 - stream.PAUSE // 2], *known[30:]]
    assert [number for number, _ in pulses.cut(late)] == list(range(59))
    assert (pulses.late, pulses.missing) == (1, 0)


def test_blocks_come_through_a_socket():
    v = np.random.default_rng(0).standard_normal((2, 300))
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            line, _ = server.accept()
            with line:
                line.sendall(np.array([1023, 2, 0], "<i8").tobytes())  # 10 bits
                for first, block in blocks(v, 100):
                    line.sendall(np.array([first, *block.shape], "<i8").tobytes())
                    line.sendall(np.ascontiguousarray(block, "<f8").tobytes())
                line.sendall(b"half a header")

        thread = threading.Thread(target=serve)
        thread.start()
        with stream.connected(f"127.0.0.1:{server.getsockname()[1]}") as line:
            steps = []
            found = list(stream.received(line, stepped=steps.append))
        thread.join()
    assert steps == [1 / 1023]
    assert [first for first, _ in found] == [0, 100, 200]
    np.testing.assert_array_equal(np.concatenate([block for _, block in found], axis=1), v)


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("stream_display", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_a_file_is_played_to_its_end_and_logged(example, tmp_path, capsys):
    _, study = calibrated()
    study.write(tmp_path / "calibration.h5")
    v_out = loaded(scene(20).simulate(seed=5))
    with h5py.File(tmp_path / "pulses.h5", "w") as file:
        file["v_out"] = v_out
    arguments = [str(tmp_path / "calibration.h5"), str(tmp_path / "pulses.h5")]
    arguments += ["--electrodes", "2", "--speed", "1000", "--log", str(tmp_path / "log.h5")]
    begin = time.perf_counter()
    example.main(arguments)
    passed = time.perf_counter() - begin
    said = capsys.readouterr().out
    assert said == "20 pulses, 0 incomplete, 0 late blocks\n"
    with h5py.File(tmp_path / "log.h5") as log:
        names = "r_p", "verdict", "pulse", "seconds"
        r_p, verdict, pulse, seconds = (np.asarray(log[name]) for name in names)
    assert r_p.shape == (20, 2)
    np.testing.assert_allclose(r_p[-1, 0], DRY.r_p, rtol=0.01)  # ten standard errors
    np.testing.assert_array_equal(pulse, range(20))
    assert (verdict == 0).all()
    assert (seconds > 0).all()
    assert seconds.sum() < passed
    with pytest.raises(ValueError, match=r"log\.h5 exists"):  # no run loses the log of another
        example.main(arguments)


def test_a_long_pause_is_counted_and_not_given_pulse_by_pulse():
    pulses = stream.Pulses(Clock(10.0, np.zeros(10)), 2)
    blocks = [(0, np.ones((2, 10))), (10**12, np.ones((2, 10)))]
    found = [(number, np.isnan(window).all()) for number, window in pulses.cut(blocks)]
    assert found == [(0, False), (10**11 - 1, True), (10**11, False)]
    assert pulses.missing == 10**11 - 1


@pytest.mark.parametrize(
    ("stored", "text"),
    [
        (None, "has no dataset v_out"),
        (np.zeros(50), r"v_out: is float64 of shape \(50,\)"),
        (np.zeros((50, 2)), r"shape \(50, 2\)"),
        (np.zeros((2, 50), "i2"), "is int16"),
    ],
)
def test_a_file_that_cannot_be_played_is_refused(tmp_path, stored, text):
    with h5py.File(tmp_path / "pulses.h5", "w") as file:
        file["other" if stored is None else "v_out"] = 0.0 if stored is None else stored
    with pytest.raises(ValueError, match=text):
        stream.played(tmp_path / "pulses.h5", 2, 200e3, 1.0)


def test_a_stream_that_is_not_there_is_named(tmp_path):
    (tmp_path / "pulses.csv").write_text("v_out")
    with pytest.raises(ValueError, match=r"pulses\.csv: is not an HDF5 file"):
        stream.played(tmp_path / "pulses.csv", 2, 200e3, 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    for wrong in (address, "127.0.0.1:99999"):
        with pytest.raises(ValueError, match=f"{wrong} cannot be reached .*start the stimulator"):
            stream.connected(wrong)


@pytest.mark.parametrize(
    ("header", "text"),
    [
        (b"\xff" * 24, "-1 electrodes and -1 samples from sample -1 on"),
        (np.array([-1, 2, 3], "<i8").tobytes(), "2 electrodes and 3 samples from sample -1 on"),
        (np.array([0, 0, 3], "<i8").tobytes(), "0 electrodes and 3 samples from sample 0 on"),
    ],
)
def test_a_header_out_of_step_is_refused(header, text):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def serve():
            line, _ = server.accept()
            with line:
                line.sendall(header)

        thread = threading.Thread(target=serve)
        thread.start()
        with (
            stream.connected(f"127.0.0.1:{port}") as line,
            pytest.raises(ValueError, match=text),
        ):
            next(stream.received(line))
        thread.join()
    with pytest.raises(ValueError, match="write host:port"):
        stream.connected("localhost")
