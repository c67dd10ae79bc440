"""The paper's estimate of the driver from harmonics: Steiglitz-McBride in the steady state.

At a harmonic, a delay by k samples is a factor z⁻ᵏ. Eqs. (1), (2) become sums over harmonics of

    |X N_i − W D_i|² / |D_{i−1}|²,      X = V_out,      W = R_L (V_th − V_out).

No filter runs, so that a step takes a few per cent of one in time. An unstable D_{i−1} needs no
reflected poles, because only |D_{i−1}| counts.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.steiglitz_mcbride.iteration import Iterate, iterate, least_squares
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.signals.transfer import (
    Rational,
    add_polynomials,
    as_complex,
    delay_variable,
    is_stable,
    power,
    reciprocal,
)


def driver_filter(
    spectra: Spectrum,
    r_load: Float[Array, " record"],
    sample_rate: Float[Array, ""],
    order: int,
) -> Iterate:
    """Identify the discrete Z_th from harmonics of records with known resistors (paper, eqs. 4-6).

    Args:
        spectra: Harmonics of the records, stacked along a leading axis.
        r_load: The resistors [Ω].
        sample_rate: Sampling rate [Hz].
        order: Number of poles; the order of the numerator is one less.
    """
    x, y = (jnp.where(spectra.selected, of, 0.0) for of in (spectra.x, spectra.y))
    r = as_complex(r_load)[:, None]
    w = r * (x - y)
    z = delay_variable(spectra.frequency, sample_rate)
    powers = [jnp.ones_like(z)]
    while len(powers) <= order:
        powers.append(powers[-1] * z)
    delays = jnp.stack(powers)
    rows = jnp.concatenate([delays[:-1] * y[None], -delays[1:] * w[None], w[None]])
    rows = rows.reshape(2 * order + 1, -1)
    parts = jnp.stack([rows.real, rows.imag], axis=1)

    def solve(previous: Float[Array, " a"]) -> Rational:
        den = jnp.tensordot(as_complex(previous), delays, 1).ravel()
        weighted = parts / jnp.sqrt(power(den))[None, None, :]
        return least_squares(weighted.reshape(parts.shape[0], -1).T, order)

    def assess(candidate: Rational) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        num = jnp.tensordot(as_complex(candidate.num), delays[:-1], 1)
        forward = r * jnp.tensordot(as_complex(candidate.den), delays, 1)
        predicted = forward * reciprocal(forward + num) * x
        closed = [add_polynomials(of * candidate.den, candidate.num) for of in r_load]
        stable = jnp.stack([is_stable(one) for one in closed]).all()
        error = jax.vmap(complex_rrse)(predicted, y).max()
        return jnp.where(stable & jnp.isfinite(error), error, jnp.inf), stable

    return iterate(solve, order - 1, order, assess)
