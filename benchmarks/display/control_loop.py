"""The last amplitude is 0: hazards of the loop that runs a display, from silence to Ctrl-C.

A simulated display (`control_plant`) gives a pulse of the last amplitudes in each period and sends
its records through a socket; `etid.display` runs it. Its pulses come at twice 60 Hz, and a
pause is half as long.

Each run meets one hazard, some pulses after stimulation began. Where the stream goes on, the loop
may begin anew, in half of the runs with all electrodes wet since the 0. A positive amplitude
**follows the 0** if it is sent before pulses have come again for as long as a pause, or at all
where the hazard is an end. The time to the 0 begins with the hazard: with the time of the first
block that does not come, or that is wrong.
"""

import contextlib
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from unittest import mock

import numpy as np
from jaxtyping import Float

from benchmarks.display import control_hazards
from benchmarks.display.control_hazards import CAP, FIRST, PATH, WANTED, WET, Hazards
from benchmarks.display.control_plant import OLDER
from benchmarks.runner import Target, at_most
from etid.display import Controller, Tracker
from etid.display.loop import follow
from etid.display.stimulator import PAUSE, Output, Stimulator
from etid.display.stream import WAIT, received

LANES = 4
PERIOD = 1 / 120  # [s]
LASTS = 25, 70  # pulses without a good block: more than a pause
LONGEST = 1000  # pulses of a run that nothing ends
ANEW = 5  # pulses with amplitudes after a hazard, before the stream ends
GOES_ON = ("silence", "backlog", "late blocks", "counter from 0")
ENDS: dict[str, tuple[type[BaseException], ...]] = {  # and what they raise
    "STOP before the first amplitude": (),
    "STOP": (),
    "STOP in silence": (),
    "other electrodes": (ValueError,),
    "malformed header": (ValueError,),
    "signal": (KeyboardInterrupt,),
    "tracker raises": (RuntimeError,),
}
CELLS = (*GOES_ON, *ENDS)
TARGETS = {
    "runs of the loop whose last amplitude is not 0": at_most(0),
    "positive amplitudes that follow the 0 of a hazard": at_most(0),
    "pulses of the loop above the cap": at_most(0),
    "longest time from a hazard of the loop to 0 [s]": at_most(PAUSE * PERIOD),
}
COLUMNS = ("last_not_0", "positive_after_0", "above_cap", "longest_s")


