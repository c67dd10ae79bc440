"""Test whether a driver has changed: its unloaded voltage differs from that of the calibration.

A change of Z_th affects Y/X like a change of the load. If a resistor in the driver grows by 5 %,
R_p of dry skin is wrong by 63 standard errors at 60 dB, and χ² is 1. But the parts of Z_th also
shape V_th, without any skin. The same resistor, with the capacitance of the cable behind it,
changes the edges by a thousandth. The harmonics of two unloaded records of an unchanged driver
differ only by an amplitude a and a delay τ,

    X_k = a e^(−jω_k τ) X⁰_k (1 + δ_k),      δ = 0.

If a part has changed, δ is smooth in frequency; here `DEGREE` complex polynomials of log f.
Another pulse, for example a longer one, has other zeros, and its δ is not smooth. It tells nothing
about the driver and is no fault.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.estimators.maximum_likelihood.profile import excess
from etid.likelihood.unloaded import OTHER, SAME_FREQUENCY, SEEN, SIZE, SMOOTH
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


class UnloadedShape(NamedTuple):
    """The unloaded voltage of a calibration.

    Attributes:
        frequency: Harmonics [Hz].
        x: Fourier coefficients [V]; 0 where they are not used.
        variance: E|noise|² of each coefficient [V²].
        directions: Orthonormal directions in which δ changes `x`, orthogonal to amplitude and
            delay; first the real parts, then the imaginary parts.
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

    def differs(self, spectrum: Spectrum) -> Bool[Array, ""]:
        """Whether the unloaded voltage of a recording shows that the driver has changed."""
        known = jnp.where(spectrum.selected, self.x, 0)
        number = jnp.arange(1.0, known.size + 1)
        total = jnp.sum(power(known))
        found = jnp.where(known != 0, spectrum.x, 0)
        product = found * jnp.conj(known)
        angle = jnp.angle(jnp.sum(product[1:] * jnp.conj(product[:-1])))
        aligned = found * turns(-angle / (2 * jnp.pi), known.size)  # to a tenth of a sample
        late = jnp.sum(number * (aligned * jnp.conj(known)).imag)
        angle = angle + late / jnp.sum(number**2 * power(known))
        aligned = found * turns(-angle / (2 * jnp.pi), known.size)
        amplitude = jnp.sum((aligned * jnp.conj(known)).real) / total
        variance = spectrum.variance_x + amplitude**2 * self.variance
        scale = jnp.sqrt(2 / jnp.max(jnp.where(known != 0, variance, 0.0)))
        rest = (aligned - as_complex(amplitude) * known) * as_complex(scale)
        part = jnp.concatenate([rest.real, rest.imag])
        along = self.directions @ part + amplitude * scale * self.bias
        smooth, all_of_it = jnp.sum(along**2), jnp.sum(part**2)
        level = scale * jnp.abs(amplitude) * jnp.sqrt(total)  # of V_th [standard deviations]
        size = jnp.sqrt(smooth) / level
        same = jnp.abs(spectrum.frequency[0] / self.frequency[0] - 1) < SAME_FREQUENCY
        of_chance = 2 * jnp.sum(known != 0, dtype=part.dtype)
        large = (size > SIZE) & (size < OTHER) & (smooth > SMOOTH * (all_of_it - of_chance))
        beyond = jnp.maximum(1 - self.drift / size, 0.0)  # part that no stated drift explains

        def in_its_noise(_) -> Bool[Array, ""]:
            noise = excess(part - along @ self.directions, known != 0)
            return jnp.sum((beyond * along) ** 2 / (self.directions**2 @ noise)) > SEEN

        # The noise is at least 1, so a sum below `SEEN` needs no estimate of the noise.
        another = all_of_it > of_chance / 2  # otherwise both are the same record
        seen = same & large & another & (beyond**2 * smooth > SEEN)
        return jax.lax.cond(seen, in_its_noise, lambda _: jnp.array(False), None)


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
    rows = xp.concatenate([x[None], by_delay[None], by_delta[1:], by_delta * 1j])
    real = xp.concatenate([rows.real, rows.imag], axis=1)
    directions = xp.linalg.qr(real.T)[0].T[2:]
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
