"""The live view: what a browser shows of a running display, its stop, and what is refused."""

import contextlib
import dataclasses
import functools
import http.client
import itertools
import json
import os
import pathlib
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import jax.numpy as jnp
import numpy as np
import pytest

from etid import cli
from etid.commands import DONE, INTERRUPTED, WRONG_DATA
from etid.display import Controller, Tracker
from etid.display import view as views
from etid.display.__main__ import parser
from etid.display.controller import Command
from etid.display.loop import Tick, follow
from etid.display.server import HEADER
from etid.display.state import Change
from etid.display.stimulator import PAUSE, Stimulator
from etid.display.stream import connected, received, sender
from etid.display.view import LiveView
from etid.plotting.layout import Layout
from etid.simulation.transformer import ResistorLoad, Sampler, loading
from tests.chromium import chromium
from tests.display.test_online import (
    DRY,
    LOADS,
    NOISE,
    PERIOD,
    PULSES,
    RATE,
    TEN,
    calibrated,
    quiet,
    scene,
    tracker_of,
)

DISPLAY = 98
WANTED = 80e-9
SKINS = {**LOADS, "open": ResistorLoad(1e9), "short": ResistorLoad(1.0)}


@functools.cache
def alone():
    """A pulse alone behind each load, and the period after it: (load, phase, 2, sample) [V].

    A window begins at a sample, of three pulses one at a whole number of samples.
    """
    of = scene(1)
    sampler = Sampler(RATE, PULSES / 2, of.antialias * RATE)
    v_th, z_th = of.driver.v_th_spectrum(sampler.f) * PULSES / 2, of.driver.z_th(sampler.f)
    return {
        name: np.array(
            [
                [
                    sampler.sample(v_th * loading(load(sampler.f), z_th), 3333, start + late)
                    for start in (0.0, 1 / PULSES)
                ]
                for late in (round(n * PERIOD) / RATE - n / PULSES for n in range(3))
            ]
        )
        for name, load in SKINS.items()
    }


class Display:
    """A display at a socket: gives and records a pulse of the last amplitudes that it was sent.

    Attributes:
        skin: Name of the load at each electrode, which a test may change.
        given: All amplitudes that it was sent.
        pulses: First sample and amplitudes of all pulses.
        silent: Whether the converter sends nothing.
        number: Number of the next pulse.
        again: Whether it is started again: the next pulse has the number 0.
        begun: How many amplitudes it was sent until it was started again, each time.
        steps: Number of steps from amplitude 0 to 1, which it tells and to which it rounds; 0 if it
            gives any amplitude.
        half: Whether it closes its half of the connection in place of the next block.
        raw: Bytes to send in place of the next block; none: the connection is closed.
        line: The connection.
    """

    def __init__(self, electrodes, steps=0):
        self.skin, self.given, self.pulses = ["dry"] * electrodes, [], []
        self.silent, self.number, self.steps = False, 0, steps
        self.again, self.begun, self.half = False, [], False
        self.raw: bytes | None = None
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.server.getsockname()[1]}"
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        pulses, noise = alone(), np.random.default_rng(0)
        with self.server, self.server.accept()[0] as line:
            before, self.line = np.zeros(len(self.skin)), line
            if self.steps:
                line.sendall(np.array([self.steps, len(self.skin), 0], "<i8").tobytes())
            with contextlib.suppress(ConnectionError):
                while told := line.recv(8 * before.size, socket.MSG_WAITALL):
                    now = np.frombuffer(told, "<f8")
                    self.given.append(now)
                    if self.silent or select.select([line], [], [], 0)[0]:
                        continue
                    if self.half:
                        line.shutdown(socket.SHUT_WR)
                        self.silent = True
                        continue
                    if self.raw is not None:
                        if not self.raw:
                            return
                        line.sendall(self.raw)
                        self.silent = True
                        continue
                    if self.again:
                        self.number, self.again = 0, False
                        self.begun.append(len(self.given))
                    if self.steps:
                        now = np.rint(now * self.steps) / self.steps
                    of = np.stack([pulses[name][self.number % 3] for name in self.skin])
                    v = now[:, None] * of[:, 0] + before[:, None] * of[:, 1]
                    v += NOISE * noise.standard_normal(v.shape)
                    begin = round(self.number * PERIOD)
                    line.sendall(np.array([begin, *v.shape], "<i8").tobytes() + v.tobytes())
                    self.pulses.append((begin, now))
                    before, self.number = now, self.number + 1
                    time.sleep(0.01)

    def positive(self):
        """How often it was sent an amplitude that is not 0."""
        return sum(one.any() for one in self.given)


