"""fastcan's `NARX` of first degree, from current to voltage: v[k] by i[k], i[k−1] and v[k−1].

The least squares of its free run, from those of one step ahead. Z_th is that of the calibration's
harmonics, and the record one averaged period.
"""

import numpy as np
from fastcan.narx import NARX  # pyright: ignore[reportMissingImports]  # in its own environment

from benchmarks.rivals.records import current_and_voltage, elements, harmonics


def skin(v_th, v_out, model, start, fs, f0):
    """Elements; fastcan says nothing of success."""
    of = current_and_voltage(harmonics(v_th, v_out, fs, f0), model)
    narx = NARX(feat_ids=[[0], [0], [1]], delay_ids=[[0], [1], [1]], fit_intercept=False)
    narx.fit(of.current[:, None], of.voltage, coef_init="one_step_ahead")
    b_0, b_1, minus_a_1 = narx.coef_
    return elements(b_0, b_1, -minus_a_1, of), bool(np.isfinite(narx.coef_).all())
