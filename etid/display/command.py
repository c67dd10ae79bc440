"""Show and control a running display in the browser."""

import argparse
import collections
import contextlib
import pathlib
import sys

from etid.commands import Outcome
from etid.display.controller import Controller
from etid.display.loop import follow
from etid.display.stimulator import SENT, Stimulator
from etid.display.stream import connected, played, received, sender
from etid.display.tracker import Tracker
from etid.display.view import PORT, LiveView
from etid.identify.driver import identify_driver
from etid.plotting.layout import read_layout
from etid.printing import several
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
    parser.add_argument(
        "--discrepancy",
        type=float,
        default=0.0,
        help="what the circuit leaves of the signal, as a fit of such skin says; default: 0",
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
        discrepancy=arguments.discrepancy,
    )
    cap = {} if arguments.charge_cap is None else {"charge_cap": arguments.charge_cap}
    controller = Controller.of(tracker, **cap)
    layout = None if arguments.layout is None else read_layout(arguments.layout)
    rate, stimulator = records[0].sample_rate, None
    with contextlib.ExitStack() as opened:
        if arguments.socket is None:
            line = None
            blocks = played(arguments.file, arguments.electrodes, rate, arguments.speed)
        else:
            line = opened.enter_context(connected(arguments.socket))

            def stepped(step: float) -> None:
                if stimulator is not None:
                    stimulator.step = step

            blocks = received(line, lambda: stimulator is not None and stimulator.stopped, stepped)
        view = opened.enter_context(
            LiveView(
                controller,
                charge=arguments.charge,
                controls=line is not None,
                layout=layout,
                port=arguments.port,
            )
        )
        if line is not None:
            period = tracker.period / rate
            stimulator = opened.enter_context(
                Stimulator(sender(line), tracker.electrodes, period, view)
            )
        print(f"{view.address} shows the display; Ctrl-C ends it", file=sys.stderr, flush=True)
        ticks = follow(
            blocks, controller, charge=arguments.charge, stimulator=stimulator, view=view
        )
        last = collections.deque(enumerate(ticks, start=1), maxlen=1)
        stopped = view.stopped
    if not (last or stopped):
        raise ValueError("the stream ended before the first pulse")
    pulses, tick = last[0] if last else (0, None)
    data = {
        "source": arguments.socket or arguments.file,
        "pulses": pulses,
        "incomplete": tick.missing if tick else 0,
        "late": tick.late if tick else 0,
        "pauses": stimulator.pauses if stimulator else 0,
        "stopped": stopped,
    }
    text = [several(pulses, "pulse"), f"{data['incomplete']} incomplete"]
    text.append(several(data["late"], "late block"))
    if stimulator is not None:
        text += [several(stimulator.pauses, "pause"), SENT]
    return Outcome(", ".join(text + ["stopped"] * stopped), data)


def after_interrupt(arguments: argparse.Namespace) -> str:
    """Message after Ctrl-C before or after the display has run."""
    told = "the last amplitude, if any was sent, is 0"
    return "nothing was changed" if arguments.socket is None else told
