"""The cap on the charge under hazards: loads from a short circuit to none, and bad records.

The plant is `benchmarks.control_display`. In every cell the load changes at random, between a short
circuit, resistors, skin of all kinds, and no contact. In most cells the records are wrong as well,
for some pulses or from the start. 

A pulse is **above the cap** if its charge exceeds the cap. It is **excused** if the load changed
just before it, and the load before would have had no more than the cap: nobody could see the
change. It is excused up to the worst case, which the command states for each pulse.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

import etid
from benchmarks.control_display import OLDER, Display, Load
from etid.simulation.published import REFERENCE, TYPICAL
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import OpenLoad, ResistorLoad, SkinLoad

CAP = 120e-9  # [C]
WANTED = 80e-9  # [C]
CHANGE = 6e-3  # as in `benchmarks.control`
EVERY = 30  # pulses between two changes of a load, on the average
TROUBLE, LASTS = 60, 10  # pulses between two faults and of one fault, on the average
PATH = 40  # steps from dry to very wet skin
ALIKE = 1 + 1e-9  # rounding of a charge at the cap


def loads(rng: np.random.Generator) -> list[Load]:
    """A short circuit, no load, a path from dry to wet skin, resistors, skin of all kinds."""
    dry, damp = (np.array(dataclasses.astuple(TYPICAL[of])) for of in ("dry", "damp"))
    steps = np.linspace(-0.5, 2.5, PATH)[:, None]  # 0 is dry, 1 is damp
    path = [SkinLoad(*of) for of in dry ** (1 - steps) * damp**steps]
    resistors = [ResistorLoad(r) for r in np.geomspace(1.0, 1e7, 29)]
    low, high = np.log([[1e2, 1e3, 1e-11], [1e5, 1e6, 1e-8]])
    skins = [SkinLoad(*np.exp(of)) for of in rng.uniform(low, high, (60, 3))]
    return [ResistorLoad(0.0), OpenLoad(), *path, *resistors, *skins]


SHORT, OPEN, FIRST = 0, 1, 2


@dataclasses.dataclass
class Course:
    """What happens to the electrodes of one cell.

    Attributes:
        load: Number of the load.
        fault: Whether the records are wrong.
    """

    load: Int[np.ndarray, "pulse lane"]
    fault: Bool[np.ndarray, "pulse lane"]


def _held(
    values: np.ndarray, new: Bool[np.ndarray, "pulse lane"]
) -> np.ndarray:
    """`values` where they are new, else the last new ones."""
    at = np.where(new, np.arange(len(new))[:, None], 0)
    return np.take_along_axis(values, np.maximum.accumulate(at, axis=0), axis=0)


def course(rng: np.random.Generator, cell: str, pulses: int, lanes: int, kinds: int) -> Course:
    """Loads and faults of a cell."""
    shape = pulses, lanes
    new = rng.random(shape) < 1 / EVERY
    new[0] = True
    load = _held(rng.integers(kinds, size=shape), new)
    # Half of the changes go to skin near the paper's, which is what can be controlled.
    usual = rng.random(shape) < 0.5
    load = np.where(_held(usual, new), _held(FIRST + rng.integers(PATH, size=shape), new), load)
    start = rng.random(shape) < 1 / TROUBLE
    start[0] |= rng.random(lanes) < 0.3
    fault = np.zeros(shape, bool)
    for begin, lane in zip(*np.nonzero(start), strict=True):
        fault[begin : begin + rng.geometric(1 / LASTS), lane] = True
    if cell == "constant":
        load[:] = np.arange(lanes) * max(kinds // lanes, 1) % kinds
        fault[:] = False
    if cell == "steps":
        fault[:] = False
    if cell == "wetting":
        walk = np.cumsum(rng.choice([-1, 0, 0, 0, 1], size=shape), axis=0)
        begin = rng.integers(PATH, size=lanes)
        load = FIRST + np.abs((walk + begin) % (2 * PATH) - PATH).clip(0, PATH - 1)
        fault[:] = False
    if cell == "contact":
        load = np.where(fault, OPEN, load)
        fault[:] = False
    return Course(load, fault)


@dataclasses.dataclass
class Records:
    """What becomes of the windows of one cell on their way to the tracker.

    Attributes:
        cell: Name of the cell.
        rng: Random numbers.
        adc_range: Range of the converter [V].
        older: The windows that were seen at the last two pulses.
    """

    cell: str
    rng: np.random.Generator
    adc_range: Float[np.ndarray, " 2"]
    older: list[np.ndarray]

    def seen(
        self,
        v: Float[np.ndarray, "lane sample"],
        amplitude: Float[np.ndarray, "older lane"],
        fault: Bool[np.ndarray, " lane"],
        number: int,
    ) -> tuple[Float[np.ndarray, "lane sample"], Float[np.ndarray, " lane"]]:
        """Windows and amplitudes as the tracker is told them."""
        told, lanes, bad = amplitude[0].copy(), np.arange(len(v)), np.flatnonzero(fault)
        if self.cell == "clipped, range known":
            v[bad] = np.clip(v[bad] + self.adc_range[1] - 1.0, *self.adc_range)
        if self.cell == "clipped, range unknown":
            top = np.abs(v[bad]).max(axis=1, keepdims=True)
            part = (0.02 + 0.96 * (bad[:, None] % 7) / 6) * top
            v[bad] = np.clip(v[bad], -part, part)
        if self.cell == "frozen":
            for lane in bad[: len(self.older) and None]:
                # One buffer, or two in turn.
                v[lane] = self.older[lane % 2 if len(self.older) > 1 else 0][lane]
        if self.cell == "swapped":
            first = lanes[: len(v) // 2 * 2 : 2]
            pairs = first[fault[first]]
            v[[*pairs, *(pairs + 1)]] = v[[*(pairs + 1), *pairs]]
        if self.cell == "not a number":
            at = self.rng.integers(v.shape[1], size=bad.size)
            v[bad, at] = self.rng.choice([np.nan, np.inf, -np.inf], bad.size)
        if self.cell == "amplitude":
            factor = np.array([0.5, 0.8, 0.9, 1.1, 1.25, 2.0])[bad % 6]
            told[bad] = factor * told[bad]
        if self.cell == "amplitude of before":
            told[bad] = amplitude[1, bad]
        self.older = [v.copy(), *self.older[:1]]
        return v, told


CELLS = (
    "constant",
    "steps",
    "wetting",
    "contact",
    "cap wanted",
    "clipped, range known",
    "clipped, range unknown",
    "frozen",
    "swapped",
    "not a number",
    "amplitude",
    "amplitude of before",
)


@dataclasses.dataclass(frozen=True)
class Pulses:
    """What a cell's electrodes were given (pulse, lane).

    Attributes:
        charge: Charge [C].
        before: Charge of the same pulse if the load had not changed [C].
        changed: Whether the load changed just before the pulse.
        worst: The largest charge that was stated for the pulse [C].
        reason: What determined the amplitude.
    """

    charge: Float[np.ndarray, "pulse lane"]
    before: Float[np.ndarray, "pulse lane"]
    changed: Bool[np.ndarray, "pulse lane"]
    worst: Float[np.ndarray, "pulse lane"]
    reason: np.ndarray


class Hazards:
    """A calibrated driver, and the loads that its display meets.

    Args:
        snr: Signal-to-noise ratio [dB].
        seed: Seed of everything.
    """

    def __init__(self, snr: float, seed: int) -> None:
        resistors = enumerate((REFERENCE, 21.62e3))
        calibration = tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in resistors)
        scene = Scene((), calibration, samples=40_000, snr_db=snr, trigger_jitter_rms=100e-9)
        self.records = list(scene.simulate(seed=seed).calibrations.recordings())
        self.driver = etid.identify_driver(self.records)
        self.rng = np.random.default_rng(seed)
        self.loads = loads(self.rng)
        self.display = Display(scene, self.loads, seed + 1)

    def run(
        self, controller: etid.Controller, pulses: int, wanted: Float[np.ndarray, " cell"], cells
    ) -> dict[str, Pulses]:
        """All cells, side by side."""
        tracker, display = controller.tracker, self.display
        each = tracker.electrodes // len(cells)
        parts = {cell: slice(i * each, (i + 1) * each) for i, cell in enumerate(cells)}
        courses = {cell: course(self.rng, cell, pulses, each, len(self.loads)) for cell in cells}
        load = np.zeros((pulses, tracker.electrodes), int)
        for cell, part in parts.items():
            load[:, part] = courses[cell].load
        records = {cell: Records(cell, self.rng, tracker.adc_range, []) for cell in cells}
        charge = np.full(tracker.electrodes, WANTED)
        if "cap wanted" in parts: charge[parts["cap wanted"]] = 3 * CAP
        given = np.zeros((OLDER, tracker.electrodes))
        state, rows = tracker.start(at_rest=True), []
        for number in tqdm(range(pulses), leave=False):
            command = controller.command(state, charge=charge)
            given = np.concatenate([command.amplitude[None], given[:-1]])
            now = display.given(number, load[number], given)
            older = load[max(number - 1, 0)]
            before = np.sum(display.charge[older].T * given, axis=0)
            told = command.amplitude.copy()
            for cell, part in parts.items():
                fault = courses[cell].fault[number]
                now.v_out[part], told[part] = records[cell].seen(
                    now.v_out[part], given[:, part], fault, number
                )
            state = tracker.update(state, now.v_out.astype(float), told)
            worst = getattr(command, "worst", np.zeros_like(told))
            rows.append((now.charge, before, older != load[number], worst, command.reason))
        self.state = state
        whole = [np.array(column) for column in zip(*rows, strict=True)]
        return {cell: Pulses(*(of[:, part] for of in whole)) for cell, part in parts.items()}
