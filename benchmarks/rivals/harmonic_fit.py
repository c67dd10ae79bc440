"""Least squares on the harmonics, for the packages that minimise any residual one writes.

Both records are noisy, the delay between them is unknown, and Z_th is a sum of five poles. A rival
gives `fit(misfit, start, arguments)`, which minimises |misfit(q, *arguments)|² from q = start and
returns q and whether its package calls that a success. What has the argument `numpy` takes
`jax.numpy` as well.
"""

import numpy as np

from benchmarks.rivals.records import MICROSECOND, harmonics

DELAY_WIDTH = 2.5  # [µs], of the weak prior of a calibration's delay
GAIN_WIDTH = 5.0  # [R_L], of the weak prior of the gains of Z_th
# Poles to start from [Hz]: a transformer of this size rings at some tens of kHz; a section below,
# near or above it; its magnetising inductance is slow. The fit with the smallest misfit is taken.
RESONANCE, SLOW, OTHERS = 50e3, 30.0, (5e3, 20e3, 150e3)


def driver(fit, v_th, v_out, r_load, fs, f0):
    """Z_th at the harmonics of a calibration [ohm], by the best of several starts."""
    of = harmonics(v_th, v_out, fs, f0)
    found = [fit(driver_misfit, start, of)[0] for start in driver_starts(of)]
    misfits = [np.sum(driver_misfit(q, *of) ** 2) for q in found]
    return r_load * source_impedance(found[int(np.nanargmin(misfits))], of.f)


def skin(fit, v_th, v_out, z_th, start, fs, f0):
    """Elements [ohm, ohm, F], and whether the package calls them a success."""
    of = harmonics(v_th, v_out, fs, f0)
    q, ok = fit(skin_misfit, np.append(np.log(start), 0.0), (*of, z_th))
    return np.exp(q[:3]), ok


def skin_misfit(q, f, x, y, sigma, z_th, numpy=np):
    """Residuals (Y − G X) / (σ √(1 + |G|²)), real parts before imaginary ones: both are noisy.

    q holds the logarithms of R_s, R_p [ohm] and C_p [F], and the delay [µs].
    """
    s = 2j * np.pi * f
    r_s, r_p, c_p = numpy.exp(q[0]), numpy.exp(q[1]), numpy.exp(q[2])
    z = r_s + r_p / (1 + s * r_p * c_p)
    return _misfit(z / (z + z_th), q[3], f, x, y, sigma, numpy)


def source_impedance(q, f, numpy=np):
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


def driver_misfit(q, f, x, y, sigma, numpy=np):
    """The same of a calibration, and weak priors; q as in `source_impedance`, and the delay."""
    gain = 1 / (1 + source_impedance(q, f, numpy))
    priors = numpy.stack([q[11] / DELAY_WIDTH, q[3] / GAIN_WIDTH, q[7] / GAIN_WIDTH])
    return numpy.concatenate([_misfit(gain, q[11], f, x, y, sigma, numpy), priors])


def driver_starts(of):
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


def _misfit(gain, delay, f, x, y, sigma, numpy):
    turned = gain * numpy.exp(-2j * np.pi * MICROSECOND * f * delay)
    e = (y - turned * x) / (sigma * numpy.sqrt(1 + numpy.abs(gain) ** 2))
    return numpy.concatenate([e.real, e.imag])
