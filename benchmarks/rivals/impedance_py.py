"""impedance.py's `CustomCircuit` on the spectrum Z_L = Z_th Y / (X − Y), Z_th as measured.

In MHz, kΩ and nF, and weighted by the noise of each impedance: in SI units and without weights it
stops early and says nothing. A spectrum that is measured directly has no trigger delay, and there
is no element for one.
"""

import numpy as np
from impedance.models.circuits import (  # pyright: ignore[reportMissingImports]  # see lmfit_leastsq
    CustomCircuit,
)

from benchmarks.rivals.records import KILO, MEGA, NANO, harmonics, load_impedance


def skin(v_th, v_out, model, start, fs, f0):
    """Elements; impedance.py says nothing of success, and raises where SciPy gives up."""
    f, z, spread = load_impedance(harmonics(v_th, v_out, fs, f0), model)
    units = np.array([KILO, KILO, NANO])
    circuit = CustomCircuit("R0-p(R1,C1)", initial_guess=list(start / units))
    circuit.fit(f / MEGA, z / KILO, sigma=np.tile(spread / KILO, 2))
    return circuit.parameters_ * units, True
