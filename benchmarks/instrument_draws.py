"""Recordings of instruments, and good ones with noise before a filter: what etid says of them."""

import dataclasses
import json
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.signal
from jaxtyping import Float

import etid
from benchmarks.estimators import DEFAULT, ELEMENTS, NOTHING, Answer, Drivers, fits, found_by
from benchmarks.ladder import LOADS, recorded
from benchmarks.perturbed_study import PARTS, drawn_driver
from benchmarks.spice import ELEMENTS as NAMES
from etid.recordings.recording import Samples
from etid.simulation.scenes import INSTRUMENTS, Electronics, Scene
from etid.simulation.transformer import SkinLoad

EACH = 2  # trials of each skin behind a driver of an instrument
RATE = 200e3  # [Hz]
PERIOD = RATE / 60  # [samples]
SIX = round(6.03 * PERIOD)  # and a bit, as records have
NOISE_CORNER = 300.0  # of the amplifier's 1/f noise [Hz]
HUM, HUM_RATE = 0.01, 50.02  # [V at the converter, Hz]
SPREAD = 0.2  # standard deviation of the logarithms of the elements of skins
FINER = 500e3  # [Hz] before resampling
CUT = 200  # samples at each end, which filters of data make from what they do not know
FILTERED, DATA_IS = "filtered", "data"  # what is no instrument of `INSTRUMENTS`

Volts = Float[np.ndarray, " time"]


def instrument(name: str, snr_db: float, number: int) -> list[Answer]:
    """Answers behind one driver, by one instrument."""
    settings = dict(INSTRUMENTS[name])
    off = settings.pop("pulse_rate_ppm") * np.random.default_rng([number, *b"quartz"]).uniform(-1)
    own = {"noise_corner": NOISE_CORNER, "hum": HUM, "hum_rate": HUM_RATE}
    settings["electronics"] = dataclasses.replace(settings["electronics"], **own)
    scene = recorded(
        {f"{load}/{trial}": skin for load, skin in LOADS.items() for trial in range(EACH)},
        driver=drawn_driver(number, PARTS, Scene().driver),
        snr_db=snr_db,
        samples=SIX,
        pulse_rate_ppm=off,
        **settings,
    )
    every = scene.simulate(seed=number)
    bounds = {path: np.array([*of.relative.values()]) for path, of in etid.bound(scene).items()}
    return list(_answers(scene, list(every.recordings()), name, number, bounds))


def _answers(
    scene: Scene,
    every: Sequence[etid.Recording],
    name: str,
    number: int,
    bounds: Mapping[str, np.ndarray],
) -> Iterator[Answer]:
    """What the default method says of the skins of a scene."""
    driver = Drivers().of([one for one in every if one.is_calibration], DEFAULT)
    trials = [one for one in every if not one.is_calibration]
    for one, fit in zip(trials, fits(trials, driver, DEFAULT), strict=True):
        truth = np.array([*scene.truth()[one.path].values()])
        values, stderr, verdict = found_by(fit)
        yield Answer(
            *(DEFAULT, number, one.path, verdict, values / truth - 1, stderr / truth),
            bound=bounds.get(one.path, NOTHING),
            chi2=np.nan if fit is None else float(fit.chi2),
            perturbation=name,
            snr_db=float(scene.snr_db or 0),
        )


def resampled(v: Volts, _: np.random.Generator) -> Volts:
    """From `FINER` to `RATE`."""
    ratio = round(FINER / 100e3)
    return scipy.signal.resample_poly(v, round(RATE / 100e3), ratio)


def averaged(v: Volts, rng: np.random.Generator) -> Volts:
    """Moving average of three to five samples."""
    width = rng.integers(3, 6)
    return np.convolve(v, np.full(width, 1 / width), "same")


def both_ways(v: Volts, rng: np.random.Generator) -> Volts:
    """Filtered forwards and backwards."""
    corner = rng.uniform(40e3, 90e3)
    return scipy.signal.sosfiltfilt(scipy.signal.butter(2, 2 * corner / RATE, output="sos"), v)


PROCESSED: Mapping[str, Callable[[Volts, np.random.Generator], Volts]] = {
    "resampled": resampled,
    "averaged": averaged,
    "filtered both ways": both_ways,
}


