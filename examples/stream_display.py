"""Identify and control a display of your own, pulse by pulse, with a log.

    etid simulate paper_dry -o calibration.h5 --stream pulses.h5
    python examples/stream_display.py calibration.h5 pulses.h5
    python examples/stream_display.py calibration.h5 pulses.h5 --page

`etid-live` follows a file, or a stimulator at a socket. A lab with another source or stimulator, or
with a log, adapts these lines: `played` becomes its source of blocks (see `etid.display.stream`),
and a `Stimulator` gets what sends amplitudes (see `etid.display.stimulator`). `--page` opens the
live view.

* The calibration file is an etid study whose calibrations have several periods.
* The pulses are the dataset `v_out` (electrode, sample) [V] of an HDF5 file, played in real time.

Blocks that are missing or late cost the pulses that they belong to: these electrodes keep their
elements. The log has one row per pulse; it never replaces a file. Ctrl-C ends the program, and the
log is complete up to there.
"""

import argparse
import contextlib
import pathlib
import sys

import h5py
import numpy as np

import etid
import etid.display
from etid.display.loop import follow
from etid.display.state import Change
from etid.display.stream import played
from etid.display.view import LiveView

FLUSHED = 15  # pulses from one flush of the log to the next


class Log:
    """One row per pulse in an HDF5 file, which is readable after a crash up to the last flush.

    Args:
        path: The file; it must not exist.
        names: Names of the elements.
        electrodes: Number of electrodes.
    """

    def __init__(self, path: pathlib.Path, names: tuple[str, ...], electrodes: int) -> None:
        self.file = h5py.File(path, "x")
        self.rows: dict[str, h5py.Dataset] = {}
        columns = {
            "pulse": int,
            "amplitude": float,
            "charge": float,
            "seconds": float,
            "verdict": int,
        }
        for name, kind in (dict.fromkeys(names, float) | columns).items():
            shape = () if name in ("seconds", "pulse") else (electrodes,)
            self.rows[name] = self.file.create_dataset(
                name, (0, *shape), kind, maxshape=(None, *shape)
            )
        self.changes = self.file.create_dataset("changes", 0, h5py.string_dtype(), maxshape=(None,))

    def add(self, **row: np.ndarray | float) -> None:
        """Append a pulse."""
        for name, value in row.items():
            data = self.rows[name]
            data.resize(len(data) + 1, axis=0)
            data[-1] = value

    def tell(self, change: Change) -> None:
        """Append a change."""
        self.changes.resize(len(self.changes) + 1, axis=0)
        self.changes[-1] = str(change)


def run(arguments: argparse.Namespace) -> None:
    """Follow the stream to its end, or until someone stops on the page."""
    if arguments.log.exists():
        raise ValueError(f"{arguments.log} exists; name another file with --log")
    with etid.read(arguments.calibration) as study:
        calibrations = list(study.calibrations.recordings())
    driver, electrodes = etid.identify_driver(calibrations), arguments.electrodes
    tracker = etid.display.Tracker.of(driver, calibrations[0], electrodes=electrodes, change=3e-3)
    controller = etid.display.Controller.of(tracker)
    blocks = played(arguments.pulses, electrodes, calibrations[0].sample_rate, arguments.speed)
    charge, names = arguments.charge, tracker.model.circuit.names()
    view = tick = None
    with contextlib.ExitStack() as opened:
        if arguments.page:
            view = opened.enter_context(LiveView(controller, charge=charge, controls=False))
            print(view.address)
        log = Log(arguments.log, names, electrodes)
        opened.callback(log.file.close)
        # A recorded file has pulses of constant amplitude. With a stimulator: LiveView(…,
        # controls=True), then `opened.enter_context(Stimulator(send, electrodes, period, view))`,
        # which sends 0 when this block ends, and follow(…, stimulator=stimulator).
        for tick in follow(blocks, controller, charge=charge, view=view):
            elements = np.exp(np.asarray(tick.state.electrodes.own))
            log.add(
                pulse=tick.number,
                **{name: elements[:, at] for at, name in enumerate(names)},
                amplitude=tick.command.amplitude,
                charge=tick.command.charge,
                seconds=tick.seconds,
                verdict=np.asarray(tick.state.electrodes.result._value),
            )
            for change in tick.changes:
                log.tell(change)
                print(change)
            if tick.number % FLUSHED == FLUSHED - 1:
                log.file.flush()
    if tick is not None:
        print(f"{tick.number + 1} pulses, {tick.missing} incomplete, {tick.late} late blocks")


def main(arguments: list[str]) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("calibration", type=pathlib.Path, help="etid study with calibrations")
    parser.add_argument("pulses", type=pathlib.Path, help="HDF5 file to play")
    parser.add_argument("--electrodes", type=int, default=98)
    parser.add_argument("--charge", type=float, default=80e-9, help="wanted per phase [C]")
    parser.add_argument("--speed", type=float, default=1.0, help="of the playback; 1: real time")
    parser.add_argument("--page", action="store_true", help="open the live view")
    parser.add_argument("--log", type=pathlib.Path, default=pathlib.Path("display.h5"))
    run(parser.parse_args(arguments))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit("interrupted; the log is complete up to here")
    except (OSError, ValueError, etid.IdentificationError) as error:
        sys.exit(f"error: {error}")
