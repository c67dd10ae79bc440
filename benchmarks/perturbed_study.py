"""A study in which all is well, and the ways to change it.

`undisturbed` draws a study in which all is well: dry and damp skin, 98.8 kΩ, three periods at
200 kHz, trigger delays of 50 ns rms, parts of the driver 3 % from those of `TransformerDriver`.
A `Change` is a function from that study to another; `benchmarks.perturbation_list` has them all.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.disturbances import Leaky, Nonlinear, Pink
from benchmarks.laboratory import CORNER, Crosstalk, Output, Record, noise
from benchmarks.ladder import LOADS
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
    # whether it went from the one to the other: an answer that does not say so claims that the
    # elements were what it gives all the time
    moves: bool = False
    # whether the elements are a matter of words, as of skin that is not one RC: they are wrong by
    # 20 % only
    words: bool = False

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


Change = Callable[[Study], Study]


def drawn_driver(number: int, spread: float, usual: TransformerDriver) -> TransformerDriver:
    """One of many transformers of a kind.

    Args:
        number: Of the driver; equal numbers are equal drivers.
        spread: Standard deviation of the logarithm of every part.
        usual: The medians of the parts, and what all have in common: pulse and turns.
    """
    rng = np.random.default_rng([number, *b"driver"])
    parts = {
        field.name: getattr(usual, field.name) * float(np.exp(spread * rng.standard_normal()))
        for field in dataclasses.fields(usual)
        if field.name not in FIXED
    }
    return dataclasses.replace(usual, **parts)


def undisturbed(number: int, snr_db: float) -> Study:
    """The study of one driver.

    Args:
        number: Of the driver; parts and delays are drawn from it.
        snr_db: Of every record [dB].
    """
    driver = drawn_driver(number, PARTS, TransformerDriver())
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


def all_records(change: Callable[[Record], Record]) -> Change:
    """Change calibrations and trials."""

    def changed(study: Study) -> Study:
        calibrations = tuple(map(change, study.calibrations))
        return dataclasses.replace(study, calibrations=calibrations, **_trials(study, change))

    return changed


def calibrations(change: Callable[[Record], Record]) -> Change:
    """Change the calibrations only."""
    return lambda study: dataclasses.replace(
        study, calibrations=tuple(map(change, study.calibrations))
    )


def trials(change: Callable[[Record], Record]) -> Change:
    """Change the records of skin only."""
    return lambda study: dataclasses.replace(study, **_trials(study, change))


def _trials(study: Study, change: Callable[[Record], Record]) -> dict[str, Any]:
    return {"trials": tuple(map(change, study.trials))}


def record(**fields: Any) -> Callable[[Record], Record]:
    """Change fields of a record."""
    return lambda of: dataclasses.replace(of, **fields)


def both(**fields: Any) -> Callable[[Record], Record]:
    """Change fields of both voltages."""
    return lambda of: dataclasses.replace(
        of, th=dataclasses.replace(of.th, **fields), out=dataclasses.replace(of.out, **fields)
    )


def out(**fields: Any) -> Callable[[Record], Record]:
    """Change fields of the loaded voltage."""
    return lambda of: dataclasses.replace(of, out=dataclasses.replace(of.out, **fields))


def th(**fields: Any) -> Callable[[Record], Record]:
    """Change fields of the unloaded voltage."""
    return lambda of: dataclasses.replace(of, th=dataclasses.replace(of.th, **fields))


def late(samples: float) -> Callable[[Record], Record]:
    """Record the loaded voltage later than the unloaded one."""
    return lambda of: out(delay=of.out.delay + samples * SAMPLE)(of)


def parts(**factors: float) -> Callable[[Record], Record]:
    """Multiply parts of the driver behind both voltages."""

    def change(of: Record) -> Record:
        known = of.out.driver
        new = {name: getattr(known, name) * factor for name, factor in factors.items()}
        return both(driver=dataclasses.replace(known, **new))(of)

    return change


def louder(factor: float) -> Callable[[Record], Record]:
    """Multiply the amplitude of the driver behind the loaded voltage."""

    def change(of: Record) -> Record:
        driver = of.out.driver
        return out(driver=dataclasses.replace(driver, amplitude=factor * driver.amplitude))(of)

    return change


def crosstalk(later: float) -> Callable[[Record], Record]:
    """Let the loaded voltage see 1 % of an unloaded one whose pulse is later by so much [s]."""
    return lambda of: out(added=(Crosstalk(of.th, 0.01, later),))(of)


def skin_is(make: Callable[[SkinLoad], Impedance], **more: bool) -> Change:
    """Replace the skin by something with the same limits."""

    def change(study: Study) -> Study:
        def replaced(of: Record) -> Record:
            return out(loads=(make(LOADS[of.path]),))(of)

        truths = {
            path: Truth.of(getattr(make(LOADS[path]), "elements", LOADS[path]), **more)
            for path in study.truths
        }
        return dataclasses.replace(trials(replaced)(study), truths=truths)

    return change


def changing(element: str, fall: float, steps: bool, periods: int = PERIODS) -> Change:
    """Let an element fall from pulse to pulse, or in one step after the first half."""
    place = np.arange(periods) / (periods - 1)
    lost = fall * (np.where(place >= 0.5, 1.0, 0.0) if steps else place)

    def skins(path: str) -> list[SkinLoad]:
        at_first = LOADS[path]
        value = getattr(at_first, element)
        return [dataclasses.replace(at_first, **{element: value * (1 - part)}) for part in lost]

    def change(study: Study) -> Study:
        found = trials(lambda of: out(loads=tuple(skins(of.path)))(of))(study)
        truths = {path: Truth.of(*skins(path), moves=True) for path in study.truths}
        return dataclasses.replace(found, truths=truths)

    return change


def nonlinear(fall: float) -> Change:
    """Let R_p fall with the voltage; any R_p between the two is right."""

    def change(study: Study) -> Study:
        found = trials(lambda of: out(voltage=Nonlinear(LOADS[of.path], fall))(of))(study)
        truths = {
            path: Truth.of(skin, dataclasses.replace(skin, r_p=(1 - fall) * skin.r_p))
            for path, skin in LOADS.items()
        }
        return dataclasses.replace(found, truths=truths)

    return change


def pulses(*places: tuple[float, float]) -> dict[str, Any]:
    """Fields of a voltage with these pulses in a record of three periods."""
    return {"pulses": places, "over": PERIODS}


def on_edge(of: Record) -> Record:
    """Begin both records on an edge, and let the last pulse of three come one sample late."""
    driver, late = of.th.driver, PULSE_RATE * SAMPLE
    earlier = driver.lead_in + driver.edge / 2
    moved = (
        dataclasses.replace(
            one, delay=one.delay + earlier, **pulses((0, 1.0), (1, 1.0), (2 + late, 1.0))
        )
        for one in (of.th, of.out)
    )
    return record(**dict(zip(("th", "out"), moved, strict=True)))(of)


def second_resistor(factor: float) -> Change:
    """Calibrate with a second resistor, which is not what the file says by this factor."""

    def change(study: Study) -> Study:
        [first] = study.calibrations
        rng = np.random.default_rng([study.number, *b"second resistor"])
        second = dataclasses.replace(
            first,
            path="calibration/21k62",
            th=dataclasses.replace(first.th, delay=DELAY * rng.standard_normal()),
            out=dataclasses.replace(
                first.out,
                loads=(ResistorLoad(factor * SECOND),),
                delay=DELAY * rng.standard_normal(),
            ),
            r_load=SECOND,
        )
        return dataclasses.replace(study, calibrations=(first, second))

    return change


def skin_for_resistor(study: Study) -> Study:
    """Calibrate with dry skin in the resistor's place."""
    return calibrations(out(loads=(LOADS["dry"],)))(study)


