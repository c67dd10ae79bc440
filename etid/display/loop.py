"""The loop of a display: each pulse is tracked, and the next one commanded, until someone stops."""

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from etid.display.controller import Command, Controller
from etid.display.state import Change, TrackerState
from etid.display.stimulator import Stimulator
from etid.display.stream import Block, Pulses
from etid.display.view import LiveView

RESTARTED = "the counter of samples began anew"


class Tick(NamedTuple):
    """A pulse, and what follows from it.

    Attributes:
        number: Number of the pulse in the stream, from 0 on.
        window: Its voltages [V]; what is missing is NaN.
        before: State of the tracker before the pulse.
        state: State after it.
        command: What to give at the next pulse.
        changes: Changes that the pulse has shown.
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
    seconds: float
    missing: int
    late: int


def follow(
    blocks: Iterable[Block],
    controller: Controller,
    *,
    charge: float,
    stimulator: Stimulator | None = None,
    view: LiveView | None = None,
) -> Iterator[Tick]:
    """The ticks of a stream, until it ends or someone stops.

    While the display is at rest there are no ticks. After the rest, the tracker begins anew.

    Args:
        blocks: The stream.
        controller: The controller of the display.
        charge: Wanted charge per phase [C].
        stimulator: Is sent the amplitudes. Without it, all pulses have the amplitude of the
            unloaded record.
        view: The page that shows the ticks and can stop.

    Raises:
        ValueError: A block has another number of electrodes.
    """
    tracker = controller.tracker
    pulses = Pulses(tracker.clock(), tracker.electrodes)
    at_rest, given = stimulator is not None, np.ones(tracker.electrodes)
    state = tracker.start(at_rest=at_rest)
    # It compiles here, while nothing waits.
    first = tracker.update(state, pulses.window, given)
    controller.command(first, charge=charge)
    tracker.changes(first)
    last, watched, step = -1, stimulator or view, 0.0
    for number, window in pulses.cut(blocks):
        if watched is not None and watched.stopped:
            return
        begin = time.perf_counter()
        if stimulator is not None and stimulator.step != step:
            step = stimulator.step
            controller = controller.stepped(step)
        if number <= last:
            state = tracker.start(at_rest=at_rest, after=state)
            if stimulator is not None:
                stimulator.rest(RESTARTED)
        last = number
        if stimulator is not None and stimulator.resting:
            if stimulator.rested():
                state = tracker.start(at_rest=True, after=state)
                given = controller.command(state, charge=charge).amplitude
                stimulator.send(given)
                if view is not None and stimulator.reason:
                    text = "amplitude 0 was sent, and stimulation begins anew from rest"
                    view.note(f"Pulse {number + 1}: {stimulator.reason}: {text}")
            continue
        before, state = state, tracker.update(state, window, given)
        command = controller.command(state, charge=charge)
        if stimulator is not None:
            given = command.amplitude
            stimulator.send(given)
        changes, seconds = tracker.changes(state), time.perf_counter() - begin
        counts = (pulses.missing, pulses.late)
        tick = Tick(number, window, before, state, command, changes, seconds, *counts)
        if view is not None:
            view.show(tick)
        yield tick
