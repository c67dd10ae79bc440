"""Identify and control a display from a stream of blocks, with a log and a view in the terminal.

    python examples/stream_display.py calibration.h5 --file pulses.h5
    python examples/stream_display.py calibration.h5 --socket localhost:5555

A lab replaces `played` or `received` by its own source, and `send` by the line to its stimulator.
A block is the number of its first sample since the start, and the voltages (electrode, sample).

* The calibration file is an etid study whose calibrations have several periods.
* `--file` plays the dataset `v_out` (electrode, sample) [V] of an HDF5 file in real time.
* `--socket` reads from a server: a header of three little-endian 64-bit integers (first sample,
  electrodes, samples), then the voltages as float64, electrode by electrode.

Blocks that are missing or late cost the pulses that they belong to: these electrodes keep their
elements, and the number of lost pulses is shown. The log has one row per pulse; it never replaces
a file. Ctrl-C ends the program, and the log is complete up to there.
"""

import argparse
import dataclasses
import pathlib
import socket
import sys
import time
from collections.abc import Iterable, Iterator

import h5py
import numpy as np

import etid

BLOCK = 500  # samples of a block that is played back
COLUMNS = 14  # electrodes in a row of the view
SHOWN = 15  # pulses from one view to the next
MARKS = {"open": "o", "shorted": "!", "dry": "d", "drifting": "~", "fallback": "?", "wanted": "."}
GAP = 60  # lost pulses in a row that are given to the tracker one by one
LARGEST = 10**8  # voltages in a block; a header that says more is out of step
Block = tuple[int, np.ndarray]


def played(
    path: pathlib.Path, electrodes: int, sample_rate: float, speed: float
) -> Iterator[Block]:
    """Blocks of a file, each at the time at which a converter would have delivered it.

    Args:
        path: HDF5 file with the dataset `v_out` (electrode, sample) [V].
        electrodes: Number of electrodes.
        sample_rate: Samples per second [Hz].
        speed: 1 for real time.
    """
    if not speed > 0:
        raise ValueError(f"--speed is {speed}; it must be positive")
    with h5py.File(path, "r") as file:
        v_out = file.get("v_out")
        if not isinstance(v_out, h5py.Dataset):
            raise ValueError(f"{path} has no dataset v_out; store the voltages there")
        if v_out.ndim != 2 or v_out.shape[0] != electrodes or v_out.dtype.kind != "f":
            raise ValueError(
                f"{path}, v_out: is {v_out.dtype} of shape {v_out.shape}; store volts as floats "
                f"(electrode, sample), with as many electrodes as --electrodes, {electrodes}"
            )
        begin = time.monotonic()
        for first in range(0, v_out.shape[1], BLOCK):
            block = v_out[:, first : first + BLOCK]
            due = begin + (first + block.shape[1]) / sample_rate / speed
            time.sleep(max(0.0, due - time.monotonic()))
            yield first, block


def received(address: str) -> Iterator[Block]:
    """Blocks from a server, until it closes the connection."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise ValueError(f"--socket is {address!r}; write host:port")
    with socket.create_connection((host, int(port))) as line, line.makefile("rb") as stream:
        while header := stream.read(24):
            if len(header) < 24:
                return
            first, electrodes, samples = (int(one) for one in np.frombuffer(header, "<i8"))
            if not (0 < electrodes <= LARGEST and 0 < samples <= LARGEST // electrodes):
                raise ValueError(
                    f"a block has {electrodes} electrodes and {samples} samples; is its header "
                    "three little-endian integers of 64 bits?"
                )
            body = stream.read(8 * electrodes * samples)
            if len(body) < 8 * electrodes * samples:
                return
            yield first, np.frombuffer(body, "<f8").reshape(electrodes, samples)


@dataclasses.dataclass
class Pulses:
    """Cuts windows of one pulse from blocks.

    Attributes:
        period: Length of a period [samples].
        samples: Length of a window [samples].
        electrodes: Number of electrodes.
        number: Number of the pulse that is being filled.
        late: Blocks that came after their pulse was over.
        missing: Pulses without all of their samples.
    """

    period: float
    samples: int
    electrodes: int
    number: int = 0
    late: int = 0
    missing: int = 0

    def __post_init__(self) -> None:
        self.window = np.full((self.electrodes, self.samples), np.nan)

    def begin(self, number: int) -> int:
        """First sample of a pulse: the nearest to the start of its period."""
        return round(number * self.period)

    def cut(self, blocks: Iterable[Block]) -> Iterator[tuple[int, np.ndarray]]:
        """The number of each pulse and its window [V]; what is missing is NaN."""
        for first, block in blocks:
            if block.shape[0] != self.electrodes:
                raise ValueError(f"a block has {block.shape[0]} electrodes, not {self.electrodes}")
            if first + block.shape[1] <= self.begin(self.number):
                self.late += 1
                continue
            lost = int(first / self.period) - self.number - 1
            if lost > GAP:  # a long pause
                self.missing += lost
                self.number += lost
                self.window = np.full_like(self.window, np.nan)
            while True:
                begin = self.begin(self.number)
                low, high = max(first, begin), min(first + block.shape[1], begin + self.samples)
                if low < high:
                    self.window[:, low - begin : high - begin] = block[
                        :, low - first : high - first
                    ]
                if first + block.shape[1] < begin + self.samples:
                    break
                self.missing += bool(np.isnan(self.window).any())
                yield self.number, self.window
                self.number += 1
                self.window = np.full_like(self.window, np.nan)


class Log:
    """One row per pulse in an HDF5 file, which is readable after a crash up to the last view.

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

    def tell(self, change: etid.online.state.Change) -> None:
        """Append a change."""
        self.changes.resize(len(self.changes) + 1, axis=0)
        self.changes[-1] = str(change)