def controller_of(electrodes, **limits):
    return Controller.of(tracker_of(electrodes, 3e-3), **limits)


def tick_of(tracker, number=0, changes=(), *, reason="wanted"):
    """A tick of a display that was shown nothing yet."""
    lanes, state = tracker.electrodes, tracker.start()
    ones = np.ones(lanes)
    command = Command(ones, ones, ones, ones, ones, np.full(lanes, reason))
    window = np.zeros((lanes, tracker.model.bands.samples))
    return Tick(number, window, state, state, command, list(changes), 1e-3, 0, 0)


def opened(electrodes=TEN, **options):
    options = {"charge": WANTED, "controls": True, "port": 0} | options
    return LiveView(controller_of(electrodes), **options)


@pytest.fixture(scope="module")
def view():
    with opened() as view:
        yield view


def port_of(view):
    return int(view.address.rpartition(":")[2])


def asked(view, method, path, body="", **headers):
    """Status and content of an answer."""
    line = http.client.HTTPConnection("127.0.0.1", port_of(view), timeout=20)
    with contextlib.closing(line):
        line.request(method, path, body, headers)
        answer = line.getresponse()
        return answer.status, answer.read().decode()


def told(view):
    """What the page knows before the first snapshot."""
    return json.loads(re.findall(r"told = (.*);\n", asked(view, "GET", "/")[1])[0])


def token_of(view):
    return told(view)["token"]


def shown(view):
    return json.loads(asked(view, "GET", "/state")[1])


OTHER = "http://another.site"
HOME = "http://127.0.0.1:{port}"


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status"),
    [
        ("POST", "/stop", "", {}, 403),
        ("POST", "/stop", "", {HEADER: "guessed"}, 403),
        ("POST", "/stop", "", {HEADER: "gu\xe9ssed"}, 403),
        ("POST", "/stop", "", {HEADER: "", "Origin": HOME}, 403),
        ("POST", "/stop", "", {HEADER: "{token}", "Origin": OTHER}, 403),
        ("POST", "/stop", "", {HEADER: "{token}", "Origin": "null"}, 403),
        ("POST", "/stop", "", {HEADER: "{token}", "Host": "another.site"}, 403),
        ("POST", "/stop?token={token}", "", {}, 403),
        ("GET", "/stop", "", {HEADER: "{token}"}, 405),
        ("OPTIONS", "/stop", "", {"Origin": OTHER}, 403),
        ("POST", "/electrode", "1", {}, 403),
        ("POST", "/electrode", "10", {HEADER: "{token}"}, 400),
        ("POST", "/electrode", "-1", {HEADER: "{token}"}, 400),
        ("POST", "/electrode", "E1", {HEADER: "{token}"}, 400),
        ("POST", "/electrode", "1" * 200, {HEADER: "{token}"}, 400),
        ("GET", "/", "", {"Host": "another.site"}, 403),
        ("GET", "/", "", {"Host": "another.site:{port}"}, 403),
        ("GET", "/state", "", {"Host": "another.site"}, 403),
        ("GET", "/state", "", {"Origin": OTHER}, 403),
        ("GET", "/../server.py", "", {}, 404),
    ],
)
def test_a_request_that_is_not_the_page_s_is_refused(view, method, path, body, headers, status):
    given = {"token": token_of(view), "port": port_of(view)}
    headers = {name: value.format(**given) for name, value in headers.items()}
    assert asked(view, method, path.format(**given), body, **headers)[0] == status
    assert not view.stopped
    assert shown(view)["electrode"] == 0


