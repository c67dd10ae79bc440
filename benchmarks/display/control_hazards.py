"""The cap on the charge under hazards: loads from a short circuit to none, and wrong records.

The loads change at random, between a short circuit, resistors, skin of all kinds, and no contact
(`control_plant`). In most cells the records are wrong as well, each for some pulses.

In the cells of `RINGS` a ring buffer of the whole cell is not filled any more for some time, and
returns its last samples again and again. Half of these times all electrodes become wet a few pulses
after it began.

A pulse is **above the cap** if its charge exceeds the cap. It follows an **unseen change** if the
load changed just before it, and the load before would have had no more than the cap: no record
could show the change. Behind two swapped channels, the electrode's own channel shows the change one
pulse later, so that there are two such pulses. The target is no other pulse above the cap, and none
above the worst case that the command states.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

import etid
from benchmarks.display.control_plant import STEP, Display, Load, closed_loop
from benchmarks.ladder import ELECTRONICS, TWO, WHITE
from etid.display import Controller, Tracker
from etid.simulation.published import TYPICAL
from etid.simulation.scenes import Scene
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

CAP = 120e-9  # [C]
WANTED = 80e-9  # [C]
CHANGE = 6e-3  # random walk that the tracker expects, as in `control`
EVERY = 30  # pulses between two changes of a load, on the average
TROUBLE, LASTS = 60, 10  # pulses between two faults, and of one fault, on the average
PERIOD = 200e3 / 60  # [samples]
SHORT, OPEN, FIRST, PATH = 0, 1, 2, 40  # numbers of loads; steps from dry to very wet skin
FACTORS = np.array([0.5, 0.8, 0.9, 1.1, 1.25, 2.0])  # of a wrong amplitude
# Length of a ring buffer [pulse periods]. Those of 9 and 12 are whole samples, so that windows come
# back as they were; others come back some samples beside their place, the last one by a third.
RINGS = {
    **{f"ring of {length} windows": float(length) for length in (1, 9, 12, 20, 50)},
    "ring of 20 windows and two samples": 20 + 2 / 3333,
    "ring of 20 windows and a third": 20 + 1 / 3,
}
WET = FIRST + PATH - 1  # number of the wettest skin of the path
CELLS = (
    *("constant", "steps", "wetting", "contact", "more than the cap wanted"),
    *("clipped, range known", "clipped, range unknown", "frozen", "swapped", "not a number"),
    *("wrong amplitude", "amplitude of the pulse before"),
    *RINGS,
)


def loads(rng: np.random.Generator) -> list[Load]:
    """A short circuit, no load, a path from dry to wet skin, resistors, skin of all kinds."""
    dry, damp = (np.array(dataclasses.astuple(TYPICAL[of])) for of in ("dry", "damp"))
    wet = np.linspace(-0.5, 2.5, PATH)[:, None]  # 0 is dry, 1 is damp
    path = [SkinLoad(*map(float, of)) for of in dry ** (1 - wet) * damp**wet]
    resistors = [ResistorLoad(float(r)) for r in np.geomspace(1.0, 1e7, 15)]
    low, high = np.log([[1e2, 1e3, 1e-11], [1e5, 1e6, 1e-8]])
    skins = [SkinLoad(*map(float, np.exp(of))) for of in rng.uniform(low, high, (30, 3))]
    return [ResistorLoad(0.0), OpenLoad(), *path, *resistors, *skins]


def _held(values: np.ndarray, new: Bool[np.ndarray, "pulse lane"]) -> np.ndarray:
    """`values` where they are new, else the last new ones."""
    at = np.where(new, np.arange(len(new))[:, None], 0)
    return np.take_along_axis(values, np.maximum.accumulate(at, axis=0), axis=0)


class Cell:
    """What happens to the electrodes of a cell, and what becomes of their records."""

    def __init__(
        self, name: str, rng: np.random.Generator, pulses: int, lanes: int, kinds: int
    ) -> None:
        self.name, self.rng, shape = name, rng, (pulses, lanes)
        new = rng.random(shape) < 1 / EVERY
        # Half of the loads are skin near the paper's, which can be controlled.
        of = np.where(
            rng.random(shape) < 0.5,
            FIRST + rng.integers(PATH, size=shape),
            rng.integers(kinds, size=shape),
        )
        self.load: Int[np.ndarray, "pulse lane"] = _held(of, new)
        start = rng.random(shape) < 1 / TROUBLE
        start[0] |= rng.random(lanes) < 0.3
        fault = np.zeros(shape, bool)
        for begin, lane in zip(*np.nonzero(start), strict=True):
            fault[begin : begin + rng.geometric(1 / LASTS), lane] = True
        if name == "constant":
            self.load[:] = np.arange(lanes) * max(kinds // lanes, 1) % kinds
        if name == "wetting":
            walk = rng.integers(PATH, size=lanes) + np.cumsum(
                rng.choice([-1, 0, 0, 0, 1], size=shape), axis=0
            )
            self.load = FIRST + np.clip(np.abs(walk % (2 * PATH) - PATH), 0, PATH - 1)
        if name == "contact":
            self.load = np.where(fault, OPEN, self.load)
        if name in RINGS:
            fault = self._rings(max(pulses // 10, 1))
        self.fault: Bool[np.ndarray, "pulse lane"] = fault
        self.older: list[np.ndarray] = []
        self.ended = 0  # first sample that a ring buffer did not get

    def _rings(self, longest: int) -> Bool[np.ndarray, "pulse lane"]:
        """Pulses at which the ring buffer is not filled; some of these times the skin gets wet."""
        length, fault = math.ceil(RINGS[self.name]), np.zeros(self.load.shape, bool)
        end = 0
        while (begin := end + length + 1 + self.rng.geometric(1 / EVERY)) < len(fault):
            end = begin + min(2 * length + self.rng.geometric(1 / LASTS), longest)
            fault[begin:end] = True
            if self.rng.random() < 0.5:
                self.load[begin + self.rng.integers(4) : end + EVERY] = WET
        return fault

    def told(
        self,
        number: int,
        v: Float[np.ndarray, "lane sample"],
        amplitude: Float[np.ndarray, "older lane"],
        adc_range: Float[np.ndarray, " 2"],
    ) -> tuple[Float[np.ndarray, "lane sample"], Float[np.ndarray, " lane"]]:
        """Windows [V] and amplitudes that the tracker gets; of those given the newest is first."""
        v, told, bad = v.copy(), amplitude[0].copy(), np.flatnonzero(self.fault[number])
        if self.name == "clipped, range known":
            v[bad] = np.clip(v[bad] + adc_range[1] - 1.0, *adc_range)
        if self.name == "clipped, range unknown":
            limit = np.abs(v[bad]).max(axis=1) * (0.02 + 0.16 * (bad % 7))
            v[bad] = np.clip(v[bad], -limit[:, None], limit[:, None])
        if self.name == "frozen" and len(self.older) == 2:
            for lane in bad:  # one buffer, or two in turn
                v[lane] = self.older[lane % 2][lane]
        if self.name == "swapped":
            first = bad[(bad % 2 == 0) & (bad + 1 < len(v))]
            v[[*first, *(first + 1)]] = v[[*(first + 1), *first]]
        if self.name == "not a number":
            at = self.rng.integers(v.shape[1], size=bad.size)
            v[bad, at] = self.rng.choice([np.nan, np.inf, -np.inf], bad.size)
        if self.name == "wrong amplitude":
            told[bad] *= FACTORS[bad % FACTORS.size]
        if self.name == "amplitude of the pulse before":
            told[bad] = amplitude[1, bad]
        if self.name in RINGS:
            return self._old(number, v), told
        self.older = [v, *self.older[:1]]
        return v, told

    def _old(
        self, number: int, v: Float[np.ndarray, "lane sample"]
    ) -> Float[np.ndarray, "lane sample"]:
        """What a ring buffer returns at this pulse: its own samples while it is not filled."""
        length, begin = round(RINGS[self.name] * PERIOD), round(number * PERIOD)
        if not self.fault[number, 0]:
            # Between two windows there may be one more sample, which no window has.
            more = round((number + 1) * PERIOD) - begin - v.shape[1]
            new = np.concatenate([v, v[:, v.shape[1] - more :]], axis=1)
            self.older = [*self.older, new][-math.ceil(RINGS[self.name]) - 1 :]
            return v
        if not self.fault[number - 1, 0]:
            self.older = [np.concatenate(self.older, axis=1)[:, -length:]]
            self.ended = begin
        [ring] = self.older
        return ring[:, (begin - self.ended + np.arange(v.shape[1])) % length]


@dataclasses.dataclass(frozen=True)
class Given:
    """What the electrodes of a cell were given (pulse, lane)."""

    charge: Float[np.ndarray, "pulse lane"]  # charge [C]
    # charge of the same pulse with the load of the pulse before [C]
    before: Float[np.ndarray, "pulse lane"]
    earlier: Float[np.ndarray, "pulse lane"]  # the same with the load one more pulse before [C]
    worst: Float[np.ndarray, "pulse lane"]  # largest charge that the command stated [C]
    reason: np.ndarray  # what determined the amplitude

    def row(self, snr: float, cell: str, noise: str = WHITE) -> dict[str, Any]:
        """What the cell shows, as a row of the table."""
        above, reasons = (
            self.charge > CAP,
            ("wanted", "charge", "confirmed", "fallback", "repeated"),
        )
        # No record could show the change.
        seen = np.minimum(self.before, self.earlier) if cell == "swapped" else self.before
        unseen = above & (seen <= CAP)
        return {
            "snr_db": snr,
            "noise": noise,
            "cell": cell,
            "pulses": self.charge.size,
            "above_after_unseen_change": int(unseen.sum()),
            "largest_of_them_nC": round(1e9 * float(self.charge[unseen].max(initial=0.0)), 1),
            "above_otherwise": int(np.sum(above & ~unseen)),
            "above_stated_worst": int(np.sum(self.charge > self.worst)),
            **{of: round(float(np.mean(self.reason == of)), 3) for of in reasons},
        }


class Hazards:
    """A calibrated driver, and the loads that its display meets."""

    def __init__(
        self, snr: float, seed: int, samples: int = 40_000, electronics: str = WHITE
    ) -> None:
        usual = {"samples": samples, "trigger_jitter_rms": 100e-9}
        scene = Scene((), TWO, snr_db=snr, **usual, **ELECTRONICS[electronics])
        self.records = list(scene.simulate(seed=seed).calibrations.recordings())
        self.driver = etid.identify_driver(self.records)
        self.rng = np.random.default_rng(seed)
        self.display = Display(scene, loads(self.rng), seed + 1)

    def controller(self, electrodes: int) -> Controller:
        tracker = Tracker.of(self.driver, self.records[0], electrodes=electrodes, change=CHANGE)
        return Controller.of(tracker, charge_cap=CAP, amplitude_step=STEP)

    def given(self, controller: Controller, cells: Sequence[str], pulses: int) -> dict[str, Given]:
        """What the electrodes of some cells are given, side by side."""
        tracker, display, kinds = controller.tracker, self.display, len(self.display.charge)
        lanes = tracker.electrodes // len(cells)
        of = [Cell(name, self.rng, pulses, lanes, kinds) for name in cells]
        parts = [slice(i * lanes, (i + 1) * lanes) for i in range(len(cells))]
        load, wanted = np.hstack([cell.load for cell in of]), np.full(tracker.electrodes, WANTED)
        for cell, part in zip(of, parts, strict=True):
            wanted[part] *= 5 if cell.name == "more than the cap wanted" else 1

        def told(number: int, v: np.ndarray, amplitude: np.ndarray) -> tuple:
            rows = [
                cell.told(number, v[part], amplitude[:, part], tracker.adc_range)
                for cell, part in zip(of, parts, strict=True)
            ]
            windows, amplitudes = zip(*rows, strict=True)
            return np.concatenate(windows), np.concatenate(amplitudes)

        rows = []
        for number, pulse in enumerate(closed_loop(display, controller, load, wanted, told)):
            earlier = (load[max(number - ago, 0)] for ago in range(3))
            charges = [display.charges(of, pulse.amplitude) for of in earlier]
            rows.append((*charges, pulse.command.worst, pulse.command.reason))
        whole = [np.array(column) for column in zip(*rows, strict=True)]
        return {
            cell.name: Given(*(column[:, part] for column in whole))
            for cell, part in zip(of, parts, strict=True)
        }
