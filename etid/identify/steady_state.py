"""The terminal voltage of a whole number of periods, for loads that no filter describes.

A record of whole periods is a sum of its Fourier coefficients, and the load acts on each as it is:
Y = G X, G = Z_L / (Z_L + Z_th). A constant phase, which has no finite filter, needs no other.
"""

import numpy as np
from jaxtyping import Complex, Float

ITERATIONS = 3  # of two delays of a hundredth of a sample: the first leaves 1e-4 of them
BAND = 0.4  # of the sample rate; beyond it anti-alias filters leave noise and aliases


def periodic_voltage(
    v_th: Float[np.ndarray, " time"],
    v_out: Float[np.ndarray, " time"],
    sample_rate: float,
    z_th: Complex[np.ndarray, " frequency"],
    z_load: Complex[np.ndarray, " frequency"],
    r_load: float,
) -> Float[np.ndarray, " time"]:
    """Terminal voltage [V] with a load, as far as a record tells.

    Offset, delay and the delay of the calibration are fitted, the last by its excess impedance
    (`prediction.late_calibration`).

    Args:
        v_th: Unloaded voltage [V], a whole number of periods.
        v_out: Loaded voltage [V].
        sample_rate: Samples per second [Hz].
        z_th: Source impedance [Ω] at `np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]`.
        z_load: The load there [Ω].
        r_load: Resistor of the calibration [Ω].
    """
    f = np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]
    samples = 2j * np.pi * f / sample_rate  # s, per sample
    x, y = np.fft.rfft(v_th)[1:], np.fft.rfft(v_out)[1:]
    excess = samples * (r_load - z_load)
    used = f < BAND * sample_rate
    own = late = 0.0
    for _ in range(ITERATIONS):
        total = z_load + z_th + late * excess
        predicted = x * z_load / total * np.exp(-samples * own)
        slopes = np.stack([-samples * predicted, -excess / total * predicted], axis=1)[used]
        rest = (y - predicted)[used]
        matrix = np.concatenate([slopes.real, slopes.imag])
        step = np.linalg.lstsq(matrix, np.concatenate([rest.real, rest.imag]))[0]
        own, late = own + step[0], late + step[1]
    predicted = x * z_load / (z_load + z_th + late * excess) * np.exp(-samples * own)
    mean = v_out.sum()  # the coefficient of frequency 0: the offset is fitted
    return np.fft.irfft(np.append(mean, predicted), v_th.size)
