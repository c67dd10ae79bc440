"""jax-sysid's `LinearModel` of one state, from current to voltage: L-BFGS, without its penalties.

Z_th is that of the calibration's harmonics, and the record one averaged period. Every fit compiles
its loss anew.
"""

import jax
import numpy as np
from jax_sysid.models import (  # pyright: ignore[reportMissingImports]  # in its own environment
    LinearModel,
)

from benchmarks.rivals.records import current_and_voltage, elements, harmonics

jax.config.update("jax_enable_x64", True)


def skin(v_th, v_out, model, start, fs, f0):
    """Elements; jax-sysid says nothing of success."""
    of = current_and_voltage(harmonics(v_th, v_out, fs, f0), model)
    linear = LinearModel(nx=1, ny=1, nu=1, feedthrough=True, sigma=0.9)
    linear.loss(rho_x0=0.0, rho_th=0.0)
    linear.optimization(adam_epochs=0, lbfgs_epochs=500, iprint=-1)
    linear.fit(of.voltage[:, None], of.current[:, None])
    a, b, c, d = (float(np.squeeze(matrix)) for matrix in linear.ssdata())
    return elements(d, c * b - a * d, -a, of), True
