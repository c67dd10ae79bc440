"""Whether a driver has changed: its unloaded voltage differs from that of the calibration.

A change of Z_th affects Y/X like a change of the load. If a resistor in the driver grows by 5 %,
R_p of dry skin is wrong by 63 standard errors at 60 dB, and χ² is 1. But the parts of Z_th also
shape V_th, without any skin. The harmonics of two unloaded records of an unchanged driver differ
only by an amplitude a and a delay τ,

    X_k = a e^(−jω_k τ) X⁰_k (1 + δ_k),      δ = 0.

If a part has changed, δ is smooth in frequency; here `DEGREE` complex polynomials of log f. Another
pulse, for example a longer one, has other
zeros, and its δ is not smooth. It tells nothing about the driver and is no fault.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.likelihood.noise import excess
from etid.likelihood.profile import Records
from etid.likelihood.transient import disturbances
from etid.precision import array_function, namespace
from etid.results.driver import HarmonicDriver
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.transfer import AnyArray, as_complex, power, turns

DEGREE = 6  # polynomials of δ; its real part has no constant, because that is the amplitude
FIRST = 6  # first harmonics, which are not used because of hum and drift
SIGNAL = 0.9  # smallest share of signal in the power around a harmonic that is used
# Difference that the drift of a driver makes, relative to the drift. It is three times the standard
# deviation by an inductance, which has the largest effect.
DRIFT = 0.2
SEEN = 37.37  # χ² that all directions exceed by chance once in 10 000
SIZE = 1.5e-4  # smallest difference relative to V_th; pulses repeat no better than this
OTHER = 0.1  # difference relative to V_th of another pulse; doubling a part has less effect
SMOOTH = 1 / 3  # part of the difference that must be smooth
# Relative difference of pulse rates. Records of other lengths are cut to other whole samples. This
# moves the zeros of a pulse at its thousandth harmonic as much as a part that has changed.
SAME_FREQUENCY = 1e-6


class UnloadedShape(NamedTuple):
    """The unloaded voltage of a calibration.

    Attributes:
        frequency: Harmonics [Hz].
        x: Fourier coefficients [V]; 0 where they are not used.
        variance: E|noise|² of each coefficient [V²].
        directions: Orthonormal directions in which δ changes `x`, orthogonal to amplitude and
            delay, and to hum and wander of records that are not whole periods; first the real
            parts, then the imaginary parts.
        bias: Bias along each direction [V]. It arises because the directions contain the noise of
            `x` too.
        drift: Difference that the drift of the driver makes, relative to V_th.
    """

    frequency: Float[AnyArray, " harmonic"]
    x: Complex[AnyArray, " harmonic"]
    variance: Float[AnyArray, " harmonic"]
    directions: Float[AnyArray, "direction part"]
    bias: Float[AnyArray, " direction"]
    drift: Float[AnyArray, ""]


@array_function
def shape(spectrum: Spectrum, drift: Float[AnyArray, ""] | None = None) -> UnloadedShape:
    """The unloaded voltage of a calibration whose driver has this drift."""
    xp, f, size = namespace(spectrum.x), spectrum.frequency, spectrum.x.shape[0]
    clear = signal_share(spectrum.x, spectrum.variance_x) > SIGNAL
    used = spectrum.selected & clear & (np.arange(size) >= FIRST)
    x = xp.where(used, spectrum.x, 0)
    u = 2 * xp.log(f / f[0]) / xp.log(f[-1] / f[0]) - 1
    smooth = xp.stack([xp.cos(n * xp.arccos(xp.clip(u, -1, 1))) for n in range(DEGREE)])
    by_delta = smooth * x
    by_delay = 1j * x * f / f[-1]
    free = [x[None], by_delay[None]]
    if not spectrum.whole:
        free.append(xp.where(used, disturbances(size, f[0]), 0.0))
    free = xp.concatenate(free)
    rows = xp.concatenate([free, by_delta[1:], by_delta * 1j])
    real = xp.concatenate([rows.real, rows.imag], axis=1)
    directions = xp.linalg.qr(real.T)[0].T[free.shape[0] :]
    # Σ Re (q/x)* σ²: a direction q is x times a function of frequency; the difference contains −x.
    share = xp.where(used, spectrum.variance_x / xp.where(used, power(x), 1.0), 0.0)
    bias = directions @ (xp.concatenate([x.real, x.imag]) * xp.tile(share, 2))
    made = xp.asarray(DRIFT * (0.0 if drift is None else drift))
    return UnloadedShape(f, x, spectrum.variance_x, directions, bias, made)


def shape_of(
    driver: HarmonicDriver, frequency: Float[AnyArray, " harmonic"]
) -> UnloadedShape | None:
    """The unloaded voltage of the first calibration of a driver, for loads of these harmonics [Hz].

    None if the driver has another number of harmonics than the loads.
    """
    if driver.spectra.x.shape[1:] != frequency.shape:
        return None
    return shape(jax.tree.map(lambda leaf: leaf[0], driver.spectra), driver.drift)


@array_function
def differs(shape: UnloadedShape, records: Records) -> Bool[AnyArray, "*row"]:
    """Whether the unloaded voltages of recordings show that the driver has changed.

    `shape` is the unloaded voltage of a calibration.
    """
    xp = namespace(records.x)
    known = xp.where(records.used[..., 0, :], shape.x, 0)
    here = known != 0
    count = known.shape[-1]
    number = np.arange(1.0, count + 1)
    squares = power(known)
    total = squares.sum(-1)
    found = xp.where(here, records.x, 0)
    product = found * xp.conj(known)
    angle = xp.angle((product[..., 1:] * xp.conj(product[..., :-1])).sum(-1))
    aligned = found * turns(-angle / (2 * np.pi), count)  # to a tenth of a sample
    late = (number * (aligned * xp.conj(known)).imag).sum(-1)
    angle = angle + late / (number**2 * squares).sum(-1)
    aligned = found * turns(-angle / (2 * np.pi), count)
    amplitude = (aligned * xp.conj(known)).real.sum(-1) / total
    variance = records.variance_x + amplitude[..., None] ** 2 * shape.variance
    scale = xp.sqrt(2 / xp.where(here, variance, 0.0).max(-1))
    rest = (aligned - as_complex(amplitude)[..., None] * known) * as_complex(scale)[..., None]
    part = xp.concatenate([rest.real, rest.imag], -1)
    along = part @ shape.directions.T + (amplitude * scale)[..., None] * shape.bias
    smooth, whole = (along**2).sum(-1), (part**2).sum(-1)
    size = xp.sqrt(smooth) / (scale * xp.abs(amplitude) * xp.sqrt(total))
    same = xp.abs(records.frequency[..., 0] / shape.frequency[0] - 1) < SAME_FREQUENCY
    of_chance = 2.0 * here.sum(-1)
    large = (size > SIZE) & (size < OTHER) & (smooth > SMOOTH * (whole - of_chance))
    beyond = xp.maximum(1 - shape.drift / size, 0.0)  # part that no stated drift explains
    another = whole > of_chance / 2  # otherwise both are the same record
    seen = same & large & another & (beyond**2 * smooth > SEEN)
    if xp is np and not seen.any():
        return seen
    left = part - along @ shape.directions  # in its own noise, which is at least 1
    of_each = 0.5 * (left[..., :count] ** 2 + left[..., count:] ** 2)
    noise = excess(of_each, here)
    noise = xp.concatenate([noise, noise], -1)
    sure = ((beyond[..., None] * along) ** 2 / (noise @ (shape.directions**2).T)).sum(-1)
    return seen & (sure > SEEN)
