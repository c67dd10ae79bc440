"""The live view, as the loop sees it: it is given each tick, and says whether someone has stopped.

The page is served by a process of its own, which gets a snapshot ten times a second through a slot
of fixed size. A newer snapshot replaces an older one, and nothing here waits for a page. A stop
comes through a pipe. If that process ends, nobody could stop any more: the end of the pipe is a
stop, too.
"""

import importlib.util
import multiprocessing
import secrets
import socket
import time
from collections import deque
from multiprocessing.connection import wait
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from etid.display.controller import Controller
from etid.display.stimulator import SENT, Output
from etid.plotting.layout import Layout, like_fingertip
from etid.precision import untraced
from etid.printing import first_of, heading, scaled
from etid.recordings.errors import in_one_line, install
from etid.results.verdicts import USABLE, verdict_names

if TYPE_CHECKING:
    from etid.display.loop import Tick

PORT = 8765
EVERY = 0.1  # [s] between two snapshots
ALARMS = 12  # alarms that are listed
SEEN = 1.2  # [s] for windows to see the last snapshot: one in the background asks once a second
GOOD = "good"  # state of an electrode that needs no alarm
NEW = "not identified: too_short"  # of an electrode before its first pulse, which is no alarm
DRIVER = "driver changed"  # of all electrodes, which has an alarm of its own


