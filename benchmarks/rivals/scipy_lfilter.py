"""SciPy `lfilter` and `least_squares`: V_out as a filter predicts it from the current.

The skin by Tustin's rule, and a delay of V_th. Z_th is that of the calibration's harmonics, and the
record one averaged period. To predict V_out from V_th, with Z_th as a filter of order 5, is no
better: at 200 kHz without noise the driver took a minute, and R_s was 12 % too much.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import bilinear, lfilter, lfilter_zi

from benchmarks.rivals.records import current_and_voltage, harmonics

CALLS = 1000  # of the residuals


def skin(v_th, v_out, model, start, fs, f0):
    """Elements, and whether SciPy says that it converged."""
    spectra = harmonics(v_th, v_out, fs, f0)

    def misfit(q):
        of = current_and_voltage(spectra, model, q[3])
        r_s, r_p, c_p = np.exp(q[:3])
        b, a = bilinear([r_s * r_p * c_p, r_s + r_p], [r_p * c_p, 1.0], of.fs)
        b = b / of.unit
        predicted, _ = lfilter(b, a, of.current, zi=of.current[0] * lfilter_zi(b, a))
        return predicted - of.voltage

    q = np.append(np.log(start), 0.0)
    fit = least_squares(misfit, q, method="lm", x_scale="jac", max_nfev=CALLS)
    return np.exp(fit.x[:3]), fit.success
