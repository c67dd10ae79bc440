"""Which pulse tells most about the skin? The bound of R_s over pulse width and rate.

Peak voltage, charge per second and the length of the record are the same for all: the product of
width and rate is that of the paper's pulse, 667 µs at 60 Hz.
"""

import argparse
import dataclasses
from typing import Any

import numpy as np
import scipy.optimize

import etid
from benchmarks.ladder import LOADS, recorded
from etid.simulation.transformer import TransformerDriver

OPTIONS = ()
DUTY = 0.04  # the paper's
DURATION = 0.05  # [s] of a record
RATES = (20.0, 40.0, 60.0, 100.0, 200.0, 400.0, 1000.0, 2000.0)  # [Hz]
NOISE = 10e-3  # [V] at the terminal, 60 dB below the paper's pulse


def error(pulse_rate: float, load: str) -> dict[str, float]:
    """Relative bounds of the elements, by a pulse of the same peak and charge per second."""
    pulse = dataclasses.replace(
        TransformerDriver(), width=DUTY / pulse_rate, lead_in=min(120e-6, 0.2 / pulse_rate)
    )
    samples = round(DURATION * 200e3)
    settings = {"driver": pulse, "pulse_rate": pulse_rate, "samples": samples, "bits": None}
    made = recorded({load: LOADS[load]}, **settings)
    # The same noise in volts for all: signal-to-noise is relative to the effective value.
    effective = np.sqrt(2 * np.sum(np.abs(made.waveform().v_th) ** 2))
    made = dataclasses.replace(made, snr_db=float(20 * np.log10(effective / NOISE)))
    return etid.bound(made)[load].relative


def main(arguments: argparse.Namespace) -> bool:
    del arguments
    for load in LOADS:
        print(f"{load}: bounds in % of r_s, r_p, c_p")
        for rate in RATES:
            text = "".join(f"{100 * value:9.3f}" for value in error(rate, load).values())
            print(f"  {rate:6.0f} Hz, {1e6 * DUTY / rate:7.1f} us{text}")
        # SciPy has no types: what is inferred for its result depends on what else is checked.
        best: Any = scipy.optimize.minimize_scalar(
            lambda log, load=load: error(float(np.exp(log)), load)["r_s"],
            bounds=np.log([RATES[0], RATES[-1]]),
            method="bounded",
            options={"xatol": 1e-2},
        )
        rate, gain = float(np.exp(best.x)), error(60.0, load)["r_s"] / best.fun
        print(
            f"  best for r_s: {rate:.0f} Hz, {1e6 * DUTY / rate:.0f} us: {100 * best.fun:.3f} %, "
            f"{gain:.2f} times better than 60 Hz"
        )
    return True