class LiveView:
    """A page that shows a display.

    Attributes:
        address: Where a browser of this computer finds it.
        stopping: Ready to be read as soon as someone has stopped, or nobody can any more.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        charge: float,
        controls: bool,
        layout: Layout | None = None,
        port: int = PORT,
    ) -> None:
        """Begin to serve the page.

        Args:
            controller: The controller of the display.
            charge: Wanted charge per phase [C].
            controls: Whether the commands reach a stimulator.
            layout: Places of the electrodes, in their order; default: E1, E2, … in rows of seven,
                2 mm apart, as the paper's display.
            port: Port at the loopback address; 0 for any that is free.

        Raises:
            ValueError: Tornado is missing, the layout has another number of electrodes, or the port
                is in use or no port.
        """
        if importlib.util.find_spec("tornado") is None:
            raise ValueError(f"the live view needs tornado: {install('live')}")
        from etid.display.server import Slot, serve  # here, because it imports tornado

        if not 0 <= port < 2**16:
            raise ValueError(f"port is {port}; give a number from 0 to {2**16 - 1}")
        tracker = controller.tracker
        number, bands, circuit = tracker.electrodes, tracker.model.bands, tracker.model.circuit
        layout = layout or like_fingertip(number)
        if len(layout.electrodes) != number:
            raise ValueError(
                f"the layout has {len(layout.electrodes)} electrodes, the display {number}; give "
                "the layout of this display"
            )
        self._controller, self._controls, self._names = controller, controls, layout.electrodes
        self._model = untraced(tracker.model)
        # A pulse is drawn where it exceeds a fifth of its peak, and half as far on both sides.
        high = np.flatnonzero(np.abs(of := bands.waveform()) > 0.2 * np.abs(of).max())
        margin = (high[-1] - high[0]) // 2 + 1
        self._part = slice(max(high[0] - margin, 0), high[-1] + margin)
        units = {name: circuit.units()[name] for name in circuit.names()}
        self._scale = np.array([scaled(unit)[0] for unit in units.values()])
        samples = np.arange(of.size)[self._part]
        dtype = [
            ("pulse", int), ("missing", int), ("late", int), ("slowest", float), ("end", "S400"),
            ("bad", bool),
            ("elements", float, (len(units), number)), ("charge", float, number),
            ("words", "S40", number), ("electrode", int), ("v_out", float, samples.size),
            ("predicted", float, samples.size), ("alarms", "S200", ALARMS),
        ]  # fmt: skip
        told = {
            "token": secrets.token_urlsafe(),
            "start": secrets.token_urlsafe(),
            "controls": controls,
            "wanted": charge / 1e-9,  # [nC]
            "names": self._names,
            "x": layout.x.tolist(),
            "y": layout.y.tolist(),
            "elements": [heading(*of) for of in units.items()],
            "time": (1e6 * samples / bands.sample_rate).tolist(),
        }
        try:
            listening = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise ValueError(
                f"port {port} cannot be used ({error.strerror}); does another live view run? End "
                "it, or name another port"
            ) from None
        self.address = f"http://127.0.0.1:{listening.getsockname()[1]}"
        context = multiprocessing.get_context("spawn")
        self._snapshot = np.zeros(1, dtype)
        self._slot = Slot(context, self._snapshot.dtype)
        self._process = context.Process(
            target=serve, args=(listening, self._slot, told), daemon=True
        )
        self.stopping = self._slot.stopping
        with listening, self._slot.press:  # the other process has both
            self._process.start()
        self._last: Tick | None = None
        self._due = self._slowest = 0.0
        self._spare = tracker.period / bands.sample_rate / 2
        self._words = [NEW] * number
        self._above = np.zeros(number, bool)  # the charge cap, since the last snapshot
        self._alarms: deque[str] = deque(maxlen=ALARMS)

    @property
    def stopped(self) -> bool:
        """Whether someone has stopped, or nobody can any more."""
        return bool(wait([self.stopping], 0))

    def told(self, output: Output) -> None:
        """Tell the page at once what the stimulator gives."""
        self._slot.output.value = output

    def note(self, alarm: str) -> None:
        """Note an alarm, which is shown with the next tick."""
        self._alarms.appendleft(alarm)

    def show(self, tick: "Tick") -> None:
        """Hand over a tick, at most ten times a second.

        A tick that took half of its period is not shown, unless none was shown for a second.
        """
        self._note_changes(tick)
        self._last, self._slowest = tick, max(self._slowest, tick.seconds)
        self._above |= self._given(tick) > float(self._controller.limits.charge_cap)
        now = time.monotonic()
        early = now < self._due or (tick.seconds > self._spare and now < self._due + 1.0)
        if not early:
            self._due = now + EVERY
            self._fill(tick)
            self._slot.put(self._snapshot, wait=False)
            self._above[:] = False

    def _fill(self, tick: "Tick") -> None:
        """Make a tick the snapshot."""
        self._alarm(tick.number, self._seen(tick))
        state = tick.state.electrodes
        at = min(self._slot.electrode.value, len(self._names) - 1)
        of = self._snapshot[0]
        of["pulse"], of["missing"], of["late"] = tick.number + 1, tick.missing, tick.late
        of["slowest"], of["electrode"] = 1e3 * self._slowest, at
        own = np.asarray(state.own)
        known = np.asarray(state.pulses) > 0
        of["elements"] = np.where(known, np.exp(own[:, :-1].T) / self._scale[:, None], np.nan)
        of["charge"] = self._given(tick) / 1e-9
        of["words"] = [word.encode() for word in self._words]
        of["v_out"] = tick.window[at, self._part]
        of["predicted"] = self._predicted(tick, at)
        texts = [text.encode() for text in self._alarms]
        of["alarms"] = texts + [b""] * (ALARMS - len(texts))

    def close(self, end: str = "The program has ended.", *, bad: bool = False) -> None:
        """End the page, after its windows had the time to see the last tick and why it is so.

        Args:
            end: How the display has ended.
            bad: Whether somebody should look after it.
        """
        try:
            if self._last is not None:
                self._fill(self._last)
            of = self._snapshot[0]
            of["end"], of["bad"] = end.encode(), bad
            self._slot.put(self._snapshot, wait=True)
            time.sleep(SEEN if self._process.is_alive() else 0)
        finally:
            self._process.terminate()
            self._process.join()

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        how, bad = "Stopped" if self.stopped else "The stream has ended", False
        if error is not None:
            bad = not isinstance(error, KeyboardInterrupt)
            how = "An error ended the program" if bad else "Interrupted"
        after = "before the first pulse"
        if self._last is not None:
            after = f"after pulse {self._last.number + 1}"
        zero = SENT if self._controls else ""
        said = zero if error is None else in_one_line(error)
        self.close(f"{how} {after}{': ' * bool(said)}{said.removesuffix('.')}.", bad=bad)

    def _seen(self, tick: "Tick") -> list[str]:
        """The state of each electrode in words."""
        tracker, state = self._controller.tracker, tick.state
        words = [
            GOOD if verdict in USABLE else f"not identified: {verdict}"
            for verdict in verdict_names(state.electrodes.result)
        ]
        if self._controls:
            caps = ("peak", "charge", "guard", "voltage")
            for at in np.flatnonzero(np.isin(tick.command.reason, caps)):
                words[at] = f"cap reached: {tick.command.reason[at]}"
        for at in np.flatnonzero(self._above):
            words[at] = "above the charge cap"
        for at, reason in tracker.bad_electrodes(state).items():
            words[at] = "contact lost" if reason == "open" else reason
        return [DRIVER] * len(words) if bool(state.driver_changed) else words

    def _note_changes(self, tick: "Tick") -> None:
        """Note the changes that a pulse has shown: those that are alike as one alarm."""
        found: dict[str, list[str]] = {}
        for change in tick.changes:
            if change.kind == "driver" and tick.before.driver_changed:
                continue  # it is known
            names = found.setdefault(change.words("{}"), [])
            if change.electrode is not None:
                names.append(self._names[change.electrode])
        for text, names in found.items():
            self.note(f"Pulse {tick.number + 1}: {text.format(first_of(names, 6))}")

    def _alarm(self, number: int, words: list[str]) -> None:
        """Note the electrodes whose state has become another one that is not good."""
        for word in dict.fromkeys(words):
            new = [at for at, now in enumerate(words) if now == word != self._words[at]]
            if new and word not in (GOOD, NEW, DRIVER):
                names = first_of([self._names[at] for at in new], 6)
                self.note(f"Pulse {number + 1}: {word}, at {names}")
        self._words = words

    def _given(self, tick: "Tick") -> Float[np.ndarray, " lane"]:
        """Charge per phase that the last pulse gave, with the elements after it [C]."""
        amplitude, command = np.asarray(tick.state.electrodes.amplitude), tick.command
        per_unit = command.charge / np.where(command.amplitude > 0, command.amplitude, np.nan)
        return np.where(amplitude == 0, 0.0, per_unit * amplitude)

    def _predicted(self, tick: "Tick", at: int) -> Float[np.ndarray, " sample"]:
        """The pulse that the state before it predicts, with this pulse's delay and offset [V]."""
        before, state = tick.before.electrodes, tick.state.electrodes
        if not np.asarray(before.pulses)[at]:
            return np.full(self._snapshot["predicted"].shape[-1], np.nan)
        bands = self._controller.tracker.model.bands
        gain = self._model.undelayed(np.asarray(before.own)[at, :-1])
        pulse = bands.waveform(gain, float(np.asarray(state.own)[at, -1]))
        pulse = np.asarray(state.amplitude)[at] * pulse
        return pulse[self._part] + tick.window[at].mean()
