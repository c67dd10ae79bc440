"""On-line faults that look like a gain: crosstalk, a source that sags, amplitudes that are rounded.

Half of the electrodes touch dry skin, the others damp skin; the display is that of
`control_plant`. The tracker is told the amplitude that was wanted. An answer is silent
if its verdict is good and an element is more than `FAR` standard errors off.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import etid
from benchmarks.display.control_plant import OLDER, STEP, Display
from benchmarks.ladder import TWO
from benchmarks.runner import Target, at_most, show
from etid.display import Controller, Tracker
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Scene

FAR = 4.0  # standard errors
LANES, DRIVERS = 20, 3
CHANGE = 1e-3  # random walk that the tracker expects [1/√pulse]
WANTED = 60e-9, 100e-9  # [C] per phase, from the first electrode to the last
SETTLED = 24  # pulses from rest to the wanted charge
SNR = (60.0, 40.0)  # [dB]
STEPS = f"steps of 1/{round(1 / STEP)}"
SILENT, CHARGE = f"silent answers with {STEPS}", f"largest error of the charge with {STEPS}"
TARGETS = {SILENT: at_most(0), CHARGE: at_most(0.02)}

Change = Callable[[int, np.ndarray], np.ndarray]


class Fault(NamedTuple):
    """What is wrong at a display.

    Attributes:
        pulses: Number of pulses.
        amplitude: What is wanted; None for the amplitudes of a controller.
        given: Amplitudes that are given, from the number of a pulse and what is wanted.
        seen: Voltages that are recorded, from the number of a pulse and the true ones.
        step: `amplitude_step` of the controller.
    """

    pulses: int
    amplitude: float | None
    given: Change = lambda number, amplitude: amplitude
    seen: Change = lambda number, v: v
    step: float = 0.0


def _neighbour(number: int, v: np.ndarray) -> np.ndarray:
    return v + 0.01 * np.roll(v, 1, axis=0)


def _sagging(number: int, amplitude: np.ndarray) -> np.ndarray:
    return (1 - 1e-4 * number) * amplitude


def _rounded(number: int, amplitude: np.ndarray) -> np.ndarray:
    return STEP * np.rint(amplitude / STEP)


FAULTS = {
    "none": Fault(25, 1.0),
    "1 % of the neighbour": Fault(25, 1.0, seen=_neighbour),
    "1 % of the neighbour, amplitude 0.3": Fault(25, 0.3, seen=_neighbour),
    "sags by 0.01 % a pulse": Fault(100, 1.0, _sagging),
    f"{STEPS}, told as wanted": Fault(2 * SETTLED, None, _rounded),
    STEPS: Fault(2 * SETTLED, None, _rounded, step=STEP),
}


class Answers(NamedTuple):
    """What was found: successful (pulse, lane), errors (pulse, lane, element), charges."""

    good: np.ndarray
    off: np.ndarray  # relative
    z: np.ndarray  # in standard errors
    charge: np.ndarray  # over the wanted charge, if a controller gives it

    def row(self, of: slice) -> dict[str, Any]:
        """The columns of some lanes."""
        good, z = self.good[:, of], np.abs(self.z[:, of]).max(axis=2)
        silent, off = good & (z > FAR), np.abs(self.off[:, of])
        worst = np.where(silent[..., None], off, 0.0).max(axis=(0, 1))
        refused = np.where(good.all(axis=0), np.inf, np.argmin(good, axis=0) + 1)
        return {
            "answers": good.size,
            "successful": int(good.sum()),
            "silent": int(silent.sum()),
            "largest z": float(np.where(good, z, 0.0).max()),
            "their r_s %": float(100 * worst[0]),
            "their r_p %": float(100 * worst[1]),
            "half refused at answer": float(np.median(refused)),
        }


def faults() -> Iterator[Target]:
    """Print what each fault does; the targets of amplitudes in steps."""
    skins = [TYPICAL["dry"], TYPICAL["damp"]]
    for snr_db in SNR:
        usual = {"samples": 40_000, "trigger_jitter_rms": 100e-9}
        scene, trackers = Scene((), TWO, snr_db=snr_db, **usual), []
        display = Display(scene, skins, 1)
        for seed in range(DRIVERS):
            records = list(scene.simulate(seed).calibrations.recordings())
            driver = etid.identify_driver(records)
            trackers.append(Tracker.of(driver, records[0], electrodes=LANES, change=CHANGE))
        for name, fault in FAULTS.items():
            each = [answers(display, tracker, fault) for tracker in trackers]
            found = Answers(*(np.concatenate(of, axis=1) for of in zip(*each, strict=True)))
            for at, skin in enumerate(("dry", "damp")):
                show({"fault": name, "dB": snr_db, "skin": skin} | found.row(slice(at, None, 2)))
            if name == STEPS:
                silent = sum(found.row(slice(at, None, 2))["silent"] for at in range(2))
                yield Target.of(TARGETS, SILENT, silent, f"{snr_db:g} dB: ")
                error = float(np.abs(found.charge - 1)[found.good].max(initial=0.0))
                yield Target.of(TARGETS, CHARGE, error, f"{snr_db:g} dB: ")


def answers(display: Display, tracker: Tracker, fault: Fault) -> Answers:
    """What a tracker finds."""
    loads, lanes = np.arange(tracker.electrodes) % 2, tracker.electrodes
    truth = np.array([dataclasses.astuple(TYPICAL[name]) for name in ("dry", "damp")])[loads]
    charge = np.linspace(*WANTED, lanes)
    controller = Controller.of(tracker, amplitude_step=fault.step)
    state, amplitude = tracker.start(at_rest=True), np.zeros((OLDER, lanes))
    rows = []
    for number in range(fault.pulses):
        if fault.amplitude is None:
            wanted = controller.command(state, charge=charge).amplitude
        else:
            wanted = np.full(lanes, fault.amplitude)
        amplitude = np.concatenate([fault.given(number, wanted)[None], amplitude[:-1]])
        v = fault.seen(number, display.windows(number, loads, amplitude))
        state = tracker.update(state, v, wanted)
        fits = tracker.read(state)
        error: Float[np.ndarray, "lane element"] = np.asarray(fits.circuit.values()) - truth
        z = error / np.asarray(fits.stderr.values())
        delivered = display.charges(loads, amplitude) / charge
        rows.append((fits.fit.usable, error / truth, z, delivered))
    begin = SETTLED if fault.amplitude is None else 1  # the offset is known from then on
    return Answers(*(np.array(of)[begin:] for of in zip(*rows, strict=True)))
