"""SciPy `least_squares` (MINPACK) on the harmonics: errors in both records, delays fitted."""

import numpy as np
from scipy.optimize import least_squares

from benchmarks.rivals.records import (
    driver_misfit,
    driver_starts,
    harmonics,
    skin_misfit,
    source_impedance,
)


def driver(v_th, v_out, r_load, fs, f0):
    """Parameters of Z_th of order 5, and R_L."""
    of = harmonics(v_th, v_out, fs, f0)
    fits = [
        least_squares(driver_misfit, start, args=of, method="lm", x_scale="jac", max_nfev=4000)
        for start in driver_starts(of)
    ]
    return min(fits, key=lambda fit: fit.cost).x, r_load


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether SciPy says that it converged."""
    q, r_load = model
    of = harmonics(v_th, v_out, fs, f0)
    z_th = r_load * source_impedance(q, of.f)
    q_0 = np.append(np.log(start), 0.0)
    fit = least_squares(skin_misfit, q_0, args=(*of, z_th), method="lm", x_scale="jac")
    return np.exp(fit.x[:3]), fit.success