def test_the_page_has_a_token_of_its_own_start_and_no_site_may_frame_it(view):
    with opened() as other:
        assert token_of(view) != token_of(other)
        headers = {HEADER: token_of(other), "Origin": other.address}
        assert asked(other, "POST", "/electrode", "3", **headers)[0] == 200
        other.show(tick_of(tracker_of(TEN, 3e-3)))
        assert shown(other)["electrode"] == 3
        assert asked(other, "POST", "/stop", **headers)[0] == 200
        assert other.stopped
        assert shown(other)["stop"]
    assert not view.stopped
    with urllib.request.urlopen(view.address, timeout=20) as answer:
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert answer.headers["Access-Control-Allow-Origin"] is None
        assert not re.search(r"(src|href)=\"?http|@import|url\(", answer.read().decode())


def test_only_the_loopback_address_is_listened_at(view):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port_of(view)), timeout=5)


def test_alarms_are_words():
    tracker = tracker_of(TEN, 3e-3)
    changes = [Change(1, at, "jump", "r_p", factor) for at, factor in ((4, 0.0937), (5, 0.0941))]
    changes += [Change(1, 7, "drift", "c_p", 1.2), Change(1, None, "driver", "", np.nan)]
    with opened() as view:
        view.show(tick_of(tracker, 6, changes, reason="charge"))
        found = shown(view)
    assert set(found["words"]) == {"cap reached: charge"}
    assert found["pulse"] == 7
    assert [text for text in found["alarms"] if text] == [
        "Pulse 7: cap reached: charge, at E1, E2, E3, E4, E5, E6 and 4 more",
        "Pulse 7: the driver has changed; calibrate again",
        "Pulse 7: drift of c_p, to 1.2 times its value, at E8",
        "Pulse 7: jump of r_p, to 0.094 times its value, at E5, E6",
    ]


def test_an_electrode_that_was_never_identified_has_no_elements():
    tick = tick_of(tracker_of(TEN, 3e-3))
    pulses = jnp.zeros(TEN, int).at[2].set(1)
    electrodes = dataclasses.replace(tick.state.electrodes, pulses=pulses)
    with opened() as view:
        view.show(tick._replace(state=dataclasses.replace(tick.state, electrodes=electrodes)))
        found = np.array(shown(view)["elements"], float)  # null becomes NaN
    assert (np.isfinite(found) == (np.arange(TEN) == 2)).all(), found


def test_a_pulse_above_the_cap_between_two_snapshots_is_an_alarm():
    controller = controller_of(TEN, charge_cap=120e-9)
    tracker = controller.tracker
    tick = tick_of(tracker)
    ones = dataclasses.replace(tick.state.electrodes, amplitude=jnp.ones(TEN))
    state = dataclasses.replace(tick.state, electrodes=ones)
    command = dataclasses.replace(tick.command, charge=np.full(TEN, 80e-9))
    above = dataclasses.replace(command, charge=np.where(np.arange(TEN) == 3, 200e-9, 80e-9))
    with LiveView(controller, charge=WANTED, controls=True, port=0) as view:
        for number, of in enumerate((command, above, command)):
            view._due = 0.0 if number != 1 else np.inf
            view.show(tick._replace(number=number, state=state, command=of))
        found = shown(view)
        assert found["alarms"][0] == "Pulse 3: above the charge cap, at E4"
        view._due = 0.0
        view.show(tick._replace(number=3, state=state, command=command))
        assert "above the charge cap" not in shown(view)["words"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"layout": Layout.grid(3, 3, 2e-3)}, "the layout has 9 electrodes, the display 10"),
        ({"port": 70_000}, "port is 70000; give a number from 0 to 65535"),
        ({"port": None}, r"port \d+ cannot be used .* does another live view run"),
        ({}, r"needs tornado: pip install 'etid\[live\]'"),
    ],
)
def test_a_view_that_cannot_be_is_refused(view, options, text, monkeypatch):
    if not options:
        monkeypatch.setattr(views.importlib.util, "find_spec", lambda name: None)
    if "port" in options:
        options = {"port": options["port"] or port_of(view)}
    with pytest.raises(ValueError, match=text):
        opened(**options)