def filtered(number: int) -> list[Answer]:
    """Answers about ten skins behind one driver, with noise of a filter of its own."""
    rng = np.random.default_rng([number, *b"filter"])
    kinds = ["order"] * 3 + list(PROCESSED)
    turn, which = divmod(number, len(kinds))
    name = kinds[which]
    samples = round((6 if turn // 2 % 2 else 3) * PERIOD) + 2 * CUT
    settings: dict[str, Any] = {"snr_db": (40.0, 50.0)[turn % 2], "samples": samples}
    if name == "order":
        order = int(rng.integers(1, 9))
        settings["electronics"] = Electronics(filter_order=order, noise_corner=NOISE_CORNER)
        settings["antialias"] = rng.uniform(30e3, 90e3) / RATE
        name = f"order {order}"
    elif name == "resampled":
        settings |= {"sample_rate": FINER, "samples": round(samples * FINER / RATE)}
    scene = recorded(
        {f"{load}/{trial}": spread(of, rng) for load, of in LOADS.items() for trial in range(5)},
        driver=drawn_driver(number, PARTS, Scene().driver),
        **settings,
    )
    every = list(scene.simulate(seed=number).recordings())
    if name in PROCESSED:
        every = [processed(one, PROCESSED[name], number) for one in every]
    return list(_answers(scene, every, f"{FILTERED}: {name}", number, {}))


def spread(skin: SkinLoad, rng: np.random.Generator) -> SkinLoad:
    """Another skin of this kind."""
    values = np.array(dataclasses.astuple(skin)) * np.exp(SPREAD * rng.standard_normal(3))
    return SkinLoad(*map(float, values))


def processed(
    recording: etid.Recording, change: Callable[[Volts, np.random.Generator], Volts], number: int
) -> etid.Recording:
    """A recording of changed voltages, without their ends; the change is that of its driver."""

    def changed(v: Volts) -> Samples:
        return Samples(change(v, np.random.default_rng([number, *b"change"]))[CUT:-CUT])

    both = {name: changed(np.asarray(getattr(recording, name))) for name in ("v_th", "v_out")}
    return recording.replace(**both, sample_rate=RATE, adc_range=None)


def answers(name: str, snr_db: float, number: int) -> list[Answer]:
    """Answers behind one driver, by an instrument or with a filter of its own."""
    return filtered(number) if name == FILTERED else instrument(name, snr_db, number)


def skins(folder: pathlib.Path) -> list[Answer]:
    """Answers about the skins of another simulator; none, and a line, without the data."""
    if not (folder / "truth.json").exists():
        print(f"{folder} is not here: no recordings of another simulator")
        return []
    found = []
    for number, (name, truth) in enumerate(json.loads((folder / "truth.json").read_text()).items()):
        of = np.load(folder / f"{name}.npz")
        resistors = [{"r_load": float(r)} for r in of["r_load"]]
        driver = Drivers().of(list(recordings(of, ("cal_th", "cal_out"), resistors)), DEFAULT)
        trials = list(recordings(of, ("v_th", "v_out"), [{}] * len(of["v_th"])))
        for row, fit in enumerate(fits(trials, driver, DEFAULT)):
            true = np.array([truth["elements"][row][NAMES[element]] for element in ELEMENTS])
            values, stderr, verdict = found_by(fit)
            elements = values / true - 1, stderr / true, NOTHING
            chi2, label = np.nan if fit is None else float(fit.chi2), f"{DATA_IS}: {name}"
            one = Answer(DEFAULT, number, str(row), verdict, *elements, chi2, perturbation=label)
            found.append(one)
    return found


def recordings(
    of: Mapping[str, np.ndarray], names: Sequence[str], told: Sequence[Mapping[str, Any]]
) -> Iterator[etid.Recording]:
    """Recordings of an instrument by the names of their voltages, and what each file tells."""
    rates = {"sample_rate": float(of["fs"]), "pulse_rate": float(of["pulse_rate"])}
    step = float(of["lsb"] / of["scale"])
    for row, more in enumerate(told):
        v_th, v_out = (Samples(of[name][row], step) for name in names)
        yield etid.Recording(v_th, v_out, **rates, **more)