class Display:
    """A display that meets a hazard.

    Attributes:
        line: The end of the socket that the loop reads.
        stopping: Ready as soon as someone has pressed STOP.
        sent: Time [s] and amplitudes of all that was sent.
        hazard: When the hazard came [s].
        back: When pulses came again [s].
        broken: Whether the tracker has to raise.
    """

    def __init__(self, cell: str, hazards: Hazards, rng: np.random.Generator) -> None:
        self._cell, self._plant, self._rng = cell, hazards.display, rng
        self.line, self._end = socket.socketpair()
        self.line.settimeout(WAIT)
        self.stopping, self._press = multiprocessing.Pipe(duplex=False)
        self._early = cell == "STOP before the first amplitude"
        self._at = rng.integers(PAUSE) if self._early else rng.integers(5, 30)
        self._silent = rng.integers(1, 2 * PAUSE) if cell == "STOP in silence" else 0
        self._lasts = rng.integers(*LASTS)
        self._skin, self._wets = FIRST + rng.integers(PATH, size=LANES), rng.random() < 0.5
        self._amplitude, self._number = np.zeros((OLDER, LANES)), 0
        self._held, self._over = b"", 0  # blocks held back; number of the last pulse that came
        self.sent: list[tuple[float, np.ndarray]] = []
        self._charge: list[np.ndarray] = []
        self._anew, self.hazard, self.back, self.broken = 0, np.inf, np.inf, False

    def send(self, amplitude: Float[np.ndarray, " lane"]) -> None:
        """Take amplitudes."""
        self.sent.append((time.monotonic(), amplitude.copy()))

    def told(self, output: Output) -> None:
        """Show nothing."""

    @property
    def zero(self) -> float:
        """When the first 0 after the hazard was sent [s]."""
        return next((at for at, of in self.sent if at >= self.hazard and not of.any()), np.inf)

    @property
    def row(self) -> dict[str, Any]:
        """What the run shows."""
        zero = self.zero
        rested = np.inf if self._cell in ENDS else max(zero, self.back) + PAUSE * PERIOD
        numbers = (
            bool(self.sent[-1][1].any()),
            sum(of.any() and zero < at < rested for at, of in self.sent),
            np.sum(np.array(self._charge) > CAP),
            zero - self.hazard if self.hazard < np.inf else np.inf,
        )
        of = dict(zip(COLUMNS, numbers, strict=True))
        return {"pulses": np.size(self._charge), "begun_anew": self._anew > 0, **of}

    def run(self) -> None:
        """Give pulses until the stream ends, or the loop has hung up."""
        due, running = time.monotonic(), 0
        with self._end, contextlib.suppress(ConnectionError):
            while len(self._charge) < LONGEST and self._anew < ANEW:
                v = self._given()
                running += self._early or self._amplitude[0].any()
                if running <= self._at or self.back < np.inf:
                    self._end.sendall(self._block(self._number, v))
                elif self._silent:
                    self._silent -= 1
                else:
                    self._end.sendall(self._met(v))
                self._number += 1
                due = max(due + PERIOD, time.monotonic())
                time.sleep(max(due - time.monotonic(), 0.0))

    def _given(self) -> Float[np.ndarray, "lane sample"]:
        """Give a pulse; its record [V]."""
        self._amplitude = np.concatenate([self.sent[-1][1][None], self._amplitude[:-1]])
        ended, positive = self.zero < np.inf, self._amplitude[0].any()
        if self._wets and ended and not positive:
            self._skin[:] = WET
        self._anew += ended and positive and self.back < np.inf
        self._charge.append(self._plant.charges(self._skin, self._amplitude))
        return self._plant.windows(self._number, self._skin, self._amplitude)

    def _block(self, number: int, v: Float[np.ndarray, "lane sample"]) -> bytes:
        begin = round(number * control_hazards.PERIOD)
        return np.array([begin, *v.shape], "<i8").tobytes() + v.astype("<f8").tobytes()

    def _met(self, v: Float[np.ndarray, "lane sample"]) -> bytes:
        """What the hazard leaves of a pulse; begins it, or goes on with it."""
        begins, self._lasts = self.hazard == np.inf, self._lasts - 1
        if begins:
            self.hazard, self._over = time.monotonic(), self._number - 1
        if self._cell == "counter from 0":
            self._number = self._lasts = 0
        block = self._block(self._over if self._cell == "late blocks" else self._number, v)
        if self._cell in ENDS:
            before = self._ended(v) if begins else b""
            return b"" if self._cell == "STOP in silence" else before + block
        if self._cell == "backlog":
            self._held = block = self._held + block
        if self._lasts <= 0:
            self.back = time.monotonic()
        going_on = self._lasts <= 0 or self._cell == "late blocks"
        return block if going_on else b""

    def _ended(self, v: Float[np.ndarray, "lane sample"]) -> bytes:
        """End the loop; the bytes that do, if any."""
        match self._cell:
            case "other electrodes":
                others = self._rng.choice([1, LANES - 1, LANES + 1, 98])
                return self._block(self._number, np.resize(v, (others, v.shape[1])))
            case "malformed header":
                return self._rng.bytes(24)
            case "signal":
                os.kill(os.getpid(), self._rng.choice([signal.SIGINT, signal.SIGTERM]))
            case "tracker raises":
                self.broken = True
            case _:
                self._press.send_bytes(b"stop")
        return b""


def row(
    cell: str, hazards: Hazards, controller: Controller, rng: np.random.Generator
) -> dict[str, Any]:
    """What one run shows. Signals need the main thread."""
    display, update = Display(cell, hazards, rng), Tracker.update

    def updated(*arguments: Any) -> Any:
        if display.broken:
            raise RuntimeError("the tracker has failed")
        return update(*arguments)

    thread = threading.Thread(target=display.run, daemon=True)
    # What a shell starts in the background ignores SIGINT.
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with (
            contextlib.suppress(*ENDS.get(cell, ())),
            mock.patch.object(Tracker, "update", updated),
            display.line,
            Stimulator(display.send, LANES, PERIOD, display) as stimulator,
        ):
            thread.start()
            blocks = received(display.line, lambda: stimulator.stopped)
            for _ in follow(blocks, controller, charge=WANTED, stimulator=stimulator):
                pass
    finally:
        signal.signal(signal.SIGINT, usual)
    thread.join()
    return display.row


def rows(
    hazards: Hazards, draws: int, cells: Sequence[str] = CELLS, seed: int = 0
) -> Iterator[dict[str, Any]]:
    """What the runs of each cell show together."""
    controller = hazards.controller(LANES)
    for cell in cells:
        rngs = np.random.default_rng([seed, CELLS.index(cell)]).spawn(draws)
        runs = [row(cell, hazards, controller, rng) for rng in rngs]
        *summed, longest = runs[0]
        numbers = {name: int(sum(run[name] for run in runs)) for name in summed}
        most = round(float(max(run[longest] for run in runs)), 4)
        yield {"cell": cell, "runs": draws, **numbers, longest: most}


def targets(found: Sequence[Mapping[str, Any]]) -> Iterator[Target]:
    """The targets of all cells together."""
    for name, column, of in zip(TARGETS, COLUMNS, (sum, sum, sum, max), strict=True):
        yield Target.of(TARGETS, name, of(row[column] for row in found))
