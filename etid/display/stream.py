"""A stream of blocks, and the windows of one pulse that a tracker needs.

A block is the number of its first sample since the start, and the voltages (electrode, sample) [V].
Blocks that are missing or late cost the pulses that they belong to, which are counted. A counter
of samples that goes back by `PAUSE` periods or more has begun anew: so do the windows.
"""

import dataclasses
import math
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator

import h5py
import numpy as np
from jaxtyping import Float

from etid.display.clock import Clock
from etid.display.stimulator import PAUSE
from etid.printing import several
from etid.recordings.errors import RecordingError
from etid.recordings.untrusted import guarded

BLOCK = 500  # samples of a block that is played back
WAIT = 0.2  # [s] for a stimulator to take amplitudes, and between two looks whether someone stopped
LARGEST = 10**8  # voltages in a block; a header that says more is out of step
FARTHEST = 10**15  # samples since the start: thirty years at 1 MHz
Block = tuple[int, np.ndarray]


def played(
    path: str | os.PathLike[str], electrodes: int, sample_rate: float, speed: float
) -> Iterator[Block]:
    """Blocks of a file, each at the time at which a converter would have delivered it.

    Args:
        path: HDF5 file with the dataset `v_out` (electrode, sample) [V].
        electrodes: Number of electrodes.
        sample_rate: Samples per second [Hz].
        speed: 1 for real time.

    Raises:
        ValueError: The speed is not positive.
        RecordingError: The file cannot be read, or does not hold such a dataset.
    """
    if not speed > 0:
        raise ValueError(f"speed is {speed}; it must be positive")
    with guarded(name := os.fspath(path)) as file:
        v_out = file.get("v_out")
        if not isinstance(v_out, h5py.Dataset):
            raise RecordingError(
                "has no dataset v_out", file=name, remedy="Store the voltages there"
            )
        if v_out.ndim != 2 or v_out.shape[0] != electrodes or v_out.dtype.kind != "f":
            raise RecordingError(
                f"is {v_out.dtype} of shape {v_out.shape}",
                file=name,
                field="v_out",
                remedy="Store volts as floats (electrode, sample), "
                f"of {several(electrodes, 'electrode')} as the display has",
            )
    return _paced(name, sample_rate * speed)


def _paced(path: str, rate: float) -> Iterator[Block]:
    """Blocks of a file, as many samples a second as told [Hz]."""
    with h5py.File(path, "r") as file:
        v_out = file["v_out"]
        assert isinstance(v_out, h5py.Dataset)
        begin = time.monotonic()
        for first in range(0, v_out.shape[1], BLOCK):
            block = v_out[:, first : first + BLOCK]
            due = begin + (first + block.shape[1]) / rate
            time.sleep(max(0.0, due - time.monotonic()))
            yield first, block


def connected(address: str) -> socket.socket:
    """A connection to a server of blocks.

    Raises:
        ValueError: The address is not `host:port`, or nothing listens there.
    """
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise ValueError(f"the address is {address!r}; write host:port")
    try:
        line = socket.create_connection((host, int(port)))
    except (OSError, OverflowError) as error:
        raise ValueError(
            f"{address} cannot be reached ({error}); start the stimulator, or correct the address"
        ) from error
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # amplitudes leave at once
    line.settimeout(WAIT)
    return line


def received(
    line: socket.socket,
    stopped: Callable[[], bool] = lambda: False,
    stepped: Callable[[float], None] = lambda step: None,
) -> Iterator[Block]:
    """Blocks from a server, until it closes the connection.

    A block is a header of three little-endian 64-bit integers (first sample, electrodes, samples),
    then the voltages as float64, electrode by electrode. A header of 0 samples is no block: its
    first integer is the number of steps from amplitude 0 to 1.

    Args:
        line: Connection to the server.
        stopped: Whether no more blocks are wanted, which is asked while none comes.
        stepped: Is told the step of the amplitudes, if the server tells it.

    Raises:
        ValueError: A header is out of step.
    """

    def read(size: int) -> bytearray:
        """So many bytes, or fewer at the end."""
        found, at = bytearray(size), 0
        while at < size and not stopped():
            try:
                taken = line.recv_into(memoryview(found)[at:])
            except TimeoutError:
                continue
            if not taken:
                break
            at += taken
        return found[:at]

    while len(header := read(24)) == 24:
        first, electrodes, samples = (int(one) for one in np.frombuffer(header, "<i8"))
        if samples == 0 < min(first, electrodes):
            stepped(1 / first)
            continue
        sized = 0 < electrodes <= LARGEST and 0 < samples <= LARGEST // electrodes
        if not (sized and 0 <= first < FARTHEST):
            raise ValueError(
                f"a block has {several(electrodes, 'electrode')} and {several(samples, 'sample')} "
                f"from sample {first} on; is its header three little-endian integers of 64 bits?"
            )
        body = read(8 * electrodes * samples)
        if len(body) < 8 * electrodes * samples:
            return
        yield first, np.frombuffer(body, "<f8").reshape(electrodes, samples)


def sender(line: socket.socket) -> Callable[[Float[np.ndarray, " lane"]], None]:
    """What sends amplitudes to the server of the blocks: a little-endian float64 by electrode."""
    return lambda amplitude: line.sendall(amplitude.astype("<f8").tobytes())


@dataclasses.dataclass
class Pulses:
    """Cuts windows of one pulse from blocks.

    Attributes:
        clock: When the pulses come.
        electrodes: Number of electrodes.
        late: Blocks that came after their pulse was over.
        missing: Pulses without all of their samples.
    """

    clock: Clock
    electrodes: int
    late: int = 0
    missing: int = 0

    def __post_init__(self) -> None:
        self.window = np.full((self.electrodes, self.clock.samples), np.nan)

    def cut(
        self, blocks: Iterable[Block]
    ) -> Iterator[tuple[int, Float[np.ndarray, "lane sample"]]]:
        """The number of each pulse and its window [V]; what is missing is NaN.

        The numbers increase, but after a counter that has begun anew.

        Raises:
            ValueError: A block has another number of electrodes.
        """
        clock = self.clock
        for first, block in blocks:
            if block.shape[0] != self.electrodes:
                raise ValueError(
                    f"a block has {several(block.shape[0], 'electrode')}, not {self.electrodes}"
                )
            behind = clock.begin - first - block.shape[1]
            if behind >= PAUSE * clock.period:
                clock.restart(int(first / clock.period))
                self.window = np.full_like(self.window, np.nan)
            elif behind >= 0:
                self.late += 1
                continue
            lost = math.floor((first - clock.place) / clock.period) - 1
            if lost > 60:  # a long pause, whose pulses the tracker does not get one by one
                self.missing += lost
                clock.skip(lost)
                self.window = np.full_like(self.window, np.nan)
            while True:
                begin, end = clock.begin, clock.begin + clock.samples
                low, high = max(first, begin), min(first + block.shape[1], end)
                if low < high:
                    self.window[:, low - begin : high - begin] = block[
                        :, low - first : high - first
                    ]
                if first + block.shape[1] < end:
                    break
                self.missing += bool(np.isnan(self.window).any())
                yield clock.number, self.window
                clock.follow(self.window)
                # A window may begin before the end of the last one, which has these samples.
                last, self.window = self.window, np.full_like(self.window, np.nan)
                if (shared := end - clock.begin) > 0:
                    self.window[:, :shared] = last[:, -shared:]
