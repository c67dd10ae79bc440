"""What the rivals do with a record before their package sees it.

    Y = X Z_L / (Z_L + Z_th) e^(−jωτ),   X, Y: Fourier coefficients of V_th, V_out

NumPy alone, nothing of etid: rivals run in environments that do not have it.
"""

import math
from typing import NamedTuple

import numpy as np

VISIBLE = 10.0  # power of a coefficient over that of its noise, below which an impedance is no use
ALIASED = 0.35  # of the sample rate: above, aliases disturb records of which each period is alike
MEGA, KILO, NANO = 1e6, 1e3, 1e-9
MICROSECOND = 1e-6  # unit of a delay, so that all unknowns are of one order
# [Hz] at least, of records of current and voltage: at 1 MHz the C_p of a first-order Z(z) is 0.1 %
# (output error) to 0.4 % (equation error) off, at 200 kHz 1.3 to 6.9 %.
RATE = 1e6


class Harmonics(NamedTuple):
    """Coefficients at the multiples of the pulse rate."""

    f: np.ndarray  # frequencies [Hz]
    x: np.ndarray  # coefficients of V_th [V]
    y: np.ndarray  # coefficients of V_out [V]
    sigma: float  # standard deviation √E|noise|² of a coefficient [V], taken to be that of both

    @property
    def visible(self) -> np.ndarray:
        """Where noise hides neither X, nor Y, nor X − Y."""
        least = np.min(np.abs([self.x, self.y, self.x - self.y]), axis=0)
        return least**2 > VISIBLE * self.sigma**2


def harmonics(v_th: np.ndarray, v_out: np.ndarray, fs: float, f0: float) -> Harmonics:
    """Coefficients (1/M) Σ v[n] e^(−j2πkPn/M), k ≥ 1, of P periods in M samples, and their noise.

    What lies between the harmonics is noise. A single period has nothing between them: the last
    tenth of its band is taken for noise, where an anti-alias filter leaves least.
    """
    periods = int((v_th.size + 0.5) * f0 / fs)
    samples = min(v_th.size, round(periods * fs / f0))
    spectra = np.fft.rfft(np.stack([v_th, v_out])[:, :samples])[:, 1 : (samples + 1) // 2] / samples
    bins = np.arange(1, spectra.shape[1] + 1)
    of_pulse = bins % periods == 0
    noise = spectra[:, ~of_pulse if periods > 1 else bins > 0.9 * bins.size]
    sigma = math.sqrt(np.median(np.abs(noise) ** 2) / math.log(2))  # powers are exponential
    if samples % periods == 0:
        of_pulse &= bins < ALIASED * samples
    x, y = spectra[:, of_pulse]
    return Harmonics(bins[of_pulse] * fs / samples, x, y, sigma)


def measured_driver(
    v_th: np.ndarray, v_out: np.ndarray, r_load: float, fs: float, f0: float
) -> np.ndarray:
    """Z_th = R_L (X − Y) / Y at every harmonic of a calibration [ohm]; NaN where noise hides it."""
    of = harmonics(v_th, v_out, fs, f0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(of.visible, r_load * (of.x - of.y) / of.y, np.nan)


def load_impedance(of: Harmonics, z_th: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies [Hz], impedances Z_L = Z_th Y / (X − Y) [ohm], and their standard deviations.

    Z_th is NaN where it is not known.
    """
    use = of.visible & np.isfinite(z_th)
    f, x, y, z_th = of.f[use], of.x[use], of.y[use], z_th[use]
    spread = np.hypot(np.abs(x), np.abs(y)) * of.sigma / np.abs(x - y) ** 2
    return f, z_th * y / (x - y), np.abs(z_th) * spread


class Period(NamedTuple):
    """One averaged period of what the skin sees, for packages that take an input and an output."""

    current: np.ndarray  # over its largest value
    voltage: np.ndarray  # over its largest value
    unit: float  # ratio of these two values, the impedance that is 1 then [ohm]
    fs: float  # samples per second [Hz]


def current_and_voltage(of: Harmonics, z_th: np.ndarray, delay: float = 0.0) -> Period:
    """The skin's current, (X − Y) / Z_th, and voltage, Y, as one period; V_th is `delay` [µs] late.

    Only harmonics that noise leaves visible take part, and the period is sampled at `RATE` at
    least: so is noise kept out, and the error of a discrete-time model of the skin small.
    """
    use = of.visible & np.isfinite(z_th)
    x = of.x[use] * np.exp(-2j * np.pi * MICROSECOND * delay * of.f[use])
    f0 = of.f[0]
    samples = max(round(RATE / f0), 2 * of.f.size + 2)
    spectra = np.zeros((2, samples // 2 + 1), complex)
    number = np.flatnonzero(use) + 1
    spectra[:, number] = (x - of.y[use]) / z_th[use], of.y[use]
    current, voltage = np.fft.irfft(spectra, samples)
    most = np.abs(current).max(), np.abs(voltage).max()
    return Period(current / most[0], voltage / most[1], most[1] / most[0], samples * f0)


def elements(b_0: float, b_1: float, a_1: float, of: Period) -> np.ndarray:
    """R_s, R_p [ohm] and C_p [F] of Z(z) = (b_0 + b_1 z⁻¹) / (1 + a_1 z⁻¹), as Tustin maps them.

    R_s = Z(−1), R_s + R_p = Z(1), R_p C_p = (1 − a_1) / (1 + a_1) / (2 fs).
    """
    r_s, r = of.unit * (b_0 - b_1) / (1 - a_1), of.unit * (b_0 + b_1) / (1 + a_1)
    return np.array([r_s, r - r_s, (1 - a_1) / (1 + a_1) / (2 * of.fs) / (r - r_s)])
