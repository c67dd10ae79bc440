"""What a stimulator is sent: amplitudes while a display runs, else 0.

    with Stimulator(send, electrodes=98, period=1 / 60, view=view) as stimulator:
        for tick in follow(blocks, controller, charge=80e-9, stimulator=stimulator, view=view):
            ...

A person is at the display. The program may end in many ways, it may be busy, and blocks may fail to
come. A thread of its own therefore sends the zeros, and everything that is sent passes one lock:

- At the start the amplitude is 0: the display is at rest.
- If no new amplitude is sent for `PAUSE` periods, 0 is sent, and the display is at rest again. It
  does not matter why: silence of the converter, blocks that belong to no pulse, a loop that hangs.
- At rest 0 is repeated every `PAUSE` periods, and no other amplitude is sent. The rest ends with a
  pulse that comes `PAUSE` periods after the first one of this rest, and half a period after the one
  before. So no pulse that waited in the line is taken for one of the amplitudes that follow.
- After a stop 0 is sent at once, and no other amplitude any more. STOP of the page, the end of the
  page's process, and the signals that end a program are stops.
- Whatever leaves the `with` block, 0 is sent first.

A program that is killed, or a computer that fails, sends nothing more: a stimulator has to take the
end of its connection for amplitude 0.
"""

import contextlib
import enum
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from types import FrameType, TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

PAUSE = 20  # periods that nothing waits for: longer than a computer hesitates, shorter than people
AGAIN = 0.1  # [s] until the last 0 is repeated: a connection that has gone takes the first one
ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGBREAK")
SENT = "amplitude 0 was sent to all electrodes"


class Output(enum.IntEnum):
    """What a stimulator gives; the page has the same numbers."""

    UNKNOWN = 0  # no stimulator is controlled
    REST = 1  # 0, until pulses come
    RUNNING = 2
    ZERO = 3  # 0 for good
    LOST = 4  # 0 could not be sent


@runtime_checkable
class Watched(Protocol):
    """A view, as a stimulator sees it."""

    stopping: Connection  # ready as soon as someone has stopped, or nobody can any more

    def told(self, output: Output) -> None:
        """Take what the stimulator gives now."""


