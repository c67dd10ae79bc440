"""Is the unloaded voltage still that of the calibration? It shows that a driver has changed.

A change of Z_th bends Y/X as a change of the load does: with a resistor of 5 % more in the driver,
R_p of dry skin is 63 standard errors off at 60 dB, and χ² is 1. But the parts of Z_th make V_th as
well, where there is no skin: the same resistor, and the capacitance of the cable behind it, take a
thousandth of the edges. So the harmonics of two unloaded records of one driver may differ by an
amplitude a and a delay τ only,

    X_k = a e^(−jω_k τ) X⁰_k (1 + δ_k),      δ = 0.

δ of a part that has changed is smooth in frequency: here `DEGREE` complex polynomials of log f.
Another pulse, a longer one for instance, has its zeros elsewhere, which is not smooth: it says
nothing of the driver and is no fault.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.estimators.maximum_likelihood.terms import excess
from etid.results.driver import Driver, HarmonicDriver
from etid.signals.harmonics import Spectrum, signal_share
from etid.signals.transfer import as_complex, power, turns

DEGREE = 6  # of δ: its real part has a constant less, which is the amplitude
FIRST = 6  # harmonics that are left out: hum and drift
SIGNAL = 0.9  # share of signal in the power around a harmonic from which on it is used
SEEN = 36.0  # of 11 degrees of freedom: one recording in 6000 by chance
SIZE = 1.5e-4  # of V_th, that must differ as well; pulses are repeated to no better than this
# By a driver whose parts are known to drift, relative to that: three times the standard deviation
# of an inductance, which does most.
DRIFT = 0.2
OTHER = 0.1  # of V_th, from which on it is another pulse; a part of twice its size does less
SMOOTH = 1 / 3  # of what the records differ by must be smooth
# By which pulse rates may differ: records of other lengths are cut to other whole samples, which
# moves the zeros of a pulse at its thousandth harmonic by as much as a part that has changed.
SAME_FREQUENCY = 1e-6


class UnloadedShape(NamedTuple):
    """The unloaded voltage of a calibration.

    Attributes:
        frequency: Its harmonics [Hz].
        x: Their coefficients [V], 0 where they are not used.
        variance: E|noise|² of each [V²].
        directions: Orthonormal ways in which `x` changes with δ, at right angles to amplitude and
            delay; real parts, then imaginary ones.
        bias: What the noise of `x`, which is in the directions too, takes along each [V].
        least: Part of V_th by which another has to differ.
    """

    frequency: Float[Array, " harmonic"]
    x: Complex[Array, " harmonic"]
    variance: Float[Array, " harmonic"]
    directions: Float[Array, "direction part"]
    bias: Float[Array, " direction"]
    least: Float[Array, ""]

    def differs(self, spectrum: Spectrum) -> Bool[Array, ""]:
        """Whether a recording's unloaded voltage is that of a driver that has changed."""
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
        size = jnp.sqrt(smooth / total) / (scale * jnp.abs(amplitude))
        same = jnp.abs(spectrum.frequency[0] / self.frequency[0] - 1) < SAME_FREQUENCY
        of_chance = 2 * jnp.sum(known != 0, dtype=part.dtype)
        large = (size > self.least) & (size < OTHER) & (smooth > SMOOTH * (all_of_it - of_chance))

        def in_its_noise(_):
            noise = excess(part - along @ self.directions, known != 0)
            return jnp.sum(along**2 / (self.directions**2 @ noise)) > SEEN

        # No noise is smaller than 1, so that it need not be known where this is none.
        another = all_of_it > of_chance / 2  # or else it is the same record
        seen = same & large & another & (smooth > SEEN)
        return jax.lax.cond(seen, in_its_noise, lambda _: jnp.array(False), None)


def shape(spectrum: Spectrum, drift: Float[Array | np.ndarray, ""] | None = None) -> UnloadedShape:
    """The unloaded voltage of a calibration, to compare others with.

    Args:
        spectrum: The calibration.
        drift: That of its driver.
    """
    f, size = spectrum.frequency, spectrum.x.shape[0]
    clear = signal_share(spectrum.x, spectrum.variance_x) > SIGNAL
    used = spectrum.selected & clear & (jnp.arange(size) >= FIRST)
    x = jnp.where(used, spectrum.x, 0)
    u = 2 * jnp.log(f / f[0]) / jnp.log(f[-1] / f[0]) - 1
    smooth = jnp.stack([jnp.cos(n * jnp.arccos(jnp.clip(u, -1, 1))) for n in range(DEGREE)])
    by_delta = as_complex(smooth) * x[None, :]
    by_delay = x * jax.lax.complex(jnp.zeros(size), f / f[-1])
    rows = jnp.concatenate([x[None], by_delay[None], by_delta[1:], by_delta * 1j])
    real = jnp.concatenate([rows.real, rows.imag], axis=1)
    directions = jnp.linalg.qr(real.T)[0].T[2:]
    # Σ Re (q/x)* σ²: a direction q is x times a function of frequency, and the difference has −x.
    share = jnp.where(used, spectrum.variance_x / jnp.where(used, power(x), 1.0), 0.0)
    bias = directions @ (jnp.concatenate([x.real, x.imag]) * jnp.tile(share, 2))
    least = jnp.asarray(SIZE) + DRIFT * (0.0 if drift is None else drift)
    return UnloadedShape(f, x, spectrum.variance_x, directions, bias, least)


def shape_of(driver: Driver, frequency: Float[Array, " harmonic"]) -> UnloadedShape | None:
    """The unloaded voltage of the first calibration of a driver.

    Args:
        driver: The driver.
        frequency: Harmonics of the loads [Hz].

    Returns:
        None if the driver has no harmonics, or others than the loads.
    """
    if not isinstance(driver, HarmonicDriver) or driver.spectra.x.shape[1:] != frequency.shape:
        return None
    return shape(jax.tree.map(lambda leaf: leaf[0], driver.spectra), driver.drift)
