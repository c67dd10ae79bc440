"""A study in which all is well, and the ways to change it.

A `Change` is a function from that study to another; `benchmarks.perturbation_list` has them all.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

import etid
from benchmarks.laboratory import CORNER, SCALE, Output, Record, exponential, noise
from benchmarks.ladder import ELECTRONICS, LOADS
from etid.simulation.falling import FallingResistance
from etid.simulation.published import REFERENCE
from etid.simulation.transformer import Impedance, ResistorLoad, SkinLoad, TransformerDriver

SECOND = 21.62e3  # [ohm]
DELAY = 50e-9  # [s] rms, of every loaded and unloaded record
PARTS = 0.03  # standard deviation of the logarithm of every part of a driver
FIXED = ("amplitude", "width", "edge", "lead_in", "turns")
PERIODS = 3
SAMPLE = 5e-6  # [s]
COHERENT_RATE = 240e3  # [Hz] 4000 samples in a period of 60 Hz
PULSE_RATE = 60.0  # [Hz]


@dataclasses.dataclass(frozen=True)
class Truth:
    """What is right to say of a skin; arrays are (element,), in SI."""

    low: Float[np.ndarray, " element"]  # smallest value of each element in the record
    high: Float[np.ndarray, " element"]  # largest
    moves: bool = False  # whether it went from the one to the other, which an answer has to say
    words: bool = False  # whether the elements are a matter of words: wrong by 20 % only

    @classmethod
    def of(cls, *skins: SkinLoad, **more: bool) -> "Truth":
        """The range of several skins."""
        values = np.array([dataclasses.astuple(skin) for skin in skins])
        return cls(values.min(0), values.max(0), **more)


@dataclasses.dataclass(frozen=True)
class Study:
    """The records of a driver."""

    number: int  # of the driver
    calibrations: tuple[Record, ...]  # with known resistors
    trials: tuple[Record, ...]  # with skin
    truths: Mapping[str, Truth]  # of the trials, by path

    def recordings(self) -> etid.Study:
        """Its recordings; their random numbers depend on the number of the driver."""
        every = (*self.calibrations, *self.trials)
        return etid.Study.from_recordings([one.recording(self.number) for one in every])


Change = Callable[[Study], Study]


def drawn_driver(number: int, spread: float, usual: TransformerDriver) -> TransformerDriver:
    """One of many transformers, whose parts have this standard deviation of their logarithms."""
    rng = np.random.default_rng([number, *b"driver"])
    parts = {
        field.name: getattr(usual, field.name) * float(np.exp(spread * rng.standard_normal()))
        for field in dataclasses.fields(usual)
        if field.name not in FIXED
    }
    return dataclasses.replace(usual, **parts)


def undisturbed(number: int, snr_db: float, parts: float = PARTS) -> Study:
    """The study of one driver: dry and damp skin, 98.8 kΩ, three periods at 200 kHz.

    Its parts differ by so much from those of `TransformerDriver`.
    """
    driver = drawn_driver(number, parts, TransformerDriver())
    rng = np.random.default_rng([number, *b"delays"])
    sigma = noise(driver, 200e3, snr_db)

    def made(path: str, load: Impedance, r_load: float | None = None) -> Record:
        th, out = (DELAY * rng.standard_normal() for _ in range(2))
        return Record(
            path, Output(driver, delay=th), Output(driver, (load,), delay=out), sigma, r_load
        )

    return Study(
        number,
        (made("calibration/98k8", ResistorLoad(REFERENCE), REFERENCE),),
        tuple(made(name, skin) for name, skin in LOADS.items()),
        {name: Truth.of(skin) for name, skin in LOADS.items()},
    )


def _to(*groups: str) -> Callable[[Callable[[Record], Record]], Change]:
    """Change the records of some groups."""

    def changing(change: Callable[[Record], Record]) -> Change:
        return lambda study: dataclasses.replace(
            study, **{group: tuple(map(change, getattr(study, group))) for group in groups}
        )

    return changing


def _fields(*names: str) -> Callable[..., Callable[[Record], Record]]:
    """Change fields of some voltages of a record."""

    def changing(**fields: Any) -> Callable[[Record], Record]:
        return lambda of: dataclasses.replace(
            of, **{name: dataclasses.replace(getattr(of, name), **fields) for name in names}
        )

    return changing


all_records, calibrations = _to("calibrations", "trials"), _to("calibrations")
trials = _to("trials")
both, out, th = _fields("th", "out"), _fields("out"), _fields("th")


def record(**fields: Any) -> Callable[[Record], Record]:
    """Change fields of a record."""
    return lambda of: dataclasses.replace(of, **fields)


def late(samples: float) -> Callable[[Record], Record]:
    """Record the loaded voltage later than the unloaded one."""
    return lambda of: out(delay=of.out.delay + samples * SAMPLE)(of)


def parts(*voltages: str, **factors: float) -> Callable[[Record], Record]:
    """Multiply parts of the driver behind some voltages, or behind both."""

    def change(of: Record) -> Record:
        driver = of.out.driver
        new = {name: getattr(driver, name) * factor for name, factor in factors.items()}
        return _fields(*(voltages or ("th", "out")))(driver=dataclasses.replace(driver, **new))(of)

    return change


def fault(name: str, size: float) -> Callable[[Record], Record]:
    """Let the loaded voltage have a fault of `DIRECTIONS`."""
    return lambda of: out(faults=(*of.out.faults, (name, size)))(of)


def neighbour(later: float, part: float = 0.01) -> Callable[[Record], Record]:
    """Let the loaded voltage see a part of an unloaded one whose pulse is later by so much [s]."""

    def change(of: Record) -> Record:
        other = dataclasses.replace(of.th, delay=of.th.delay - later)

        def seen(time: Float[np.ndarray, " time"], rng: np.random.Generator):
            return part * other.volts(of.sample_rate, time.size, rng)

        return out(added=(seen,))(of)

    return change


def _other(change: Callable[[Record], Record], truth: Callable[[str], Truth]) -> Change:
    """Change the records of skin, and what is true of it, by path."""
    return lambda study: dataclasses.replace(
        trials(change)(study), truths={path: truth(path) for path in study.truths}
    )


def skin_is(make: Callable[[SkinLoad], Impedance], **more: bool) -> Change:
    """Replace the skin by something with the same limits."""
    loads = {path: make(skin) for path, skin in LOADS.items()}
    return _other(
        lambda of: out(loads=(loads[of.path],))(of),
        lambda path: Truth.of(getattr(loads[path], "elements", LOADS[path]), **more),
    )


def changing(element: str, fall: float, steps: bool, periods: int = PERIODS) -> Change:
    """Let an element fall from pulse to pulse, or in one step after the first half."""
    place = np.arange(periods) / (periods - 1)
    kept = 1 - fall * (np.where(place >= 0.5, 1.0, 0.0) if steps else place)

    def skins(path: str) -> tuple[SkinLoad, ...]:
        value = getattr(LOADS[path], element)
        return tuple(dataclasses.replace(LOADS[path], **{element: value * part}) for part in kept)

    return _other(
        lambda of: out(loads=skins(of.path))(of),
        lambda path: Truth.of(*skins(path), moves=True),
    )


def nonlinear(fall: float) -> Change:
    """Let R_p fall with the voltage; any R_p between the two is right."""

    def truth(path: str) -> Truth:
        skin = LOADS[path]
        return Truth.of(skin, dataclasses.replace(skin, r_p=(1 - fall) * skin.r_p))

    def change(of: Record) -> Record:
        skin = LOADS[of.path]
        load = FallingResistance(skin.r_p, skin.c_p, ResistorLoad(skin.r_s), fall)
        return out(voltage=lambda driver, sampler: load.voltage(driver, sampler.f))(of)

    return _other(change, truth)


def _later(of: Record, by: float, **fields: Any) -> Record:
    """The record with both voltages later by so much [s], and with other fields."""
    for name in ("th", "out"):
        new = {"delay": getattr(of, name).delay + by, **fields}
        of = _fields(name)(**new)(of)
    return of


def on_edge(of: Record) -> Record:
    """Begin both records on an edge, and let the last pulse of three come one sample late."""
    driver, late = of.th.driver, PULSE_RATE * SAMPLE
    pulses = (0, 1.0), (1, 1.0), (2 + late, 1.0)
    return _later(of, driver.lead_in + driver.edge / 2, pulses=pulses, over=PERIODS)


def beginning(after: float) -> Change:
    """Begin all records so much [s] after the start of a pulse."""
    return all_records(lambda of: _later(of, -of.th.driver.lead_in - after))


def wide(width: float) -> Change:
    """Let all pulses last so long [s]."""
    return all_records(lambda of: both(driver=dataclasses.replace(of.th.driver, width=width))(of))


def second_resistor(factor: float) -> Change:
    """Calibrate with a second resistor, which is not what the file says by this factor."""

    def change(study: Study) -> Study:
        [first] = study.calibrations
        rng = np.random.default_rng([study.number, *b"second resistor"])
        delays = DELAY * rng.standard_normal(2)
        second = record(path="calibration/21k62", r_load=SECOND)(first)
        second = th(delay=delays[0])(second)
        second = out(delay=delays[1], loads=(ResistorLoad(factor * SECOND),))(second)
        return dataclasses.replace(study, calibrations=(first, second))

    return change


def lasting(samples: int, change: Change = lambda study: study) -> Change:
    """Make records of another length."""
    return lambda study: change(all_records(record(samples=samples))(study))


def instrument(name: str) -> Change:
    """Record with one of `ELECTRONICS`; its offset is left out, which no harmonic shows."""
    of = dict(ELECTRONICS[name])
    of.pop("offset_rms", None)
    rate = PULSE_RATE * (1 + 1e-6 * of.pop("pulse_rate_ppm", 0.0))
    converter = {key: of.pop(key) for key in ("bits", "full_scale") if key in of}
    return lambda study: all_records(
        lambda one: record(**converter)(both(pulse_rate=rate, **of)(one))
    )(study)


def coherent(antialias: float = CORNER) -> Change:
    """Record a whole number of samples in each period; `antialias` is of the sample rate."""
    rate = {"sample_rate": COHERENT_RATE, "samples": round(PERIODS * COHERENT_RATE / 60)}

    def change(study: Study) -> Study:
        # Where between two samples the pulses begin is the phase of the aliases.
        start = np.random.default_rng([study.number, *b"start"]).uniform() / COHERENT_RATE
        return all_records(lambda of: record(**rate)(_later(of, start, antialias=antialias)))(study)

    return change


def tail(height: float, time_constant: float) -> Callable[[Record], Record]:
    """Let every loaded pulse leave a tail [V at the terminal, s]."""

    def change(of: Record) -> Record:
        driver = of.out.driver
        times = time_constant, driver.lead_in + driver.width, 1 / PULSE_RATE
        return out(added=(exponential(SCALE * height, *times),))(of)

    return change
