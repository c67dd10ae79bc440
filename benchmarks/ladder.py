"""The ladder of scenes on which estimators are compared: one calibration and one trial each.

Every rung differs from the middle one, 60 dB, three periods at 200 kHz, trigger delays of 50 ns, in
one thing.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks import ngspice
from etid.circuits.circuit import AbstractCircuit
from etid.recordings.study import Study
from etid.simulation.published import REFERENCE, TYPICAL
from etid.simulation.scenes import INSTRUMENTS, Electronics, Scene, Trial
from etid.simulation.transformer import Impedance, ResistorLoad

LOADS = TYPICAL
TRUTH = {path: dataclasses.astuple(skin) for path, skin in LOADS.items()}  # elements, in SI
START = (20e3, 100e3, 0.3e-9)  # elements, in SI, of no fingertip in particular
TRIAL = "skin/01"
CALIBRATION = "calibration/98k8"
TWO = tuple(Trial(f"calibration/{i}", ResistorLoad(r)) for i, r in enumerate((REFERENCE, 21.62e3)))
SNR_DB = (80, 60, 40, 30, 20)
PERIODS = {1: 3_334, 10: 33_334, 30: 100_000}  # samples at 200 kHz
SAMPLE_RATES = {"100 kHz": 100e3, "500 kHz": 500e3, "1 MHz": 1e6}
SOURCES: Mapping[str, Callable[[Scene, int], Study]] = {
    "simulated": Scene.simulate,
    "spice": ngspice.record,
}
JITTER = {"no delays": 0.0, "delays of 500 ns": 500e-9}

# Settings of a scene: noise as behind the filter, noise of an amplifier before it, instruments.
WHITE, BEFORE = "white", "before_the_filter"
ELECTRONICS: Mapping[str, Mapping[str, Any]] = {
    WHITE: {},
    BEFORE: {"electronics": Electronics()},
    **INSTRUMENTS,
}


def recorded(
    loads: Mapping[str, Impedance | AbstractCircuit],
    resistors: Mapping[str, float] = {CALIBRATION: REFERENCE},
    **settings: Any,
) -> Scene:
    """Loads and calibrations by path; `settings` of `Scene` in place of the middle rung's."""
    middle = {"snr_db": 60.0, "samples": 10_000, "trigger_jitter_rms": 50e-9}
    return Scene(
        tuple(Trial(path, load) for path, load in loads.items()),
        tuple(Trial(path, ResistorLoad(r)) for path, r in resistors.items()),
        **{**middle, **settings},
    )


def rung(load: str, **settings: Any) -> Scene:
    """One scene; `settings` as `recorded` takes them."""
    return recorded({TRIAL: LOADS[load]}, **settings)


def ladder() -> Mapping[str, Scene]:
    rungs = {f"{load}, {snr} dB": rung(load, snr_db=float(snr)) for load in LOADS for snr in SNR_DB}
    for count, samples in PERIODS.items():
        rungs[f"dry, {count} period{'s' if count > 1 else ''}"] = rung("dry", samples=samples)
    for name, rate in SAMPLE_RATES.items():
        samples = round(3 * rate / 60.0)
        rungs[f"dry, {name}"] = rung("dry", sample_rate=rate, samples=samples)
    for name, jitter in JITTER.items():
        rungs[f"dry, {name}"] = rung("dry", trigger_jitter_rms=jitter)
    return rungs
