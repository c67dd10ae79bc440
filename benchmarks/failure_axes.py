"""Where methods may fail: ten pairs of axes, and the scene of every cell.

Every cell differs from the middle of the ladder in its row and its column. It has one calibration,
and trials with dry and damp skin by turns, which share the driver identified from it.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Complex, Float

from benchmarks.ladder import ELECTRONICS, LOADS, WHITE, recorded
from etid.circuits.circuit import AbstractCircuit, Resistor
from etid.recordings.recording import Recording, Samples
from etid.simulation.scenes import Scene
from etid.simulation.transformer import SkinLoad, TransformerDriver

SNR_DB = (20, 30, 40, 60, 80)
RATIOS = (0.1, 0.3, 1, 3, 10, 30)  # of R_s + R_p to |Z_th| at `RATIO_AT`
RATIO_AT = 1e3  # [Hz]
SAMPLE_RATES = {"100 kHz": 100e3, "200 kHz": 200e3, "500 kHz": 500e3, "1 MHz": 1e6}
PERIODS = (1, 2, 3, 10, 30)
ORDERS = (2, 3, 4, 5, 6, 7)
DELAYS = {"none": 0.0, "50 ns": 50e-9, "200 ns": 200e-9, "500 ns": 500e-9, "2 µs": 2e-6}
CLIPPED = (0.1, 0.5, 1, 2, 5)  # % of the samples of v_th
STRENGTHS = (0.3, 1, 3, 10)  # rms of coloured noise relative to that of the white
# The transformer loses one pole after the other: cable and divider, primary capacitance, both
# leakage inductances. Two are left, the magnetising inductance and the secondary capacitance.
LOST = {
    6: {},
    5: {"c_cable": 0.0, "c_divider": 0.0},
    4: {"c_primary": 0.0, "c_winding": 0.0},
    3: {"l_secondary": 0.0},
    2: {"l_primary": 0.0},
}

Change = Callable[[Recording, np.random.Generator], Recording]
"""What is done to a simulated recording, such as clipping it."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell of one map."""

    chart: str  # which map
    row: str  # label of its row
    column: str  # label of its column
    scene: Scene  # what is simulated
    order: int = 5  # poles that are given to the driver
    change: Change | None = None  # what is done to the records afterwards, if anything
    circuit: AbstractCircuit | None = None  # what is fitted; `SkinRC` if not given

    @property
    def place(self) -> dict[str, str]:
        """Its labels, as tables have them."""
        return {"map": self.chart, "row": self.row, "column": self.column}

    @property
    def shape(self) -> tuple[float, ...]:
        """What determines the programs that are compiled for it."""
        return self.scene.samples, self.scene.sample_rate, self.order


@dataclasses.dataclass(frozen=True)
class TwoLayers:
    """Skin of two relaxations, R_s + R_1 ‖ C_1 + R_2 ‖ C_2, the second ten times as slow."""

    skin: SkinLoad  # R_s, R_p = R_1 + R_2, and R_p C_p, the time constant of the first
    share: float  # R_2 / R_p

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        s, of = 2j * np.pi * f, self.skin
        fast = (1 - self.share) * of.r_p / (1 + s * of.r_p * of.c_p)
        return of.r_s + fast + self.share * of.r_p / (1 + s * self.slow)

    @property
    def slow(self) -> float:
        """Time constant of the second relaxation [s]."""
        return 10 * self.skin.r_p * self.skin.c_p

    @property
    def elements(self) -> SkinLoad:
        """Its limits: R_s = Z(∞), R_p = Z(0) − R_s, and 1/C_p = lim |ω (Z − R_s)| at high ω."""
        of = self.skin
        elastance = (1 - self.share) / of.c_p + self.share * of.r_p / self.slow
        return dataclasses.replace(of, c_p=1 / elastance)


@dataclasses.dataclass(frozen=True)
class Cole:
    """Skin with a constant-phase element, R_s + R_p / (1 + (jωR_p C_p)^α)   (Cole 1940)."""

    skin: SkinLoad  # R_s, R_p and C_p
    alpha: float  # 1 is a capacitor

    def __call__(self, f: Float[np.ndarray, " f"]) -> Complex[np.ndarray, " f"]:
        """Impedance [ohm] at frequencies f [Hz]."""
        of = self.skin
        return of.r_s + of.r_p / (1 + (2j * np.pi * f * of.r_p * of.c_p) ** self.alpha)

    @property
    def elements(self) -> SkinLoad:
        """Its limits R_s and R_p; it has no C_p."""
        return dataclasses.replace(self.skin, c_p=np.nan)


NOT_ONE_RC = {
    "layers, 5 %": functools.partial(TwoLayers, share=0.05),
    "layers, 30 %": functools.partial(TwoLayers, share=0.3),
    "Cole, 0.98": functools.partial(Cole, alpha=0.98),
    "Cole, 0.9": functools.partial(Cole, alpha=0.9),
    "Cole, 0.8": functools.partial(Cole, alpha=0.8),
}