def view(number: int, marks: list[str], pulses: Pulses, worst: float) -> str:
    """The display as text: one character for each electrode, and the state of the stream."""
    rows = ["".join(marks[at : at + COLUMNS]) for at in range(0, len(marks), COLUMNS)]
    key = "  ".join(f"{mark} {name}" for name, mark in MARKS.items())
    return "\n".join(
        [
            *rows,
            f"pulse {number}, {pulses.missing} incomplete, {pulses.late} late blocks, "
            f"slowest tick {1e3 * worst:.1f} ms",
            f"{key}  + limited",
        ]
    )


def send(amplitude: np.ndarray) -> None:
    """Give the amplitudes to the stimulator. This example has none."""
    del amplitude


def run(arguments: argparse.Namespace) -> Pulses:
    """Follow the stream to its end."""
    if arguments.log.exists():
        raise ValueError(f"{arguments.log} exists; name another file with --log")
    with etid.read(arguments.calibration) as study:
        calibrations = list(study.calibrations.recordings())
    driver = etid.identify_driver(calibrations)
    unloaded = calibrations[0]
    tracker = etid.Tracker.of(
        driver, unloaded, electrodes=arguments.electrodes, change=arguments.change
    )
    controller = etid.Controller.of(tracker)
    blocks = (
        received(arguments.socket)
        if arguments.socket
        else played(arguments.file, arguments.electrodes, unloaded.sample_rate, arguments.speed)
    )
    pulses = Pulses(tracker.period, tracker.model.bands.samples, arguments.electrodes)
    names = tracker.model.circuit.names()
    state, worst, number = tracker.start(), 0.0, -1
    command = controller.command(tracker.update(state, pulses.window), charge=arguments.charge)

    def show() -> None:
        bad = tracker.bad_electrodes(state)
        reasons = [bad.get(at, str(reason)) for at, reason in enumerate(command.reason)]
        marks = [MARKS.get(reason, "+") for reason in reasons]
        print(view(number + 1, marks, pulses, worst), flush=True)

    show()  # it compiles, as the command before did
    log = Log(arguments.log, names, arguments.electrodes)
    try:
        for number, window in pulses.cut(blocks):
            begin = time.perf_counter()
            # A recorded file has pulses of constant amplitude, a stimulator that of the command.
            state = tracker.update(state, window)
            command = controller.command(state, charge=arguments.charge)
            send(command.amplitude)
            seconds = time.perf_counter() - begin
            worst = max(worst, seconds)
            elements = np.exp(np.asarray(state.electrodes.own))
            log.add(
                pulse=number,
                **{name: elements[:, at] for at, name in enumerate(names)},
                amplitude=command.amplitude,
                charge=command.charge,
                seconds=seconds,
                verdict=np.asarray(state.electrodes.result._value),
            )
            for change in tracker.changes(state):
                log.tell(change)
                print(change)
            if number % SHOWN == SHOWN - 1:
                log.file.flush()
                show()
    finally:
        log.file.close()
    show()
    return pulses


def main(arguments: list[str]) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("calibration", type=pathlib.Path, help="etid study with calibrations")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--file", type=pathlib.Path, help="HDF5 file to play back")
    source.add_argument("--socket", help="host:port of a server")
    parser.add_argument("--electrodes", type=int, default=98)
    parser.add_argument("--charge", type=float, default=80e-9, help="wanted per phase [C]")
    parser.add_argument("--change", type=float, default=3e-3, help="of the skin [1/√pulse]")
    parser.add_argument("--speed", type=float, default=1.0, help="of the playback; 1: real time")
    parser.add_argument("--log", type=pathlib.Path, default=pathlib.Path("display.h5"))
    run(parser.parse_args(arguments))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit("interrupted; the log is complete up to here")
    except (OSError, ValueError, etid.IdentificationError) as error:
        sys.exit(f"error: {error}")
