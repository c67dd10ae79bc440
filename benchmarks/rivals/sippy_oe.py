"""SIPPY's output-error model of first order, from current to voltage.

The package is `sippy_unipi`; the one called `sippy` does telephony.
It lets no input act at once: the input is advanced by a sample. Z_th is that of the calibration's
harmonics, and the record one averaged period.
"""

import contextlib
import io

import numpy as np
from sippy_unipi import (  # pyright: ignore[reportMissingImports]  # in its own environment
    system_identification,
)

from benchmarks.rivals.records import current_and_voltage, elements, harmonics


def skin(v_th, v_out, model, start, fs, f0):
    """Elements; SIPPY returns no verdict of its solver."""
    of = current_and_voltage(harmonics(v_th, v_out, fs, f0), model)
    advanced = np.roll(of.current, -1)
    with contextlib.redirect_stdout(io.StringIO()):
        found = system_identification(of.voltage, advanced, "OE", OE_orders=[2, 1, 0])
    b_0, b_1 = found.NUMERATOR[0][0][:2]
    return elements(b_0, b_1, found.DENOMINATOR[0][0][1], of), True
