"""The likelihood of harmonics, with noise on both records of every recording.

In the periodic steady state Y = G e^(−jωτ) X holds exactly at every harmonic, with continuous R_s,
R_p, C_p and Z_th(s). Nothing is discretised, and there is no unknown initial state. The
maximum-likelihood cost is (Pintelon and Schoukens, System Identification, 2012, ch. 9)

    Σ_k |Y_k − G_k e^(−jω_k τ) X_k|² / (σ_y² + |G_k|² σ_x²),      G = Z_L / (Z_L + Z_th),

The unknown true X is eliminated. σ² are the variances of one coefficient.
`etid.estimators.maximum_likelihood.profile` has the likelihood of several records of one X.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.impedance import AbstractImpedance
from etid.results.driver import SourceImpedance
from etid.signals.harmonics import Spectrum, local_sum
from etid.signals.mains import lines
from etid.signals.transfer import as_complex, delayed, frequency_variable, power, reciprocal

SURE = 4.0  # standard deviations by which a local variance must exceed the mean
LOW = 128  # number of first harmonics that are tested for mains hum
HUM = 14.4  # times the mean; an exponential exceeds it as rarely as a normal number exceeds five σ
ROUNDING = 1e-12  # relative difference of two transforms of the same samples


def gain(
    source: SourceImpedance, load: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> Complex[Array, " harmonic"]:
    """G = Z_L / (Z_L + Z_th)."""
    z_load = load(frequency_variable(frequency))
    return z_load * reciprocal(z_load + source.response(frequency))


def delayed_gain(
    source: SourceImpedance,
    load: AbstractImpedance,
    frequency: Float[Array, " harmonic"],
    delay_samples: Float[Array, ""],
    sample_rate: Float[Array, ""],
) -> Complex[Array, " harmonic"]:
    """G e^(−jωτ)."""
    return delayed(gain(source, load, frequency), frequency, delay_samples, sample_rate)


def variance(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Float[Array, " harmonic"]:
    """Variance E|Y − g X|² by the noise."""
    return spectrum.variance_y + power(g) * spectrum.variance_x


def residual(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Float[Array, " part"]:
    """Real and imaginary parts of Y − g X, scaled to unit variance; 0 if not selected."""
    weight = jnp.where(spectrum.selected, jnp.sqrt(2 / variance(spectrum, g)), 0.0)
    difference = (spectrum.y - g * spectrum.x) * as_complex(weight)
    return jnp.concatenate([difference.real, difference.imag])


def shows_hum(spectrum: Spectrum, g: Complex[Array, " harmonic"]) -> Bool[Array, ""]:
    """Whether Y − g X shows mains hum: a harmonic near mains frequencies exceeds the noise.

    The noise is the larger of two: the variances, or the residual of the other low harmonics.
    Harmonics that are not selected are tested too.
    """
    squares = power(spectrum.y - g * spectrum.x) / variance(spectrum, g)
    return stands_out(squares, spectrum.frequency, spectrum.selected)


def stands_out(
    squares: Float[Array, " harmonic"],
    frequency: Float[Array, " harmonic"],
    selected: Bool[Array, " harmonic"],
) -> Bool[Array, ""]:
    """Whether `squares` at the harmonics show mains hum; without hum their mean is 1."""
    squares, suspect = squares[:LOW], lines(frequency[:LOW])
    others = selected[:LOW] & ~suspect
    count = jnp.maximum(jnp.sum(others, dtype=squares.dtype), 1.0)
    around = jnp.sum(jnp.where(others, squares, 0.0)) / count
    return jnp.max(jnp.where(suspect, squares, 0.0)) > HUM * jnp.maximum(around, 1.0)


def same_unloaded(one: Spectrum, other: Spectrum) -> Bool[Array, ""] | bool:
    """Whether two recordings have the same unloaded record."""
    if one is other:
        return True
    if one.x.shape != other.x.shape:
        return False
    return jnp.sum(power(one.x - other.x)) <= ROUNDING**2 * jnp.sum(power(other.x))


def as_list(spectra: Spectrum) -> list[Spectrum]:
    """A list of recordings, from recordings stacked along a leading axis."""
    return [jax.tree.map(lambda leaf, i=i: leaf[i], spectra) for i in range(spectra.x.shape[0])]


def excess(
    part: Float[Array, " part"], selected: Bool[Array, " harmonic"]
) -> Float[Array, " part"]:
    """Variance of a residual around each harmonic, relative to the expected variance; at least 1.

    The weights assume white noise, but noise may be coloured, and no model is exact. The covariance
    (Jᵀ C J in place of Jᵀ J, White 1980) therefore uses the variance of the residual. It is the
    mean over `harmonics.WINDOW` harmonics where this surely exceeds the mean over all harmonics,
    and otherwise the mean over all.
    """
    count = selected.size
    power = part[:count] ** 2 + part[count:] ** 2
    of = jnp.where(selected, 2.0, 0.0)
    overall = jnp.maximum(jnp.sum(power) / jnp.maximum(jnp.sum(of), 1.0), 1.0)
    freedom = jnp.maximum(local_sum(of), 1.0)
    local = local_sum(power) / freedom
    sure = local > overall * (1 + SURE * jnp.sqrt(2 / freedom))
    return jnp.tile(jnp.where(sure, local, overall), 2)


def apart(evaluate: Callable[[Array], Any], q: Float[Array, " q"]) -> Any:
    """`evaluate(q)`, computed once; NaN if `q` is not finite.

    XLA repeats a computation in every loop that reads its result, here a dozen times. It computes
    the result of a branch only once.
    """
    # JAX remembers the trace of this function, so that branches within branches are traced once.
    once = jax.jit(lambda q: evaluate(q))
    shapes = jax.eval_shape(once, q)

    def nothing(_) -> Any:
        return jax.tree.map(lambda of: jnp.full(of.shape, jnp.nan, of.dtype), shapes)

    return jax.lax.cond(jnp.isfinite(q).all(), once, nothing, q)
