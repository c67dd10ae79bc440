"""What a stimulator is sent: 0 is the last amplitude, and a stop is obeyed at once."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from etid.display.stimulator import PAUSE, SENT, Output, Stimulator

PERIOD = 2e-3  # [s]; so a pause has 40 ms
HALF = np.full(2, 0.5)


class View:
    """A page: `press` is its end of the pipe."""

    def __init__(self):
        self.stopping, self.press = multiprocessing.Pipe(duplex=False)
        self.outputs = []

    def told(self, output):
        self.outputs.append(output)


def begun(stimulator):
    """Let the display rest until amplitudes are sent."""
    while not stimulator.rested():
        time.sleep(PERIOD)


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(1e-3)


def test_the_display_begins_at_rest_and_gets_what_is_sent_until_the_end():
    sent, view = [], View()
    with Stimulator(lambda of: sent.append(of[0]), 2, PERIOD, view) as stimulator:
        assert sent == [0.0]
        assert not stimulator.send(HALF)
        begin = time.monotonic()
        begun(stimulator)
        assert time.monotonic() - begin >= PAUSE * PERIOD
        assert set(sent) == {0.0}
        assert stimulator.send(HALF)
        assert sent[-1] == 0.5
    assert sent[-1] == 0.0
    assert view.outputs[0] == Output.REST
    assert view.outputs[-1] == Output.ZERO
    assert (stimulator.pauses, stimulator.reason) == (0, "")


def test_without_a_new_amplitude_the_display_rests_and_then_begins_anew():
    sent = []
    with Stimulator(lambda of: sent.append(of[0]), 2, PERIOD) as stimulator:
        begun(stimulator)
        stimulator.send(HALF)
        begin = time.monotonic()
        until(lambda: stimulator.resting)
        assert time.monotonic() - begin > 0.8 * PAUSE * PERIOD
        assert sent[-1] == 0.0
        assert not stimulator.send(HALF)
        zeros = len(sent)
        until(lambda: len(sent) > zeros)  # 0 is repeated
        begun(stimulator)
        assert stimulator.send(HALF)
        stimulator.rest("the counter went back")
        assert sent[-1] == 0.0
        assert not stimulator.send(HALF)
        assert (stimulator.pauses, stimulator.reason) == (2, "the counter went back")


def test_a_pulse_that_waited_in_the_line_does_not_end_a_rest():
    """A rest of 200 s, at whose end pulses follow each other faster than in real time."""
    with Stimulator(lambda _: None, 2, 10.0) as stimulator:
        assert not stimulator.rested()
        assert stimulator._since is not None
        stimulator._since -= 201.0
        stimulator._before -= 1.0
        assert not stimulator.rested()
        stimulator._before -= 6.0
        assert stimulator.rested()


@pytest.mark.parametrize("how", ["STOP", "the page's process has ended"])
def test_a_stop_is_obeyed_at_once_also_while_the_loop_is_busy(how):
    sent, view = [], View()
    with Stimulator(lambda of: sent.append(of[0]), 2, 100.0, view) as stimulator:
        stimulator._since = (
            stimulator._before
        ) = -1e9  # the rest is over; a pause would take half an hour
        begun(stimulator)
        stimulator.send(HALF)
        view.press.send_bytes(b"stop") if how == "STOP" else view.press.close()
        until(lambda: sent[-1] == 0.0, seconds=1.0)
        until(lambda: view.outputs[-1] == Output.ZERO)
        assert stimulator.stopped
        assert not stimulator.send(HALF)
        assert not stimulator.rested()
    assert set(sent[2:]) == {0.0}


def test_nothing_but_0_follows_a_stop_in_a_race():
    """Twenty displays, each stopped in the midst of sends that follow each other at once."""
    for _ in range(20):
        sent, view = [], View()
        with Stimulator(lambda of, sent=sent: sent.append(of[0]), 2, PERIOD, view) as stimulator:
            stimulator._since = stimulator._before = -1e9
            begun(stimulator)
            assert stimulator.send(HALF)
            stopper = threading.Timer(1e-3, view.press.send_bytes, (b"stop",))
            stopper.start()
            while stimulator.send(HALF):
                pass
            last = len(sent) - sent[::-1].index(0.5)
            assert not any(stimulator.send(HALF) for _ in range(100))
            stopper.join()
        assert set(sent[last:]) == {0.0}
        assert len(sent) > last


def display(act, send=lambda _: None, view=None):
    """A display that is doing something when it ends."""
    with Stimulator(send, 2, PERIOD, view) as stimulator:
        act(stimulator)


class Connection:
    """Takes 0 until it is broken, and never another amplitude."""

    def __init__(self, error):
        self.error, self.broken = error, False

    def __call__(self, amplitude):
        if self.broken or amplitude.any():
            raise self.error

    def breaks(self, then):
        """What breaks the connection before something else happens."""

        def act(stimulator):
            self.broken = True
            then(stimulator)

        return act


def refuse(_):
    raise ValueError("a block has 5 electrodes, not 4.")


@pytest.mark.parametrize("then", [lambda _: None, lambda of: until(lambda: of.stopped), refuse])
def test_a_zero_that_could_not_be_sent_is_said_loudly(then):
    """At the end, in a pause, and after another error."""
    send, view = Connection(RuntimeError("no such channel")), View()  # a driver's own kind of error
    text = r"AMPLITUDE 0 COULD NOT BE SENT \(no such channel\): SWITCH THE STIMULATOR OFF"
    with pytest.raises(ConnectionError, match=text) as caught:
        display(send.breaks(then), send, view)
    assert ("a block has 5 electrodes, not 4" in str(caught.value)) == (then is refuse)
    assert view.outputs[-1] == Output.LOST


def test_an_amplitude_of_which_perhaps_a_part_was_sent_is_a_lost_connection():
    def act(stimulator):
        begun(stimulator)
        stimulator.send(HALF)

    with pytest.raises(ConnectionError, match=r"COULD NOT BE SENT \(timed out\)"):
        display(act, Connection(TimeoutError("timed out")))


def test_a_stimulator_that_is_not_there_is_an_error_at_once():
    send = Connection(BrokenPipeError("broken pipe"))
    send.broken = True
    with pytest.raises(BrokenPipeError):
        display(pytest.fail, send)


@pytest.mark.usefixtures("in_the_foreground")
def test_an_error_has_a_note_that_0_was_sent_and_signals_have_their_handlers_again():
    def handlers():
        return [signal.getsignal(of) for of in (signal.SIGINT, signal.SIGTERM, signal.SIGTSTP)]

    def act(stimulator):
        changed = zip(handlers(), before, strict=True)
        assert all(one != other for one, other in changed)
        refuse(stimulator)

    before = handlers()
    with pytest.raises(ValueError, match="5 electrodes") as caught:
        display(act)
    assert caught.value.__notes__ == [SENT]
    assert handlers() == before


# Prints what it sends. It works, or is busy without a look at signals, as XLA is when it compiles.
RUNS = """
import hashlib, os, signal, sys, time
import numpy as np
from etid.display.stimulator import Stimulator
for of in (signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM, signal.SIGTSTP):
    signal.signal(of, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
how = sys.argv[1]
with Stimulator(lambda of: os.write(1, b"%g\\n" % of[0]), 2, 2e-3 if how != "busy" else 5.0) as one:
    one._since = one._before = -1e9
    while not one.rested():
        pass
    one.send(np.full(2, 0.5))
    if how == "busy":
        hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
    while how == "works":
        one.send(np.full(2, 0.5))
        time.sleep(1e-3)
    if how == "exits":
        sys.exit(3)
"""


def runs(how):
    return subprocess.Popen(
        [sys.executable, "-c", RUNS, how], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"])
@pytest.mark.parametrize("twice", [False, True])
def test_a_signal_that_ends_a_program_leaves_0_behind(name, twice):
    with runs("works") as program:
        assert program.stdout is not None
        while program.stdout.readline() != "0.5\n":
            pass
        program.send_signal(getattr(signal, name))
        if twice:  # someone is in a hurry: where the second one interrupts depends on the moment
            program.send_signal(signal.SIGINT)
        sent, said = program.communicate(timeout=60)
    assert sent.splitlines()[-1] == "0"
    if not twice:
        assert said.splitlines()[-2:] == ["KeyboardInterrupt", SENT]
    assert program.returncode == -signal.SIGINT  # as Python ends after a KeyboardInterrupt


def test_a_signal_is_obeyed_at_once_while_the_program_is_busy():
    with runs("busy") as program:
        assert program.stdout is not None
        while program.stdout.readline() != "0.5\n":
            pass
        begin = time.monotonic()
        os.kill(program.pid, signal.SIGTERM)
        assert program.stdout.readline() == "0\n"
        assert time.monotonic() - begin < 10
        assert program.poll() is None, "it is still busy"
        program.kill()


@pytest.mark.parametrize(("how", "status"), [("ends", 0), ("exits", 3)])
def test_a_program_that_ends_leaves_0_behind(how, status):
    with runs(how) as program:
        sent, _ = program.communicate(timeout=60)
    assert sent.splitlines()[-1] == "0"
    assert program.returncode == status