class Stimulator:
    """Sends amplitudes to a stimulator, and makes 0 the last one.

    Args:
        send: Gives amplitudes to the stimulator, for the pulses that follow.
        electrodes: Number of electrodes.
        period: Pulse period [s].
        view: The page that shows the display and can stop it.

    Attributes:
        resting: Whether the display is at rest: 0 was sent, and nothing else will be.
        stopped: Whether 0 was sent for good.
        pauses: How often the display had to rest since it began.
        reason: Why the display is at rest, or was the last time; empty before the first pause.
        step: Step of the amplitudes that it can give; 0 for any, or if it has not said.
    """

    def __init__(
        self,
        send: Callable[[Float[np.ndarray, " lane"]], None],
        electrodes: int,
        period: float,
        view: Watched | None = None,
    ) -> None:
        self._send, self._view, self._zero = send, view, np.zeros(electrodes)
        self._period, self._pause = period, PAUSE * period
        self._lock = threading.Lock()
        self._guarded = False  # while the caller's thread sends
        self._due = 0.0
        self._since: float | None = None  # the first pulse of this rest
        self._before = 0.0  # and the last one
        self._lost: Exception | None = None
        self._signal: int | None = None
        self._numbers = set[int]()  # of the signals that are stops
        self._ended = False
        self.resting, self.stopped, self.pauses, self.reason = True, False, 0, ""
        self.step = 0.0
        self._waking, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._handlers = contextlib.ExitStack()

    def send(self, amplitude: Float[np.ndarray, " lane"]) -> bool:
        """Send amplitudes, unless the display is at rest or stopped.

        Args:
            amplitude: Amplitude at each electrode, for the next pulse.

        Returns:
            Whether they were sent.
        """
        with self._unbroken():
            if self._view is not None and wait([self._view.stopping], 0):
                self._stop()
            if self.stopped or self.resting:
                return False
            try:
                self._send(amplitude)
            except Exception as error:
                self._lost = error  # perhaps a part was sent: what follows is not understood
                raise
            self._due = time.monotonic() + self._pause
            return True

    def rest(self, reason: str) -> None:
        """Send 0, and no other amplitude until the rest is over.

        Args:
            reason: Why, for people.
        """
        with self._unbroken():
            if not self.stopped:
                self._rest(reason)

    def rested(self) -> bool:
        """Whether the rest is over with the pulse that has come; if so, amplitudes are sent."""
        with self._unbroken():
            now = time.monotonic()
            if self._since is None:
                self._since = self._before = now
            waited, self._before = now - self._before, now
            if self.stopped or now - self._since < self._pause or waited < self._period / 2:
                return False
            self.resting, self._due = False, now + self._pause
            self._tell(Output.RUNNING)
            return True

    def __enter__(self) -> "Stimulator":
        with self._lock:
            self._give_zero(Output.REST)
        if self._lost is not None:
            self._close()
            raise self._lost
        self._listen()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Send 0.

        The error that leaves the block gets a note that says so.

        Raises:
            ConnectionError: 0 could not be sent.
            KeyboardInterrupt: A signal has ended the display.
        """
        self._guarded = True
        with self._lock:
            self._stop()
        self._ended = True
        self._waking.send(b"\0")
        self._thread.join()
        time.sleep(AGAIN)
        self._give_zero(Output.ZERO)
        self._close()
        if self._lost is not None:
            cause = f" (after: {error})" if str(error or "") not in ("", str(self._lost)) else ""
            raise ConnectionError(
                f"AMPLITUDE 0 COULD NOT BE SENT ({self._lost}): SWITCH THE STIMULATOR OFF{cause}"
            ) from error
        if error is None and self._signal is not None:
            error = KeyboardInterrupt()
            error.add_note(SENT)
            raise error
        if error is not None:
            error.add_note(SENT)

    @contextlib.contextmanager
    def _unbroken(self) -> Iterator[None]:
        """Let no other thread send, and let signals wait until all is sent."""
        self._guarded = True
        try:
            with self._lock:
                yield
        finally:
            self._guarded = False
        if self._signal is not None:
            raise KeyboardInterrupt

    def _watch(self) -> None:
        """Send 0 when nothing else was sent for a while, and at once at a stop."""
        sources: list[Connection | socket.socket] = [self._woken]
        if self._view is not None:
            sources.append(self._view.stopping)
        while not self._ended:
            ready = wait(sources, max(0.0, self._due - time.monotonic()))
            stop = self._view is not None and self._view.stopping in ready
            if self._woken in ready:
                stop = not self._numbers.isdisjoint(self._woken.recv(64)) or stop
            with self._lock:
                if stop:
                    self._stop()
                    del sources[1:]
                elif time.monotonic() >= self._due:
                    self._rest(f"no new amplitude for {self._pause:.2g} s")

    def _rest(self, reason: str) -> None:
        if not self.resting:
            self.resting, self.reason, self.pauses = True, reason, self.pauses + 1
            self._since = None
        self._give_zero(Output.ZERO if self.stopped else Output.REST)

    def _stop(self) -> None:
        if not self.stopped:
            self.stopped = self.resting = True
            self._give_zero(Output.ZERO)

    def _give_zero(self, output: Output) -> None:
        """Send 0; if this fails, nothing more can be done here."""
        try:
            self._send(self._zero)
        except Exception as error:  # whatever the program of a stimulator raises
            self._lost = self._lost or error
        if self._lost is not None:
            self.stopped = self.resting = True
        self._due = time.monotonic() + self._pause
        self._tell(output if self._lost is None else Output.LOST)

    def _close(self) -> None:
        self._handlers.close()
        self._waking.close()
        self._woken.close()

    def _tell(self, output: Output) -> None:
        if self._view is not None:
            self._view.told(output)

    def _listen(self) -> None:
        """Take the signals that end a program for a stop.

        Python calls a handler between two of its own instructions, which may be much later while a
        program compiles. The number of the signal reaches the thread at once.
        """
        if threading.current_thread() is not threading.main_thread():
            return  # signals belong to the main thread
        self._waking.setblocking(False)
        before = signal.set_wakeup_fd(self._waking.fileno(), warn_on_full_buffer=False)
        self._handlers.callback(signal.set_wakeup_fd, before)
        for name in ENDING:
            number = getattr(signal, name, None)
            usual = None if number is None else signal.getsignal(number)
            if number is not None and usual not in (None, signal.SIG_IGN):
                self._numbers.add(number)
                signal.signal(number, self._signalled)
                self._handlers.callback(signal.signal, number, usual)

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        """End the program, of which the thread has made a stop already."""
        del frame
        self._signal = number
        if not self._guarded:
            raise KeyboardInterrupt
