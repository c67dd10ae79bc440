"""The likelihood of harmonics, with noise on both records of every recording.

In the periodic steady state Y = G e^(−jωτ) X holds exactly at every harmonic, with continuous R_s,
R_p, C_p and Z_th(s). Nothing is discretised, and there is no unknown initial state. The
maximum-likelihood cost is (Pintelon and Schoukens, System Identification, 2012, ch. 9)

    Σ_k |Y_k − G_k e^(−jω_k τ) X_k|² / (σ_y² + |G_k|² σ_x²),      G = Z_L / (Z_L + Z_th),

The unknown true X is eliminated. σ² are the variances of one coefficient.

**One unloaded record for several loaded records** has the same noise in all of them, and all give
information about the same X. For each record, X and σ_x² are then replaced by their estimates from
the earlier records with the same X (`_learn`, one step of a Kalman filter). The result is the
likelihood of all records, in independent terms.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.impedance import AbstractImpedance
from etid.results.driver import SourceImpedance
from etid.signals.harmonics import Spectrum, local_sum, signal_share
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


def _learn(
    spectrum: Spectrum,
    other: Spectrum,
    g: Complex[Array, " harmonic"],
    same: Bool[Array, ""] | bool,
) -> Spectrum:
    """`spectrum` with X updated by Y = `g` X of another record, if both have the same X."""
    total = other.variance_y + power(g) * spectrum.variance_x
    used = other.selected & same
    share = jnp.where(used, spectrum.variance_x / total, 0.0)
    x = spectrum.x + jnp.conj(g) * as_complex(share) * (other.y - g * spectrum.x)
    variance = jnp.where(used, share * other.variance_y, spectrum.variance_x)
    return eqx.tree_at(lambda s: (s.x, s.variance_x), spectrum, (x, variance))


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


def informed(
    spectrum: Spectrum,
    others: Sequence[Spectrum],
    gains: Sequence[Complex[Array, " harmonic"]],
) -> Spectrum:
    """A recording with X updated by other recordings with the same unloaded record."""
    known = spectrum
    for other, g in zip(others, gains, strict=True):
        same = same_unloaded(spectrum, other)
        if same is not False:
            known = _learn(known, other, g, same)
    return known


def denoised(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> tuple[list[Spectrum], list[Float[Array, " part"]]]:
    """Recordings with the maximum-likelihood estimate of X from all of them, and Y = G X.

    The Jacobian J of these recordings does not contain the noise of the residual, which would count
    as information. The remaining noise of X makes the score noisier. It is no information either,
    so

        cov = H⁻¹ (Jᵀ J) H⁻¹,      H = Jᵀ W J.

    W is the share of signal in the power of X; it is returned for each residual.
    """
    found, shares = [], []
    for one, g in zip(spectra, gains, strict=True):
        known = informed(one, spectra, gains)
        found.append(eqx.tree_at(lambda s: (s.x, s.y), one, (known.x, g * known.x)))
        shares.append(jnp.tile(signal_share(known.x, known.variance_x), 2))
    return found, shares


def weights(shares: Sequence[Float[Array, "_"]], terms: int) -> Float[Array, " term"]:
    """W of `denoised` for all terms: `shares` for the first terms, 1 for the priors after them."""
    weight = jnp.concatenate(list(shares))
    return jnp.pad(weight, (0, terms - weight.size), constant_values=1.0)


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


def residuals(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> list[Float[Array, " part"]]:
    """`residual` of each recording, given the recordings before it; all are independent."""
    return [
        residual(informed(one, spectra[:i], gains[:i]), g)
        for i, (one, g) in enumerate(zip(spectra, gains, strict=True))
    ]


def by_gains(
    spectra: Sequence[Spectrum], gains: Sequence[Complex[Array, " harmonic"]]
) -> Float[Array, "record 2 term"]:
    """Derivatives of `residuals` with respect to both parts of the gain of each record.

    A residual depends on the gains at its own harmonic only.
    """
    stacked = jnp.stack(gains)
    real = jnp.eye(len(gains), dtype=stacked.real.dtype)
    directions = jnp.stack([as_complex(real), jax.lax.complex(jnp.zeros_like(real), real)], axis=1)

    def along(direction: Complex[Array, " record"]) -> Float[Array, " term"]:
        towards = jnp.broadcast_to(direction[:, None], stacked.shape)
        return jax.jvp(
            lambda g: jnp.concatenate(residuals(spectra, list(g))), (stacked,), (towards,)
        )[1]

    return jax.vmap(jax.vmap(along))(directions)


def chained(
    slopes: Sequence[Complex[Array, "row harmonic"]], by_gain: Float[Array, "record 2 term"]
) -> Float[Array, "row term"]:
    """Derivatives of residuals: `slopes` are those of each gain, `by_gain` is from `by_gains`."""
    each = by_gain.reshape(*by_gain.shape[:2], -1, slopes[0].shape[-1])
    rows = jnp.zeros((slopes[0].shape[0], *each.shape[2:]), by_gain.dtype)
    for slope, (real, imaginary) in zip(slopes, each, strict=True):
        rows = rows + slope.real[:, None] * real[None] + slope.imag[:, None] * imaginary[None]
    return rows.reshape(rows.shape[0], -1)


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