def _changed(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The recording with both voltages [V] changed, as its converter stores them."""
    found = {}
    for name, samples in recording.samples.items():
        codes = np.rint(change(samples.values) / samples.conversion)
        found[name] = Samples(codes.astype(samples.stored.dtype), samples.conversion)
    return recording.replace(**found)


@dataclasses.dataclass(frozen=True)
class Clipped:
    """Both records limited to the voltage that a part of the samples of v_th exceeds."""

    part: float  # of the samples of v_th
    known: bool = False  # whether the recording says where its converter saturates
    # noise after the limit [V], as where an amplifier before the converter saturates
    sigma: float = 0.0

    def __call__(self, recording: Recording, rng: np.random.Generator) -> Recording:
        limit = float(np.quantile(np.abs(recording.v_th), 1 - self.part))

        def clip(v: np.ndarray) -> np.ndarray:
            fresh = self.sigma * rng.standard_normal(v.size)
            return np.where(np.abs(v) > limit, np.sign(v) * limit + fresh, v)

        changed = _changed(recording, clip)
        return changed.replace(adc_range=(-limit, limit) if self.known else None)


CLIPPERS = {
    "converter, range known": functools.partial(Clipped, known=True),
    "converter, range unknown": Clipped,
    "amplifier": functools.partial(Clipped, sigma=1.0),  # in standard deviations of the noise
}


@dataclasses.dataclass(frozen=True)
class Coloured:
    """Noise of a band added to both records, to each its own."""

    band: tuple[float, float]  # lowest and highest frequency [Hz]; equal for a tone of random phase
    rms: float  # its effective value [V]

    def __call__(self, recording: Recording, rng: np.random.Generator) -> Recording:

        def add(v: np.ndarray) -> np.ndarray:
            low, high = self.band
            if low == high:
                turns = low * recording.time + rng.random()
                return v + self.rms * np.sqrt(2) * np.cos(2 * np.pi * turns)
            f = np.fft.rfftfreq(v.size, 1 / recording.sample_rate)
            white = np.fft.rfft(rng.standard_normal(v.size))
            noise = np.fft.irfft(np.where((f >= low) & (f <= high), white, 0.0), v.size)
            return v + self.rms * noise / np.std(noise)

        return _changed(recording, add)


COLOURS = {
    "hum of 50 Hz": (50.0, 50.0),
    "hum of 60 Hz": (60.0, 60.0),
    "below 1 kHz": (20.0, 1e3),
    "5 to 50 kHz": (5e3, 50e3),
}


def scene(loads: Callable[[SkinLoad], Callable] = lambda skin: skin, **settings) -> Scene:
    """Trials with dry and damp skin by turns; `settings` as `Scene` takes them."""
    kinds = [(name, loads(skin)) for name, skin in LOADS.items()]
    every = {f"{name}/{number:02d}": load for number in range(MOST) for name, load in kinds}
    return recorded(every, **settings)


MOST = 5  # trials of each kind


def periods(count: int, sample_rate: float = 200e3) -> int:
    """Samples of so many pulse periods."""
    return int(np.ceil(count * sample_rate / 60.0 - 1e-9))


def _level(ratio: float, skin: SkinLoad) -> SkinLoad:
    """The same skin at another impedance level."""
    z_th = abs(TransformerDriver().z_th(np.array([RATIO_AT]))[0])
    scale = ratio * float(z_th) / (skin.r_s + skin.r_p)
    return SkinLoad(scale * skin.r_s, scale * skin.r_p, skin.c_p / scale)


def transformer(order: int) -> TransformerDriver:
    """The driver with as many poles, 2 to 6."""
    lost = [part for poles, part in LOST.items() if poles >= order]
    return TransformerDriver(**functools.reduce(operator.or_, lost))


def cells() -> Iterator[Cell]:
    for snr in SNR_DB:
        row, db = f"{snr} dB", float(snr)
        for ratio in RATIOS:
            skin = scene(functools.partial(_level, ratio), snr_db=db)
            yield Cell("SNR and skin / driver impedance", row, f"{ratio:g}", skin)
        for name, rate in SAMPLE_RATES.items():
            whole = scene(snr_db=db, sample_rate=rate, samples=periods(3, rate))
            yield Cell("SNR and sample rate", row, name, whole)
        for count in PERIODS:
            whole = scene(snr_db=db, samples=periods(count))
            yield Cell("SNR and periods", row, str(count), whole)
        for name, jitter in DELAYS.items():
            late = scene(snr_db=db, trigger_jitter_rms=jitter)
            yield Cell("SNR and trigger delay, rms", row, name, late)
        for name, loads in NOT_ONE_RC.items():
            yield Cell("SNR and skin that is not one RC", row, name, scene(loads, snr_db=db))
    for true in sorted(LOST):
        behind = scene(driver=transformer(true))
        for order in ORDERS:
            yield Cell("true and given driver order", str(true), str(order), behind, order)
    middle = scene()
    sigma = middle.waveform().sigma
    for name, clipper in CLIPPERS.items():
        for part in CLIPPED:
            change = clipper(part / 100)
            change = dataclasses.replace(change, sigma=sigma * change.sigma)
            yield Cell("clipped samples of v_th", name, f"{part:g} %", middle, change=change)
    for name, band in COLOURS.items():
        for strength in STRENGTHS:
            change = Coloured(band, strength * sigma)
            yield Cell("coloured noise / white noise", name, f"{strength:g}", middle, change=change)
    for snr in SNR_DB:
        skin = scene(snr_db=float(snr))
        chart, row = "SNR and circuit fitted to skin", f"{snr} dB"
        yield Cell(chart, row, "resistor", skin, circuit=Resistor())
    for snr in SNR_DB:
        for name, settings in ELECTRONICS.items():
            if name != WHITE:
                place = "SNR and instrument", f"{snr} dB", name.replace("_", " ")
                yield Cell(*place, scene(snr_db=float(snr), **settings))