def resident(process):
    """Memory of a process [bytes]."""
    pages = pathlib.Path(f"/proc/{process.pid}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def test_the_loop_waits_for_no_page_and_no_memory_grows(monkeypatch):
    """98 electrodes; a minute of snapshots while a page reads, then while its process is frozen."""
    monkeypatch.setattr(views, "EVERY", 0.0)
    tracker = tracker_of(DISPLAY, 3e-3)
    with opened(DISPLAY) as view:
        seconds, sizes, pid = [], [], view._process.pid
        assert pid is not None

        def hand_over(number):
            tick = tick_of(tracker, number)
            begin = time.thread_time(), time.monotonic()
            view.show(tick)
            seconds.append((time.thread_time() - begin[0], time.monotonic() - begin[1]))

        for number in range(600):
            hand_over(number)
            if number % 2:
                assert len(shown(view)["charge"]) == DISPLAY
            if number in (100, 599):
                sizes.append(resident(view._process))
        assert sizes[1] - sizes[0] < 4e6
        os.kill(pid, signal.SIGSTOP)
        try:
            for number in range(600):
                hand_over(number)
        finally:
            os.kill(pid, signal.SIGCONT)
        # A snapshot is due at every sixth pulse of 16.7 ms; a tenth of that on any processor. The
        # processor's time of this thread, as other tests run beside it; one that waited for a
        # frozen process would wait for ever.
        taken, passed = np.array(seconds).reshape(2, 600, 2).transpose(2, 0, 1)
        assert (np.median(taken, axis=1) < 10e-3).all(), np.median(taken, axis=1)
        assert passed.max() < 1.0
        maps = pathlib.Path(f"/proc/{view._process.pid}/maps").read_text()
        assert "jaxlib" not in maps, "the page's process takes no memory and cores of JAX"


def test_the_page_draws_the_pulse_without_the_rest_of_its_period(view):
    times = 1e-6 * np.array(told(view)["time"])
    v_th = np.abs(quiet()["dry"].v_th[: int(PERIOD)])
    (high,) = np.nonzero(v_th > v_th.max() / 2)
    assert times[0] <= high[0] / RATE <= high[-1] / RATE <= times[-1] < 0.1 / PULSES


def test_the_page_predicts_a_pulse_by_the_circuit_of_its_skin(view):
    tick = tick_of(tracker_of(TEN, 3e-3))
    own = jnp.tile(jnp.array([*np.log(dataclasses.astuple(DRY)), 0.0]), (TEN, 1))  # without a delay
    known = dataclasses.replace(
        tick.state.electrodes, own=own, pulses=jnp.ones(TEN, int), amplitude=jnp.ones(TEN)
    )
    state = dataclasses.replace(tick.state, electrodes=known)
    predicted = view._predicted(tick._replace(before=state, state=state), 0)
    bands = view._controller.tracker.model.bands
    f = np.fft.rfftfreq(bands.samples, 1 / RATE)[1:]
    gain = np.append(0, loading(DRY(f), scene(1).driver.z_th(f)))
    true = np.fft.irfft(gain * np.fft.rfft(bands.waveform()), bands.samples)[view._part]
    assert np.std(predicted - true) < 1e-3 * np.ptp(true)


def test_a_slow_tick_is_not_shown():
    tracker = tracker_of(TEN, 3e-3)
    with opened() as view:
        view.show(tick_of(tracker, 0))
        view._due = time.monotonic() - 0.1
        view.show(tick_of(tracker, 1)._replace(seconds=0.01))  # of 16.7 ms
        assert shown(view)["pulse"] == 1
        view._due = time.monotonic() - 1.1
        view.show(tick_of(tracker, 2)._replace(seconds=0.01))
        assert shown(view)["pulse"] == 3


def test_a_page_that_has_died_is_a_stop():
    with opened() as view:
        assert not view.stopped
        view._process.kill()
        view._process.join()
        assert view.stopped


def test_a_page_whose_program_was_killed_gives_its_port_back():
    code = """
import multiprocessing, socket, time
import numpy as np
from etid.display.server import Slot, serve
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    listening = socket.create_server(("127.0.0.1", 0))
    slot = Slot(context, np.dtype([("pulse", int)]))
    told = {"start": "", "token": "", "names": []}
    context.Process(target=serve, args=(listening, slot, told), daemon=True).start()
    print(listening.getsockname()[1], flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        port = int(program.stdout.readline())
        program.kill()
    for _ in range(200):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            return
        time.sleep(0.1)
    pytest.fail("the port is still taken")


@contextlib.contextmanager
def running(view, display, controller):
    """A controller that follows the display, in a thread; yields its ticks."""
    ticks = []

    def run():
        with connected(display.address) as line:
            lanes = controller.tracker.electrodes
            with Stimulator(sender(line), lanes, 1 / PULSES, view) as stimulator:
                blocks = received(line, lambda: stimulator.stopped)
                options = {"charge": WANTED, "stimulator": stimulator, "view": view}
                stream = follow(blocks, controller, **options)
                for tick in stream:
                    ticks.append(tick._replace(window=None, before=None))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield thread, ticks
    finally:
        stop(view)
        thread.join(60)
        assert not thread.is_alive()


def stop(view):
    """Press STOP; the answer of the page."""
    return asked(view, "POST", "/stop", **{HEADER: token_of(view)})


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.005)


def test_a_pause_and_a_counter_that_begins_anew_cost_a_rest_and_stop_is_obeyed_in_silence():
    display = Display(TEN)
    with opened() as view, running(view, display, controller_of(TEN)) as (thread, ticks):
        assert not display.positive()
        wait_for(lambda: display.positive() > 10)
        display.silent = True
        wait_for(lambda: not display.given[-1].any())
        display.silent = False

        def alarmed(reason):
            text = f"{reason}: amplitude 0 was sent, and stimulation begins anew from rest"
            return any(text in alarm for alarm in shown(view)["alarms"])

        wait_for(lambda: alarmed("no new amplitude for 0.33 s"))
        rested = len(ticks)

        def began_anew():
            # A counter goes back by a pause. While the display rests, nobody would say so; and only
            # pulses that were counted since the first rest can be seen to begin anew.
            counted = len(ticks) > rested and ticks[-1].state.electrodes.pulses.max() > 10
            if counted and display.number > PAUSE + 5 and display.given[-1].any():
                display.again = True
            return alarmed("the counter of samples began anew")

        wait_for(began_anew)
        seen = len(ticks)
        wait_for(lambda: len(ticks) > seen)
        display.silent = True
        assert json.loads(stop(view)[1]) == {"zero": True}
        wait_for(lambda: not display.given[-1].any(), seconds=5)  # it was sent, and has to be read
        thread.join(30)
        assert not thread.is_alive()
    display.thread.join(30)
    assert not display.given[-1].any()
    assert not any(tick.state.driver_changed for tick in ticks)
    assert display.begun
    assert not any(display.given[at].any() for at in display.begun), "0 follows at once"
    given = dict(display.pulses)[round(ticks[-1].number * PERIOD)]
    np.testing.assert_array_equal(ticks[-1].state.electrodes.amplitude, given)
    pulses = [int(tick.state.electrodes.pulses.max()) for tick in ticks]
    assert sum(now < before for before, now in itertools.pairwise(pulses)) >= 2, "it begins anew"


def test_a_stop_before_the_first_pulse_lets_no_pulse_be_given(monkeypatch):
    """It comes while programs compile."""
    display, update, answers = Display(TEN), Tracker.update, []

    def stopping(*arguments):
        answers.append(json.loads(stop(view)[1]))
        return update(*arguments)

    monkeypatch.setattr(Tracker, "update", stopping)
    with opened() as view, running(view, display, controller_of(TEN)) as (thread, ticks):
        thread.join(60)
    display.thread.join(30)
    assert (answers, ticks) == ([{"zero": True}], [])
    assert display.given
    assert not display.positive()


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """A file of the calibrations that `tracker_of` has."""
    file = tmp_path_factory.mktemp("live") / "calibration.h5"
    calibrated()[1].write(file)
    return file


SENT = "amplitude 0 was sent to all electrodes"
ENDS = {
    "Ctrl-C": (INTERRUPTED, f"etid-live: interrupted: {SENT}"),
    "other electrodes": (
        WRONG_DATA,
        f"etid-live: error: a block has 11 electrodes, not 10; {SENT}",
    ),
    "no header": (WRONG_DATA, f"64 bits?; {SENT}"),
    "hangs up": (WRONG_DATA, "AMPLITUDE 0 COULD NOT BE SENT"),
    "closes its half": (DONE, ""),
}


@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("how", ENDS)
def test_the_command_leaves_0_behind_and_says_so(calibration, how, capsys):
    """The stimulator has 8 bits, so that it would round what is no whole step."""
    display = Display(TEN, steps=255)

    def end():
        try:
            wait_for(lambda: display.positive() > 3)
        except AssertionError:  # without an end the command would wait for ever
            display.line.shutdown(socket.SHUT_RDWR)
            raise
        match how:
            case "Ctrl-C":
                os.kill(os.getpid(), signal.SIGINT)
            case "other electrodes":
                display.raw = np.array([0, TEN + 1, 1], "<i8").tobytes() + bytes(8 * (TEN + 1))
            case "no header":
                display.raw = bytes(24)
            case "hangs up":
                display.raw = b""
            case "closes its half":
                display.half = True

    ending = threading.Thread(target=end)
    ending.start()
    words = ["--socket", display.address, "--electrodes", str(TEN), "--port", "0"]
    status = cli.run(parser(), [str(calibration), *words])
    ending.join()
    display.thread.join(30)
    printed = capsys.readouterr()
    said = [line for line in printed.err.splitlines() if line][-1]
    assert status == ENDS[how][0], said
    assert ENDS[how][1] in said
    if how != "hangs up":
        assert not display.given[-1].any()
    assert any(now.any() for _, now in display.pulses)
    steps = 255 * np.array(display.given)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)  # the tracker knows what is given
    if status == DONE:
        assert re.fullmatch(
            rf"\d+ pulses, 0 incomplete, 0 late blocks, \d pauses?, {SENT}\n", printed.out
        )


def until(browser, expression):
    """Wait until an expression of JavaScript is true; a page that is being loaded has no names."""
    tried = f"(() => {{ try {{ return Boolean({expression}) }} catch {{ return false }} }})()"
    for _ in range(300):
        if browser.evaluate(tried):
            return
        time.sleep(0.1)
    told = browser.evaluate("document.body.innerText")
    pytest.fail(f"not within 30 s: {expression}\n{told}\n{browser.complaints}")


def fill(name):
    return f"document.querySelector('#value g[data-name={name}] circle').getAttribute('fill')"


STATUS = "document.getElementById('status').textContent"
BAD = "document.getElementById('status').classList.contains('bad')"


def test_a_browser_shows_the_skin_and_stops_it():
    controller, display = controller_of(TEN), Display(TEN)
    with chromium() as browser:
        with LiveView(controller, charge=WANTED, controls=True, port=0) as view:
            browser.open(view.address)
            until(browser, f"{STATUS} === 'waiting for the first pulse'")
            assert browser.evaluate(fill("E4")) == "white"
            with running(view, display, controller) as (thread, ticks):
                until(browser, "state?.pulse > 10 && state.words.every(word => word === 'good')")
                # The picture changes when the skin does.
                red = "+{}.match(/\\d+/)[0]".format
                alike = f"Math.abs({red(fill('E4'))} - {red(fill('E5'))})"
                assert browser.evaluate(alike) < 20
                display.skin[3], display.skin[5] = "damp", "open"
                until(browser, f"{alike} > 100 && {fill('E6')} === 'white'")
                alarms = browser.evaluate("document.getElementById('alarms').innerText")
                assert re.search(r"Pulse \d+: contact lost, at E6", alarms)
                assert re.search(
                    r"Pulse \d+: jump of r_\w, to 0\.\d+ times its value, at E4", alarms
                )
                mark = "document.querySelector('#charge g[data-name=E6] text').textContent"
                assert browser.evaluate(mark) == "\u00d7"
                # Another electrode's pulse, with its prediction.
                click = "dispatchEvent(new MouseEvent('click'))"
                browser.evaluate(f"document.querySelector('#value g[data-name=E4]').{click}")
                until(browser, "state.electrode === 3 && state.predicted[0] !== null")
                until(browser, "document.getElementById('electrode').value === 'E4'")
                assert browser.evaluate("document.querySelectorAll('#pulse polyline').length") == 2
                pair = np.array(browser.evaluate("[state.v_out, state.predicted]"))
                measured, predicted = pair
                assert np.ptp(measured) > 2
                middle = slice(measured.size // 3, measured.size // 2)  # between the edges
                np.testing.assert_allclose(predicted[middle], measured[middle], atol=0.1)
                charges = np.array(browser.evaluate("state.charge"), float)
                np.testing.assert_allclose(np.delete(charges, 5), 80, rtol=0.05)
                # A second window stops both.
                opened = "void (globalThis.second = window.open(location.href))"
                browser.call("Runtime.evaluate", expression=opened, userGesture=True)
                until(browser, f"second.{STATUS}.startsWith('pulse ')")
                assert browser.complaints == []
                assert {url.rpartition("/")[0] for url in browser.requests} == {view.address}
                browser.evaluate("second.document.getElementById('stop').click()")
                thread.join(30)
                assert not thread.is_alive()
                for of in ("", "second."):
                    until(browser, f"{of}{STATUS}.startsWith('Stopped: amplitude 0 was sent')")
                charges = np.array(browser.evaluate("state.charge"), float)
                np.testing.assert_allclose(np.delete(charges, 5), 80, rtol=0.05)
            until(browser, f"document.getElementById('stop').disabled && {STATUS} !== ''")
        display.thread.join(30)
        assert display.positive() >= len(ticks)
        assert not display.given[-1].any(), "the stop is the last that the stimulator is told"
        told = "amplitude 0 was sent to all electrodes"
        until(browser, f"{STATUS} === 'Stopped after pulse {ticks[-1].number + 1}: {told}.'")
        assert not browser.evaluate(BAD)
        # Another program at the same place: the page asks for its page, and has its token.
        old = browser.evaluate("told.start")
        with LiveView(controller, charge=WANTED, controls=False, port=port_of(view)) as again:
            again.show(tick_of(controller.tracker))
            until(browser, f"told.start !== '{old}' && state?.pulse === 1")
            assert "watching only" in browser.evaluate(STATUS)
            browser.evaluate("act('electrode', '7')")
            for _ in range(100):
                if again._slot.electrode.value == 7:
                    break
                time.sleep(0.1)
            assert again._slot.electrode.value == 7
        until(browser, f"{STATUS} === 'The stream has ended after pulse 1.'")
        assert not browser.evaluate(BAD), "the end of a file is no alarm"

        def fail():
            port = port_of(again)
            with LiveView(controller, charge=WANTED, controls=True, port=port):
                until(browser, f"{STATUS} === 'waiting for the first pulse'")
                raise ValueError("no reader.")

        with pytest.raises(ValueError, match="no reader"):
            fail()
        how = "An error ended the program before the first pulse"
        until(browser, f"{STATUS} === '{how}: no reader.'")
        assert browser.evaluate(BAD)
