"""The loop of a display: each pulse is tracked, and the next one commanded, until someone stops."""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from etid.live.view import LiveView
from etid.online.controller import Command, Controller
from etid.online.state import Change, TrackerState
from etid.online.stream import Block, Pulses


class Tick(NamedTuple):
    """A pulse, and what follows from it.

    Attributes:
        number: Number of the pulse in the stream, from 0 on.
        window: Its voltages [V]; what is missing is NaN.
        before: State of the tracker before the pulse.
        state: State after it.
        command: What to give at the next pulse.
        changes: Changes that the pulse has shown.
        stopped: Whether this is the last pulse, because someone has stopped.
        seconds: Time that the tick took [s].
        missing: Pulses so far without all of their samples.
        late: Blocks so far that came after their pulse was over.
    """

    number: int
    window: Float[np.ndarray, "lane sample"]
    before: TrackerState
    state: TrackerState
    command: Command
    changes: list[Change]
    stopped: bool
    seconds: float
    missing: int
    late: int


def follow(
    blocks: Iterable[Block],
    controller: Controller,
    *,
    charge: float,
    send: Callable[[Float[np.ndarray, " lane"]], None] | None = None,
    view: LiveView | None = None,
) -> Iterator[Tick]:
    """The ticks of a stream, until it ends or someone stops.

    After a stop the amplitude 0 is sent, and no further one.

    Args:
        blocks: The stream.
        controller: The controller of the display.
        charge: Wanted charge per phase [C].
        send: Gives amplitudes to the stimulator, for the pulse that follows. The display begins at
            rest. Without it, all pulses have the amplitude of the unloaded record.
        view: The page that shows the ticks and can stop.

    Raises:
        ValueError: A block has another number of electrodes.
    """
    tracker = controller.tracker
    pulses = Pulses(tracker.period, tracker.model.bands.samples, tracker.electrodes)
    state, given = tracker.start(at_rest=send is not None), np.ones(tracker.electrodes)
    # It compiles here, while nothing waits.
    controller.command(tracker.update(state, pulses.window, given), charge=charge)
    if send is not None:
        given = controller.command(state, charge=charge).amplitude
        send(given)
    for number, window in pulses.cut(blocks):
        begin = time.perf_counter()
        before, state = state, tracker.update(state, window, given)
        command, stopped = controller.command(state, charge=charge), False
        if view is not None and view.stopped:
            command, stopped = controller.command(state, charge=0.0), True
        if send is not None:
            given = command.amplitude
            send(given)
        changes, seconds = tracker.changes(state), time.perf_counter() - begin
        counts = (pulses.missing, pulses.late)
        tick = Tick(number, window, before, state, command, changes, stopped, seconds, *counts)
        if view is not None:
            view.show(tick)
        yield tick
        if stopped:
            return
