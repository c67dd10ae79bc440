"""What the rivals do with a record before their package sees it, and the residuals they minimise.

    Y = X Z_L / (Z_L + Z_th) e^(−jωτ),   X, Y: Fourier coefficients of V_th, V_out

NumPy alone, nothing of etid: rivals run in environments that do not have it. What has the argument
`numpy` takes `jax.numpy` as well.
"""

import math
from typing import Any, NamedTuple

import numpy as np

VISIBLE = 10.0  # power of a coefficient over that of its noise, below which an impedance is no use
ALIASED = 0.35  # of the sample rate: above, aliases disturb records of which each period is alike
MICROSECOND = 1e-6  # unit of a delay, so that all unknowns are of one order
DELAY_WIDTH = 2.5  # [µs], of the weak prior of a calibration's delay
GAIN_WIDTH = 5.0  # [R_L], of the weak prior of the gains of Z_th
# Poles to start from [Hz]: a transformer of this size rings at some tens of kHz; a resonance above
# or below it; its magnetising inductance is slow. The fit with the smaller misfit is taken.
RESONANCE, SLOW, OTHERS = 50e3, 30.0, (5e3, 20e3, 150e3)


class Harmonics(NamedTuple):
    """Coefficients at the multiples of the pulse rate.

    Attributes:
        f: Frequencies [Hz].
        x: Coefficients of V_th [V].
        y: Coefficients of V_out [V].
        sigma: Standard deviation √E|noise|² of a coefficient [V], taken to be that of both.
    """

    f: np.ndarray
    x: np.ndarray
    y: np.ndarray
    sigma: float

    @property
    def visible(self) -> np.ndarray:
        """Where noise hides neither X, nor Y, nor X − Y."""
        least = np.min(np.abs([self.x, self.y, self.x - self.y]), axis=0)
        return least**2 > VISIBLE * self.sigma**2


def whole_periods(samples: int, fs: float, f0: float) -> tuple[int, int]:
    """How many periods a record holds, and the samples nearest to them."""
    periods = int((samples + 0.5) * f0 / fs)
    return periods, min(samples, round(periods * fs / f0))


