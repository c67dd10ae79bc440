"""The ladder of scenes on which estimators are compared: one calibration and one trial each.

Every rung differs from the middle one, 60 dB, three periods at 200 kHz, trigger delays of 50 ns, in
one thing.
"""

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks import ngspice
from etid.recordings.study import Study
from etid.simulation.published import REFERENCE, TYPICAL
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad

LOADS = TYPICAL
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


def rung(load: str, **settings: Any) -> Scene:
    """One scene; `settings` as `Scene` takes them, in place of those of the middle rung."""
    middle = {"snr_db": 60.0, "samples": 10_000, "trigger_jitter_rms": 50e-9}
    return Scene(
        (Trial(TRIAL, LOADS[load]),),
        (Trial(CALIBRATION, ResistorLoad(REFERENCE)),),
        **{**middle, **settings},
    )


def ladder() -> Mapping[str, Scene]:
    """All rungs by name."""
    rungs = {f"{load}, {snr} dB": rung(load, snr_db=float(snr)) for load in LOADS for snr in SNR_DB}
    for count, samples in PERIODS.items():
        rungs[f"dry, {count} period{'s' if count > 1 else ''}"] = rung("dry", samples=samples)
    for name, rate in SAMPLE_RATES.items():
        samples = round(3 * rate / 60.0)
        rungs[f"dry, {name}"] = rung("dry", sample_rate=rate, samples=samples)
    for name, jitter in JITTER.items():
        rungs[f"dry, {name}"] = rung("dry", trigger_jitter_rms=jitter)
    return rungs
