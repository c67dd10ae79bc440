"""Pulses, multisines, chirps, random bits, noise and a step: are elements and ± right for each?

A record is three whole periods of a wave, or a part of a longer one, cut anywhere. The wave is
the current through dry skin, or V_th of a drawn driver that was calibrated with 98.8 kOhm and the
same kind of wave; or a converter holds the current between its samples, whose command is exact.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.signal

import etid
from benchmarks import perturbed_study as lab
from benchmarks.rates import covered
from benchmarks.runner import FOLDER, WORKERS, Target, option, report, show, tabled
from etid.results.verdicts import USABLE, counts
from etid.simulation.published import REFERENCE

RATE = 200e3  # [Hz] of the samples
SKIN = etid.SkinRC(33e3, 186e3, 0.12e-9)
PERIOD, LONG, BEFORE = 3000, 12_288, 500  # [samples] of a period; of a wave; before a cut record
CORNER = 50e3  # [Hz] of a low-pass so steep that there are no aliases
SIZE = 50.0, 1e-3  # rms of V_th [V] and of a current [A]
KINDS = ("pulses", "multisine", "chirp", "bits", "noise", "step")
RECORDS = (
    "current, 3 periods",
    "current, cut",
    "current, held",
    "driver, 3 periods",
    "driver, cut",
)

ACCEPTED = 0.95  # of good recordings
SCATTER = 0.7, 1.4  # rms of the errors over ±
OPTIONS = (
    WORKERS,
    FOLDER,
    option("--draws", default=24),
    option("--snr-db", default=60.0, metavar="DB", help="of each record, in its own deviation"),
)


def wave(kind: str, rng: np.random.Generator, size: int) -> np.ndarray:
    """A wave that repeats after so many samples, before any low-pass."""
    at, lines = np.arange(size), np.zeros(size // 2 + 1, complex)
    match kind:
        case "pulses":
            return 1.0 * (at % 3333 < 133)
        case "step":
            return 1.0 * ((at > size // 8) & (at < 0.73 * size))
        case "bits":
            return np.resize(np.repeat(rng.choice([-1.0, 1.0], -(-size // 12)), 12), size)
        case "noise":
            return rng.standard_normal(size)
        case "multisine":
            number = np.unique(np.geomspace(7, 0.16 * size, 25).astype(int))
            lines[number] = np.exp(2j * np.pi * rng.uniform(size=number.size))
        case "chirp":
            number = np.arange(1, int(0.2 * size))
            lines[number] = np.exp(-1j * np.pi * number**2 / number.size)
    return np.fft.irfft(lines, size)


def passed(wave: np.ndarray, *gains: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """The wave behind the low-pass, and behind each of these gains besides."""
    f, lines = np.fft.rfftfreq(wave.size, 1 / RATE), np.fft.rfft(wave)
    lines = (lines / (1 + (f / CORNER) ** 16))[1:-1]
    every = [lines, *(lines * gain(f[1:-1]) for gain in gains)]
    return [np.fft.irfft(np.pad(one, 1), wave.size) for one in every]


def held(command: np.ndarray) -> np.ndarray:
    """Voltages at dry skin, exact at the samples of a current that is held between them."""
    decay = np.exp(-1 / (RATE * float(SKIN.r_p) * float(SKIN.c_p)))
    of_layer = scipy.signal.lfilter([0, float(SKIN.r_p) * (1 - decay)], [1, -decay], command)
    return float(SKIN.r_s) * command + np.asarray(of_layer)


def recording(
    both: Sequence[np.ndarray],
    snr: float,
    rng: np.random.Generator,
    whole: bool,
    size: float,
    **fields: Any,
) -> etid.Recording:
    """The recording of a cause and of its effect, with noise; all of them, or a part."""
    clean = np.stack(both) * (size / both[0].std())
    clean = np.tile(clean, 3) if whole else clean[:, BEFORE : BEFORE + PERIOD]
    noisy = clean + clean.std(1)[:, None] / snr * rng.standard_normal(clean.shape)
    if fields.get("hold"):
        noisy[0] = clean[0]
    cause = "v_th" if size == SIZE[0] else "current"
    rate = RATE / PERIOD if whole else 60.0
    of = {cause: noisy[0], "v_out": noisy[1], "sample_rate": RATE, "pulse_rate": rate}
    return etid.Recording(**of, **fields)


def fitted(kind: str, record: str, snr_db: float, number: int) -> tuple[str, np.ndarray, float]:
    """The verdict of a fit, its errors in ±, and its time [s]."""
    rng = np.random.default_rng([number, *f"{kind}, {record}".encode()])
    snr, whole = 10 ** (snr_db / 20), record.endswith("periods")
    size = PERIOD if whole else LONG
    driver = None
    if record.startswith("driver"):
        of = lab.undisturbed(number, snr_db, lab.PARTS).calibrations[0].out.driver

        def divided(load: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda f: np.asarray(load(f)) / (np.asarray(load(f)) + of.z_th(f))

        known, of_skin = divided(lambda f: REFERENCE + 0 * f), divided(SKIN.response)
        both = passed(wave(kind, rng, size), known)
        first = recording(both, snr, rng, whole, SIZE[0], r_load=REFERENCE)
        try:
            driver = etid.identify_driver(first)
        except etid.IdentificationError as error:
            return _why(error), np.full(len(SKIN.names()), np.nan), 0.0
        one = recording(passed(wave(kind, rng, size), of_skin), snr, rng, whole, SIZE[0])
    elif record.endswith("held"):
        command = wave(kind, rng, size)
        one = recording([command, held(command)], snr, rng, whole, SIZE[1], hold="zero")
    else:
        both = passed(wave(kind, rng, size), lambda f: np.asarray(SKIN.response(f)))
        one = recording(both, snr, rng, whole, SIZE[1])
    begun = time.perf_counter()
    fit = etid.identify_skin(one, driver, throw=False)
    taken = time.perf_counter() - begun
    stderr = np.array([float(getattr(fit.stderr, name)) for name in SKIN.names()])
    return fit.verdict, (fit.circuit.values() - SKIN.values()) / stderr, taken


def _why(error: etid.IdentificationError) -> str:
    """The verdict of a driver that cannot be used."""
    return "no driver" if error.outcome is None else str(error.outcome.verdict)


def row_of(
    kind: str, record: str, every: Sequence[tuple[str, np.ndarray, float]]
) -> dict[str, Any]:
    """One line of the table; scatter is the rms of the errors over ±."""
    good = [z for verdict, z, _ in every if verdict in USABLE]
    z = np.array(good).reshape(-1, len(SKIN.names()))
    found = {"wave": kind, "record": record, "fits": len(every), "usable": len(good) / len(every)}
    rms = np.sqrt((z**2).sum(0) / max(len(good), 1))
    found |= {f"scatter_{name}": float(one) for name, one in zip(SKIN.names(), rms, strict=True)}
    found["within"] = covered(z, range(len(good))).rate
    found["largest"] = float(np.abs(z).max(initial=0.0))
    names = counts(np.array([verdict for verdict, *_ in every]))
    found["verdicts"] = ", ".join(f"{number} {name}" for name, number in names.items())
    return {**found, "ms": 1e3 * float(np.median([seconds for *_, seconds in every]))}


def main(arguments: argparse.Namespace) -> bool:
    cells = list(itertools.product(KINDS, RECORDS))
    draws = range(arguments.draws)
    tasks = [(*cell, arguments.snr_db, number) for cell in cells for number in draws]

    def rows(done: dict[int, Any]) -> list[dict[str, Any]]:
        of: dict[tuple[str, str], list[Any]] = {}
        for number, one in done.items():
            of.setdefault(cells[number // len(draws)], []).append(one)
        return [row_of(*cell, every) for cell, every in of.items()]

    path = arguments.folder / "excitations.csv"
    every = tabled(path, rows, fitted, tasks, workers=arguments.workers, keep="excitations")
    targets = []
    for row in rows(dict(enumerate(every))):
        show(row)
        name = f"{row['wave']}, {row['record']}"
        targets.append(Target(f"{name}: usable", row["usable"], least=ACCEPTED))
        scatter = [row[f"scatter_{element}"] for element in SKIN.names()]
        for one, size in zip(SKIN.names(), scatter, strict=True):
            targets.append(Target(f"{name}: scatter of {one} over ±", size, *SCATTER))
    return report([one for one in targets if not one.met] or targets[:1])
