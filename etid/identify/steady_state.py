"""Terminal voltage over whole periods, for loads that no finite filter describes.

The Fourier coefficients describe a record of whole periods completely. The load acts on each
coefficient separately: Y = G X, G = Z_L / (Z_L + Z_th). This suffices for a constant phase, which
has no finite filter.
"""

import numpy as np
from jaxtyping import Complex, Float

ITERATIONS = 3  # for two delays of 0.01 samples; the first iteration leaves 1e-4 of them
BAND = 0.4  # of the sample rate; above it, anti-alias filters leave noise and aliases


def periodic_voltage(
    v_th: Float[np.ndarray, " time"],
    v_out: Float[np.ndarray, " time"],
    sample_rate: float,
    z_th: Complex[np.ndarray, " frequency"],
    z_load: Complex[np.ndarray, " frequency"],
    r_load: float,
) -> Float[np.ndarray, " time"]:
    """Terminal voltage [V] with a load, aligned with a record.

    The function fits the offset, the delay and the delay of the calibration. The delay of the
    calibration enters as an excess impedance (`prediction.late_calibration`).

    Args:
        v_th: Unloaded voltage [V], a whole number of periods.
        v_out: Loaded voltage [V].
        sample_rate: Samples per second [Hz].
        z_th: Source impedance [Ω] at `np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]`.
        z_load: Impedance of the load [Ω] at the same frequencies.
        r_load: Resistor of the calibration [Ω].
    """
    f = np.fft.rfftfreq(v_th.size, 1 / sample_rate)[1:]
    samples = 2j * np.pi * f / sample_rate  # s times the sample interval
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
