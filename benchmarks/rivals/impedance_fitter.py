"""ImpedanceFitter's circuit model on the spectrum Z_L = Z_th Y / (X − Y), Z_th as measured.

In rad/µs, kΩ and nF, weighted by the noise of each impedance through the lmfit model that
ImpedanceFitter makes: its own schemes know the modulus alone. No element is a trigger delay.
"""

import impedancefitter  # pyright: ignore[reportMissingImports]  # in its own environment
import numpy as np

from benchmarks.rivals.records import KILO, MEGA, NANO, harmonics, load_impedance

NAMES = ("series_R", "skin_R", "skin_C")
impedancefitter.set_logger("WARNING")


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether the lmfit beneath says that it succeeded."""
    f, z, spread = load_impedance(harmonics(v_th, v_out, fs, f0), model)
    units = np.array([KILO, KILO, NANO])
    circuit = impedancefitter.get_equivalent_circuit_model("R_series + parallel(R_skin, C_skin)")
    unknown = circuit.make_params(**dict(zip(NAMES, start / units, strict=True)))
    for name in NAMES:
        unknown[name].min = 0.0
    omega = 2 * np.pi * f / MEGA
    fit = circuit.fit(z / KILO, unknown, omega=omega, weights=KILO / spread)
    return units * [fit.best_values[name] for name in NAMES], fit.success
