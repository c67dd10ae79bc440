"""impedance.py fits five circuits to impedance spectra: `python -m ... PROBLEM RESULT`.

PROBLEM holds `f` (harmonic,) [Hz]; `z` [ohm], its noise `sigma` = √E|noise|² [ohm] and whether a
harmonic is `used`, all (spectrum, harmonic). RESULT gets the Schwarz criterion `bic` (spectrum,
circuit), infinite where the package gave up, and `seconds` (spectrum,) for all five fits. Units are
MHz, kΩ and nF; the fits start at the typical values of etid. With the package's own tolerance,
1e-13, the criteria are the same and a spectrum takes two to three times as long.
"""

import time
import warnings

import numpy as np
from impedance.models.circuits import (  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq
    CustomCircuit,
)

from benchmarks.rivals import serve
from benchmarks.rivals.records import KILO, MEGA

R_S, R_P, C_P, ALPHA = 20.0, 100.0, 0.3, 0.8  # [kohm, kohm, nF, 1]
TAU = 30.0  # [µs]
ENOUGH = {"ftol": 1e-8, "maxfev": 1000}  # SciPy's own tolerance
# By etid's names, in the order of `etid.selection.search.USUAL`. R in kΩ times C in nF is µs,
# as ω is in 1/µs.
CIRCUITS = {
    "SkinRC": ("R0-p(R1,C1)", [R_S, R_P, C_P]),
    "ParallelRC": ("p(R1,C1)", [R_P, C_P]),
    "Resistor": ("R0", [R_P]),
    "SkinCole": ("R0-p(R1,CPE1)", [R_S, R_P, TAU**ALPHA / R_P, ALPHA]),
    "SkinLayers": ("R0-p(R1,C1)-p(R2,C2)", [R_S, 70.0, 0.3, 30.0, 4.0]),
}


def criterion(name, f, z, sigma):
    """BIC of one circuit; real and imaginary part of the noise have half the variance each."""
    circuit, start = CIRCUITS[name]
    model = CustomCircuit(circuit, initial_guess=list(start))
    try:
        model.fit(f, z, sigma=np.tile(sigma, 2), **ENOUGH)
        residual = np.abs(model.predict(f) - z) / sigma
    except Exception:  # anything the package may raise
        return np.inf
    return 2 * np.sum(residual**2) + len(start) * np.log(2 * z.size)


def solved(problem):
    f, z, sigma = problem["f"] / MEGA, problem["z"] / KILO, problem["sigma"] / KILO
    found, seconds = np.full((len(z), len(CIRCUITS)), np.inf), np.zeros(len(z))
    criterion("Resistor", f, z[0], sigma[0])  # what a first call costs is not counted
    for row, (one, spread, of) in enumerate(zip(z, sigma, problem["used"], strict=True)):
        begin = time.perf_counter()
        for column, name in enumerate(CIRCUITS):
            found[row, column] = criterion(name, f[of], one[of], spread[of])
        seconds[row] = time.perf_counter() - begin
    return {"bic": found, "seconds": seconds}


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of trial steps; what comes of them is judged
    serve(solved)
