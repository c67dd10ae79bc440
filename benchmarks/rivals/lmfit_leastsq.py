"""lmfit's `minimize` (leastsq) on the harmonics: errors in both records, delays fitted."""

import numpy as np
from lmfit import (  # pyright: ignore[reportMissingImports]  # in its own environment
    Parameters,
    minimize,
)

from benchmarks.rivals.records import (
    driver_misfit,
    driver_starts,
    harmonics,
    skin_misfit,
    source_impedance,
)

# A fit of the driver needs some hundreds of calls; a trial step to NaN is one to reject.
SETTINGS = {"max_nfev": 4000, "nan_policy": "propagate"}


def driver(v_th, v_out, r_load, fs, f0):
    """Parameters of Z_th of order 5, and R_L."""
    of = harmonics(v_th, v_out, fs, f0)
    fits = []
    for start in driver_starts(of):
        unknown = Parameters()
        for i, value in enumerate(start):
            unknown.add(f"q_{i}", value=value)
        fits.append(minimize(_driver_misfit, unknown, args=of, **SETTINGS))
    best = min(fits, key=lambda fit: fit.chisqr)
    return _values(best.params), r_load


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether lmfit says that it succeeded."""
    q, r_load = model
    of = harmonics(v_th, v_out, fs, f0)
    z_th = r_load * source_impedance(q, of.f)
    unknown = Parameters()
    for name, value in zip(("log_r_s", "log_r_p", "log_c_p"), np.log(start), strict=True):
        unknown.add(name, value=value)
    unknown.add("delay", value=0.0)
    fit = minimize(_skin_misfit, unknown, args=(*of, z_th), **SETTINGS)
    return np.exp(_values(fit.params)[:3]), fit.success


def _values(parameters):
    return np.array([one.value for one in parameters.values()])


def _driver_misfit(parameters, *of):
    return driver_misfit(_values(parameters), *of)


def _skin_misfit(parameters, *of):
    return skin_misfit(_values(parameters), *of)