def harmonics(v_th: np.ndarray, v_out: np.ndarray, fs: float, f0: float) -> Harmonics:
    """Coefficients (1/M) Σ v[n] e^(−j2πkPn/M), k ≥ 1, of P periods in M samples, and their noise.

    What lies between the harmonics is noise. A single period has nothing between them: the last
    tenth of its band is taken for noise, where an anti-alias filter leaves least.
    """
    periods, samples = whole_periods(v_th.size, fs, f0)
    spectra = np.fft.rfft(np.stack([v_th, v_out])[:, :samples])[:, 1 : (samples + 1) // 2] / samples
    bins = np.arange(1, spectra.shape[1] + 1)
    of_pulse = bins % periods == 0
    noise = spectra[:, ~of_pulse if periods > 1 else bins > 0.9 * bins.size]
    sigma = math.sqrt(np.median(np.abs(noise) ** 2) / math.log(2))  # powers are exponential
    if samples % periods == 0:
        of_pulse &= bins < ALIASED * samples
    x, y = spectra[:, of_pulse]
    return Harmonics(bins[of_pulse] * fs / samples, x, y, sigma)


def driver_impedance(of: Harmonics, r_load: float) -> np.ndarray:
    """Z_th = R_L (X − Y) / Y at every harmonic [ohm]; NaN where noise hides it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(of.visible, r_load * (of.x - of.y) / of.y, np.nan)


def load_impedance(of: Harmonics, z_th: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spectrum of a load where it and Z_th are known.

    Z_L = Z_th Y / (X − Y), and what the noise of X and Y is in it.

    Args:
        of: Harmonics of the load's records.
        z_th: Source impedance [ohm] at these; NaN where it is not known.

    Returns:
        Frequencies [Hz], impedances [ohm] and their standard deviations [ohm].
    """
    use = of.visible & np.isfinite(z_th)
    f, x, y, z_th = of.f[use], of.x[use], of.y[use], z_th[use]
    spread = np.hypot(np.abs(x), np.abs(y)) * of.sigma / np.abs(x - y) ** 2
    return f, z_th * y / (x - y), np.abs(z_th) * spread


def skin_misfit(q: Any, f: Any, x: Any, y: Any, sigma: Any, z_th: Any, numpy: Any = np) -> Any:
    """Residuals (Y − G X) / (σ √(1 + |G|²)), real parts before imaginary ones: both are noisy.

    Args:
        q: Logarithms of R_s, R_p [ohm] and C_p [F], and the delay [µs].
        f: Frequencies [Hz].
        x: Coefficients of V_th [V].
        y: Coefficients of V_out [V].
        sigma: Their noise [V].
        z_th: Source impedance [ohm].
        numpy: The namespace to compute in.
    """
    s = 2j * np.pi * f
    r_s, r_p, c_p = numpy.exp(q[0]), numpy.exp(q[1]), numpy.exp(q[2])
    z = r_s + r_p / (1 + s * r_p * c_p)
    return _misfit(z / (z + z_th), q[3], f, x, y, sigma, numpy)


def source_impedance(q: Any, f: Any, numpy: Any = np) -> Any:
    """Z_th / R_L of order 5: a resistor, two sections of second order and a slow pole.

    e^q0 + Σ_k (g_k + h_k s/ω_k) / (1 + 2 ζ_k s/ω_k + (s/ω_k)²) + g / (1 + s/ω), where q holds
    ln ω, ln ζ, g, h of each section and ln ω, g of the pole.
    """
    s = 2j * np.pi * f
    z = numpy.exp(q[0]) + q[10] / (1 + s / numpy.exp(q[9]))
    for k in (1, 5):
        u = s / numpy.exp(q[k])
        z = z + (q[k + 2] + q[k + 3] * u) / (1 + (2 * numpy.exp(q[k + 1]) + u) * u)
    return z


def driver_misfit(q: Any, f: Any, x: Any, y: Any, sigma: Any, numpy: Any = np) -> Any:
    """The same of a calibration, and weak priors; q as in `source_impedance`, and the delay."""
    gain = 1 / (1 + source_impedance(q, f, numpy))
    priors = numpy.stack([q[11] / DELAY_WIDTH, q[3] / GAIN_WIDTH, q[7] / GAIN_WIDTH])
    return numpy.concatenate([_misfit(gain, q[11], f, x, y, sigma, numpy), priors])


def driver_starts(of: Harmonics) -> list[np.ndarray]:
    """Generic poles, and the gains that then fit a calibration best, Y Z_th / R_L = X − Y."""
    starts = []
    for other in OTHERS:
        q = np.zeros(12)
        q[[1, 5, 9]] = np.log(2 * np.pi * np.array([RESONANCE, other, SLOW]))
        q[2] = np.log(0.5)  # damping of the resonance; the other section is critically damped
        columns = []
        for unknown in (3, 4, 7, 8, 10):
            one = q.copy()
            one[unknown] = 1.0
            columns.append(source_impedance(one, of.f) - 1)  # e^q0 = 1
        lines = of.y**2 / of.x * np.stack([np.ones(of.f.size), *columns])  # by |1 + Z|, as Y is
        aims = (of.x - of.y) * of.y / of.x
        lines, aims = np.hstack([lines.real, lines.imag]).T, np.hstack([aims.real, aims.imag])
        gains = np.linalg.lstsq(lines, aims, rcond=1e-8)[0]
        q[0] = np.log(max(gains[0], 0.03))
        q[[3, 4, 7, 8, 10]] = gains[1:]
        starts.append(q)
    return starts


def _misfit(gain: Any, delay: Any, f: Any, x: Any, y: Any, sigma: Any, numpy: Any) -> Any:
    turned = gain * numpy.exp(-2j * np.pi * MICROSECOND * f * delay)
    e = (y - turned * x) / (sigma * numpy.sqrt(1 + numpy.abs(gain) ** 2))
    return numpy.concatenate([e.real, e.imag])
