"""Show and control a running display in the browser."""

import argparse
import collections
import contextlib
import pathlib
import sys

from etid.commands import Outcome
from etid.identify.driver import identify_driver
from etid.live.loop import follow
from etid.live.view import PORT, LiveView
from etid.online.controller import Controller
from etid.online.stream import connected, played, received, sender
from etid.online.tracker import Tracker
from etid.plotting.layout import read_layout
from etid.simulation.calibration import calibrations_in


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments: the calibration, the stream, and the display."""
    parser.add_argument("calibration", type=pathlib.Path, metavar="CALIBRATION")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--file", type=pathlib.Path, help="HDF5 file whose v_out (electrode, sample) is played"
    )
    source.add_argument(
        "--socket", metavar="HOST:PORT", help="stimulator: sends blocks, and is sent amplitudes"
    )
    parser.add_argument("--electrodes", type=int, default=98, help="default: 98")
    parser.add_argument(
        "--layout", type=pathlib.Path, metavar="FILE", help="places of the electrodes"
    )
    parser.add_argument(
        "--charge", type=float, default=80e-9, metavar="COULOMB", help="wanted per phase"
    )
    parser.add_argument("--charge-cap", type=float, metavar="COULOMB", help="largest per phase")
    parser.add_argument(
        "--change", type=float, default=3e-3, help="of the skin [1/√pulse]; default: 0.003"
    )
    parser.add_argument("--speed", type=float, default=1.0, help="of a file; 1: real time")
    parser.add_argument("--port", type=int, default=PORT, help=f"of the page; default: {PORT}")


def run(arguments: argparse.Namespace) -> Outcome:
    """Show the stream to its end, or until someone stops, and return what came of it."""
    records = calibrations_in([arguments.calibration])
    tracker = Tracker.of(
        identify_driver(records),
        records[0],
        electrodes=arguments.electrodes,
        change=arguments.change,
    )
    cap = {} if arguments.charge_cap is None else {"charge_cap": arguments.charge_cap}
    controller = Controller.of(tracker, **cap)
    layout = None if arguments.layout is None else read_layout(arguments.layout)
    send = None
    with contextlib.ExitStack() as opened:
        if arguments.socket is None:
            rate = records[0].sample_rate
            blocks = played(arguments.file, arguments.electrodes, rate, arguments.speed)
        else:
            line = opened.enter_context(connected(arguments.socket))
            blocks = received(line)
            send = sender(line)
        view = opened.enter_context(
            LiveView(
                controller,
                charge=arguments.charge,
                controls=send is not None,
                layout=layout,
                port=arguments.port,
            )
        )
        print(f"{view.address} shows the display; Ctrl-C ends it", file=sys.stderr, flush=True)
        ticks = follow(blocks, controller, charge=arguments.charge, send=send, view=view)
        last = collections.deque(ticks, maxlen=1)
    if not last:
        raise ValueError("the stream ended before the first pulse")
    tick = last[0]
    data = {
        "source": arguments.socket or arguments.file,
        "pulses": tick.number + 1,
        "incomplete": tick.missing,
        "late": tick.late,
        "stopped": tick.stopped,
    }
    text = f"{tick.number + 1} pulses, {tick.missing} incomplete, {tick.late} late blocks"
    return Outcome(text + (", stopped" if tick.stopped else ""), data)