def longer(change: Change = lambda study: study) -> Change:
    """Record six periods."""
    return lambda study: change(all_records(record(samples=20_000))(study))


def coherent(antialias: float = CORNER) -> Change:
    """Record with a whole number of samples in each period, 240 kHz at 60 Hz.

    Args:
        antialias: Corner of the anti-alias filter, relative to the sample rate.
    """

    def change(study: Study) -> Study:
        # Where between two samples the pulses begin is the phase of the aliases.
        start = np.random.default_rng([study.number, *b"start"]).uniform() / COHERENT_RATE

        def changed(of: Record) -> Record:
            th, out = (
                dataclasses.replace(one, delay=one.delay + start, antialias=antialias)
                for one in (of.th, of.out)
            )
            rate = {"sample_rate": COHERENT_RATE, "samples": round(PERIODS * COHERENT_RATE / 60)}
            return dataclasses.replace(of, th=th, out=out, **rate)

        return all_records(changed)(study)

    return change


def pink(of: Record) -> Record:
    """Both voltages with 1/f noise of three times the effective value of the white noise."""
    return both(added=(Pink(3 * of.sigma),))(of)


def leaking(skin: SkinLoad) -> Leaky:
    """Skin with a leak of a hundred times its R_p across it."""
    return Leaky(skin, 100 * skin.r_p)
