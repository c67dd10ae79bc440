"""The live view: what the loop of a display spends on its page, and whether memory grows.

Pulses of 98 electrodes come at 60 Hz for ten minutes, and windows read the page ten times a second.
A tick is late because of the page if it fits into a pulse period, but not together with what is
handed over. Wall time contains what other programs of the machine take, the processor's time of
this process does not.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.display.online import CHARGE, OFFSET, problem
from benchmarks.machine import RESULTS
from benchmarks.runner import Target, at_most, option, report
from etid.display import Controller, Tracker
from etid.display.loop import Tick, follow
from etid.display.stream import Block
from etid.display.view import LiveView

TARGETS = {
    "ticks that are late because of the page, by the processor's time": at_most(0),
    "p99 of the hand-over / pulse period, by the processor's time": at_most(0.2),
    "growth of the loop's memory [MB]": at_most(5),
    "growth of the page's memory [MB]": at_most(5),
}
SETTLED = 0.2  # of the time, after which memory should not grow
READER = """
import sys, time, urllib.request
while True:
    urllib.request.urlopen(sys.argv[1] + "/state").read()
    time.sleep(0.1)
"""

OPTIONS = (
    option("--electrodes", default=98),
    option("--minutes", default=10.0),
    option("--windows", default=2, help="readers of the page"),
    option("-o", "--output", default=RESULTS / "live.csv"),
)


class Timed(LiveView):
    """A view that notes what each tick took.

    Attributes:
        taken: For each tick whether a snapshot was due, the time by the clock and of the processor
            for it, and the time of the processor for the tick [s]. The array is whole from the
            start: it must not look like memory that grows.
    """

    taken: np.ndarray
    last = 0.0

    def show(self, tick: Tick) -> None:
        due, wall, busy = self._due, time.perf_counter(), time.process_time()
        super().show(tick)
        now = time.process_time()
        taken = self._due != due, time.perf_counter() - wall, now - busy, busy - self.last
        self.taken[tick.number] = taken
        self.last = now


def main(arguments: argparse.Namespace) -> bool:
    tracker, pulses = problem(arguments.electrodes)
    controller = Controller.of(tracker)
    period = tracker.period / tracker.model.bands.sample_rate
    number = round(60 * arguments.minutes / period)
    seconds, memory = np.full(number, np.nan), []
    view = Timed(controller, charge=CHARGE, controls=False)
    view.taken = np.full((number, 4), np.nan)
    with view:
        print(view.address, flush=True)
        reader = [sys.executable, "-c", READER, view.address]
        readers = [subprocess.Popen(reader) for _ in range(arguments.windows)]
        try:
            for tick in follow(
                paced(tracker, pulses, number), controller, charge=CHARGE, view=view
            ):
                seconds[tick.number] = tick.seconds
                if tick.number in (int(SETTLED * number), number - 1):
                    memory.append((resident(os.getpid()), resident(view._process.pid)))
        finally:
            for reader in readers:
                reader.kill()
                reader.wait()
    shown, wall, busy, working = view.taken.T
    shown = shown > 0
    grown = np.diff(np.array(memory) / 1e6, axis=0)[0]

    def late(tick: np.ndarray, handed: np.ndarray) -> int:
        # The first one compiles.
        return int(((tick < period) & (tick + handed >= period))[1:].sum())

    numbers = {
        "ticks": int(np.isfinite(seconds).sum()),
        "snapshots": int(shown.sum()),
        "median of the tick / pulse period": np.median(seconds) / period,
        "median of the tick / pulse period, by the processor's time": np.median(working) / period,
        "median of a hand-over [ms]": 1e3 * np.median(wall[shown]),
        "median of a hand-over [ms], by the processor's time": 1e3 * np.median(busy[shown]),
        "p99 of the hand-over / pulse period": np.percentile(wall, 99) / period,
        "p99 of the hand-over / pulse period, by the processor's time": np.percentile(busy, 99)
        / period,
        "ticks that are late by themselves": int((seconds >= period).sum()),
        "ticks that are late because of the page": late(seconds, wall),
        "ticks that are late because of the page, by the processor's time": late(working, busy),
        "growth of the loop's memory [MB]": grown[0],
        "growth of the page's memory [MB]": grown[1],
    }
    found = [Target.of(TARGETS, name, float(value)) for name, value in numbers.items()]
    return report(found, arguments.output)


def paced(tracker: Tracker, pulses: np.ndarray, number: int) -> Iterator[Block]:
    """Blocks of one pulse each, when a converter would have them."""
    begin = time.monotonic()
    for at in range(number):
        first = round(at * tracker.period)
        due = begin + (first + pulses.shape[-1]) / tracker.model.bands.sample_rate
        time.sleep(max(0.0, due - time.monotonic()))
        yield first, pulses[at % len(pulses)] + OFFSET * at


def resident(process: int | None) -> int:
    """Memory of a process [bytes]."""
    pages = pathlib.Path(f"/proc/{process}/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
