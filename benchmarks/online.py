"""On-line tick: tracking, tests for changes and the next command, against the pulse period.

One pinned core, samples in ordinary arrays, as many pulses as asked for after a warm-up. The pulses
differ in noise, trigger delay and sampling phase. A missed target makes the command end with 1.
If filterpy is installed (`pip install etid[bench]`), its extended Kalman filter has the same model
and pulses in the same run.
"""

import argparse
import gc
import importlib.util
import time

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

import etid
from benchmarks.online_rival import Rival
from benchmarks.timing import pin
from etid.online.state import TrackerState
from etid.simulation.published import REFERENCE, TYPICAL
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

LOADS = tuple(TYPICAL.values())
TARGET = 0.10  # of the time between two pulses, which 99 % of the ticks must keep to
CHARGE = 80e-9  # [C] per phase
FASTER = 10  # than the extended Kalman filter of filterpy
RIVAL_TICKS = 30
WARM = 50  # ticks before the first that counts: compilation, and the start of every electrode
KINDS = 60  # different pulses, over and over


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is timed."""
    parser.add_argument("--electrodes", type=int, default=98)
    parser.add_argument("--ticks", type=int, default=2000)
    parser.add_argument("--lifted", type=int, default=0, help="electrodes that touch nothing")


def main(arguments: argparse.Namespace) -> bool:
    """Print the times; whether the target is met."""
    pin()
    tracker, pulses = problem(arguments.electrodes, arguments.lifted)
    period = tracker.period / tracker.model.bands.sample_rate
    state, ratios, busy = timed(tracker, pulses, arguments.ticks)
    print(f"{arguments.electrodes} electrodes, {len(ratios)} ticks: {tracker.read(state).counts()}")
    # The processor's own time is less where other programs take turns on that core.
    print(f"{'':<8}{'ms':>8}{'of the period':>16}{'processor':>12}   target")
    for name, percent in (("median", 50), ("p99", 99), ("worst", 100)):
        ratio, own = np.percentile(ratios, percent), np.percentile(busy, percent)
        target = f"   <= {TARGET:.0%}" if name == "p99" else ""
        print(f"{name:<8}{1e3 * period * ratio:8.2f}{ratio:16.1%}{own:12.1%}{target}")
    met = bool(np.percentile(ratios, 99) <= TARGET)
    if importlib.util.find_spec("filterpy") is None:
        print("filterpy is not installed: no comparison")
        return met
    update = [
        tracker.period / tracker.model.bands.sample_rate * np.median(busy),
        _rival(tracker, pulses, np.asarray(state.electrodes.own)[:, :-1]),
    ]
    factor = update[1] / update[0]
    print(f"filterpy    {1e3 * update[1]:.1f} ms, {factor:.0f} times a tick   target >= {FASTER}")
    return met and factor >= FASTER


def timed(
    tracker: etid.Tracker, pulses: np.ndarray, ticks: int
) -> tuple[TrackerState, Float[np.ndarray, " tick"], Float[np.ndarray, " tick"]]:
    """The last state, and the wall time and processor time of each tick, in pulse periods."""
    controller = etid.Controller.of(tracker)
    state, seconds = tracker.start(), []
    gc.collect()
    gc.freeze()  # the garbage collector does not search again what exists now
    for number in tqdm(range(WARM + ticks)):
        v_out = pulses[number % len(pulses)]
        begin = time.perf_counter(), time.process_time()
        state = tracker.update(state, v_out)
        controller.command(state, charge=CHARGE)
        seconds.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
    wall, busy = np.array(seconds[WARM:]).T * tracker.model.bands.sample_rate / tracker.period
    return state, wall, busy


def _rival(tracker: etid.Tracker, pulses: np.ndarray, logs: np.ndarray) -> float:
    """Median processor time of filterpy for one pulse, the bands apart [s].

    Args:
        tracker: The tracker.
        pulses: Its pulses.
        logs: Logarithms of the elements that the tracker has found.
    """
    rival = Rival(tracker, logs + 0.05)
    seconds = []
    for number in range(RIVAL_TICKS):
        begin = number % 3 * tracker.period
        seconds.append(rival.update(pulses[number % len(pulses)], begin - round(begin)))
    apart = np.abs(np.stack([one.x[:3] for one in rival.filters]) - logs).max(axis=0)
    print(f"filterpy    differs by at most {apart.max():.1%} in an element")
    return float(np.median(seconds))


def problem(electrodes: int, lifted: int) -> tuple[etid.Tracker, np.ndarray]:
    """A tracker, and pulses for it (pulse, electrode, sample)."""
    trials = tuple(Trial(f"loaded/{i}", LOADS[i % len(LOADS)]) for i in range(electrodes))
    resistors = (REFERENCE, 21.62e3)
    calibration = tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate(resistors))
    whole = Scene(trials, calibration, trigger_jitter_rms=50e-9)
    study = whole.simulate(seed=0)
    calibrations = list(study.calibrations.recordings())
    driver = etid.identify_driver(calibrations)
    tracker = etid.Tracker.of(driver, calibrations[0], electrodes=electrodes, change=1e-3)
    records = list(study.loaded.recordings())
    v_out = np.stack([r.v_th if i < lifted else r.v_out for i, r in enumerate(records)])
    three = tracker.pulses(v_out)
    noise = np.random.default_rng(1).standard_normal((KINDS // 3, *three.shape))
    # As much noise again as the records have. Common noise would look like the driver.
    many = three[None] + 0.01 * noise
    return tracker, many.reshape(-1, *three.shape[1:])
