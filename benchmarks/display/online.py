"""On-line tick: tracking, tests for changes and the next command, against the pulse period.

One pinned core, samples in ordinary arrays, as many pulses as asked for after a warm-up. The pulses
differ in noise, trigger delay and sampling phase. filterpy's extended Kalman filter tracks the same
pulses with the same model in the same run, in an environment of its own (`.rivals`). Then follow
hum and another quartz (`online_instruments`), faults that look like a gain (`online_faults`), false
alarms and the detection of wet skin (`online_alarms`).
"""

import argparse
import gc
import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from benchmarks.display.online_alarms import LOADS, SOON, Fingertip, alarms
from benchmarks.display.online_faults import faults
from benchmarks.display.online_instruments import instruments
from benchmarks.ladder import BEFORE, WHITE
from benchmarks.machine import RESULTS
from benchmarks.rivals import RivalError, exchange
from benchmarks.runner import Target, at_least, at_most, option, report
from etid.display import Controller, Tracker
from etid.display.state import TrackerState

PINNED = True
TICK = 0.08  # of the time between two pulses, which 99 % of the ticks must keep to
TARGETS = {
    "p99 of the tick / pulse period": at_most(TICK),
    "filterpy's extended Kalman filter / tick": at_least(10.0),
    "false alarms per electrode and hour, 95 % limit": at_most(1.0),
    "false alarms of the driver": at_most(0),
    f"wet skin that is found within {SOON} pulses": at_least(1.0),
}
CHARGE = 80e-9  # [C] per phase
RIVAL_TICKS = 30
OFF = 0.05  # of the elements, by which its start differs from what the tracker has found
WARM = 50  # ticks before the first that counts: compilation, and the start of every electrode
KINDS = 60  # different pulses, over and over
OFFSET = 1e-6  # [V] from pulse to pulse: bits that come back would be an old window
NOISES = ((60.0, WHITE), (40.0, WHITE), (60.0, BEFORE))  # [dB] of the alarms; ticks: the first
CHANGE = 1e-3  # random walk that the tracker expects in the ticks [1/√pulse]

OPTIONS = (
    option("--electrodes", default=98),
    option("--ticks", default=2000),
    option("--hours", default=3.2, help="electrode hours of false alarms; 0 for none"),
    option("-o", "--output", default=RESULTS / "online.csv"),
)


def main(arguments: argparse.Namespace) -> bool:
    electrodes, hours = arguments.electrodes, arguments.hours
    found = [*ticks(electrodes, arguments.ticks), *instruments(NOISES[0][0]), *faults()]
    for snr_db, noise in NOISES if hours > 0 else ():
        counts = alarms(electrodes, snr_db, hours, noise).items()
        at = f"{snr_db:g} dB{'' if noise == WHITE else f', {noise}'}: "
        found += [Target.of(TARGETS, *of, at) for of in counts]
    return report(found, arguments.output)


def ticks(electrodes: int, number: int) -> Iterator[Target]:
    """Times of a tick, and of filterpy."""
    tracker, pulses = problem(electrodes)
    state, ratios, busy = timed(tracker, pulses, number)
    print(f"{electrodes} electrodes, {len(ratios)} ticks: {tracker.read(state).counts()}")
    for name, percent in (("median", 50), ("p99", 99), ("worst", 100)):
        # The processor's own time is less where other programs take turns on that core.
        for kind, of in (("wall: ", ratios), ("processor: ", busy)):
            value = float(np.percentile(of, percent))
            yield Target.of(TARGETS, f"{name} of the tick / pulse period", value, kind)
    logs = np.asarray(state.electrodes.own)[:, :-1]
    some, theirs = pulses[np.arange(RIVAL_TICKS) % len(pulses)], np.nan
    try:
        theirs = seconds_of_filterpy(tracker, some, logs)
    except RivalError as error:
        print(f"filterpy: {error}")
    period = tracker.period / tracker.model.bands.sample_rate
    factor = theirs / (period * float(np.median(busy)))
    yield Target.of(TARGETS, "filterpy's extended Kalman filter / tick", factor, "processor: ")


def timed(
    tracker: Tracker, pulses: np.ndarray, ticks: int
) -> tuple[TrackerState, Float[np.ndarray, " tick"], Float[np.ndarray, " tick"]]:
    """The last state, and the wall time and processor time of each tick, in pulse periods."""
    controller = Controller.of(tracker)
    state, seconds = tracker.start(), []
    gc.collect()
    gc.freeze()  # the garbage collector does not search again what exists now
    for number in tqdm(range(WARM + ticks), disable=None):
        v_out = pulses[number % len(pulses)] + OFFSET * number
        begin = time.perf_counter(), time.process_time()
        state = tracker.update(state, v_out)
        controller.command(state, charge=CHARGE)
        seconds.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
    wall, busy = np.array(seconds[WARM:]).T * tracker.model.bands.sample_rate / tracker.period
    return state, wall, busy


def problem(electrodes: int) -> tuple[Tracker, np.ndarray]:
    """A tracker, and pulses for it (pulse, electrode, sample)."""
    display, loads = Fingertip(electrodes, NOISES[0][0], CHANGE), np.arange(electrodes) % len(LOADS)
    return display.tracker, np.stack([*display.pulses(loads, KINDS)])


def seconds_of_filterpy(
    tracker: Tracker,
    pulses: Float[np.ndarray, "pulse lane sample"],
    logs: Float[np.ndarray, "lane element"],
) -> float:
    """Median processor time of filterpy for one pulse at all electrodes, the bands apart [s].

    Its filters start near the logarithms that the tracker has found; a `RivalError` if there is no
    filterpy.
    """
    seen = [tracker.projection.band_sums(v_out, tracker.adc_range) for v_out in pulses]
    variance, begins = np.stack([of.variance for of in seen]), np.arange(len(pulses)) % 3
    found = exchange(
        "filterpy",
        "kalman_by_filterpy",
        gains=np.stack([np.asarray(one.gain()) for one in seen]),
        variances=variance[:, :, None] / np.asarray(tracker.model.bands.weight),
        delays=begins * tracker.period - np.round(begins * tracker.period),
        frequency=np.asarray(tracker.model.bands.frequency),
        turn=np.asarray(tracker.model.turn),
        source=np.asarray(tracker.model.source),
        change=np.asarray(tracker.change),
        start=logs + OFF,
    )
    print(f"filterpy    differs by at most {np.abs(found['logs'] - logs).max():.1%} in an element")
    return float(np.median(found["seconds"]))
