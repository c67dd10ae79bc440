"""A load whose resistance falls with its own voltage."""

import dataclasses
import math

import numpy as np
from jaxtyping import Complex, Float

from etid.simulation.transformer import Impedance, TransformerDriver

ROUNDS = 60  # of a fixed point that gains a factor of 1.5 at least
STILL = 1e-12  # of the current; it changes no digit of a record


@dataclasses.dataclass(frozen=True)
class FallingResistance:
    """A resistor R ‖ C, which falls with the voltage v across it, in series with another load.

    R(v) = R / (1 + k (v / v₀)²), v₀ the peak of v, so that R is (1 − fall) R there. The current
    that it takes in excess of v / R is a source beside the linear circuit, a fixed point of

        V = Z (I − I_excess),   I = (V_th + Z I_excess) / (Z_th + Z_rest + Z).

    Z = R / (1 + s R C) is the impedance of the resistor at small voltages.

    Args:
        r: R [ohm] at small voltages.
        c: C [F].
        rest: The other load.
        fall: Part of R that is lost at the peak of v.
    """

    r: float
    c: float
    rest: Impedance
    fall: float

    def voltage(
        self, driver: TransformerDriver, f: Float[np.ndarray, " f"]
    ) -> Complex[np.ndarray, " f"]:
        """Fourier coefficients of the terminal voltage behind a driver.

        Args:
            driver: The driver.
            f: All harmonics of the pulse rate up to some frequency [Hz].

        Returns:
            The coefficients [V].
        """
        pulse_rate, f = f[0], np.concatenate([[0.0], f])
        z_th, z = driver.z_th(f), self.r / (1 + 2j * np.pi * f * self.r * self.c)
        total = z_th + self.rest(f) + z
        v_th = pulse_rate * driver.v_th_spectrum(f)  # 0 at 0 Hz, as of any transformer
        grid = 2 ** math.ceil(math.log2(2 * f.size))
        curve, excess = self.fall / (1 - self.fall), np.zeros(f.size, complex)
        for _ in range(ROUNDS):
            current = (v_th + z * excess) / total
            v = np.fft.irfft(z * (current - excess), grid, norm="forward")
            more = curve * (v / np.abs(v).max()) ** 2 * v / self.r
            before, excess = excess, np.fft.rfft(more, norm="forward")[: f.size]
            if np.abs(excess - before).max() <= STILL * np.abs(current).max():
                break
        return (v_th - z_th * (v_th + z * excess) / total)[1:]
