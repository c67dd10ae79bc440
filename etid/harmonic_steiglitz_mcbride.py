"""Steiglitz-McBride on the harmonics of the pulse rate, for the skin of eq. (7).

In the periodic steady state X N/D = W holds exactly at every harmonic, with X = V_th − V_out, W =
Z_th V_out and the continuous Z_bio = N/D (paper, eqs. 7-9),

    N = b₀ + b₁ s,      D = 1 + a₁ s,      R_s = b₁/a₁,   R_p = b₀ − R_s,   C_p = a₁/R_p.

Nothing is discretised, and eqs. (1), (2) become sums over harmonics, of |X N_i − W D_i|² with the
weights 1/|D_{i−1}|². With real coefficients and s = jω all they need of the records are

    p = |X|²,      r = |W|²,      c = Re X*W,      d = Im X*W,

weighted and summed with powers of ω, for normal equations with the closed form

    b₀ = (C₀ − D₁ a₁)/P₀,   b₁ = (D₁ + C₂ a₁)/P₂,   a₁ = (C₂ D₁/P₂ − D₁ C₀/P₀) / (R₂ − D₁²/P₀ −
    C₂²/P₂),

P₂ being the sum of ω² p, and so on. A pole in the right half-plane needs no reflection: |1 + jωa₁|
does not know the sign of a₁.

**Noise** of V_out is in X and in W, and biases these sums. As its variances are known, its part in
them is subtracted (compensated least squares; Söderström 2007, *Errors-in-variables methods in
system identification*, sec. 5): what is left of the bias is what the variances are off. Delays are
not fitted.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits import SkinRC
from etid.results import complex_rrse
from etid.spectra import Spectrum
from etid.steiglitz_mcbride import ITERATIONS, SETTLED
from etid.transfer import as_complex, power, reciprocal

RATE = 3e4  # of a skin's relaxation [rad/s], in units of which the coefficients are near 1


class Iterate(eqx.Module):
    """The best iterate of a run.

    Attributes:
        circuit: Its elements, whatever their sign.
        rrse: Of the harmonics of V_out it predicts; infinite if an element is not positive.
        iteration: At which it was found, 0 being equation error.
        converged: Whether the *last* iterations settled.
        stable: Whether the pole of Z_bio lies in the left half-plane.
    """

    circuit: SkinRC
    rrse: Float[Array, ""]
    iteration: Int[Array, ""]
    converged: Bool[Array, ""]
    stable: Bool[Array, ""]


def _products(
    spectrum: Spectrum, z_th: Complex[Array, " harmonic"], omega: Float[Array, " harmonic"]
) -> Float[Array, "product harmonic"]:
    """p, ω² p, ω² r, c, ω² c and ω d, free of noise on average; 0 if not selected."""
    x, w = spectrum.x - spectrum.y, z_th * spectrum.y
    of_x, of_y = spectrum.variance_x, spectrum.variance_y
    cross = jnp.conj(x) * w + z_th * as_complex(of_y)
    p = power(x) - of_x - of_y
    r = power(w) - power(z_th) * of_y
    c, d = cross.real, cross.imag
    terms = jnp.stack([p, omega**2 * p, omega**2 * r, c, omega**2 * c, omega * d])
    return jnp.where(spectrum.selected[None, :], terms, 0.0)


def fit_skin(
    spectrum: Spectrum, z_th: Complex[Array, " harmonic"], iterations: int = ITERATIONS
) -> Iterate:
    """Identify the continuous first-order Z_bio (paper, eqs. 7-9) from harmonics.

    Args:
        spectrum: Harmonics of a recording.
        z_th: Source impedance at them [Ω].
        iterations: How many; 1 is equation error.
    """
    omega = 2 * jnp.pi / RATE * spectrum.frequency
    terms = _products(spectrum, z_th, omega)
    y = jnp.where(spectrum.selected, spectrum.y, 0.0)

    def step(carry, iteration):
        best, previous = carry
        weight = 1 / (1 + (omega * previous) ** 2)
        p0, p2, r2, c0, c2, d1 = terms @ weight
        a1 = (c2 * d1 / p2 - d1 * c0 / p0) / (r2 - d1**2 / p0 - c2**2 / p2)
        b0, b1 = (c0 - d1 * a1) / p0, (d1 + c2 * a1) / p2
        r_s = b1 / a1
        r_p = b0 - r_s
        circuit = SkinRC(r_s, r_p, a1 / RATE / r_p)
        # G = N / (N + Z_th D)
        n = jax.lax.complex(jnp.full_like(omega, b0), b1 * omega)
        d = jax.lax.complex(jnp.ones_like(omega), a1 * omega)
        predicted = n * reciprocal(n + z_th * d) * spectrum.x
        error = complex_rrse(jnp.where(spectrum.selected, predicted, 0.0), y)
        error = jnp.where((circuit.values() > 0).all() & jnp.isfinite(error), error, jnp.inf)
        converged = jnp.abs(a1 - previous) < SETTLED * jnp.abs(a1)
        current = Iterate(circuit, error, iteration, converged, a1 > 0)
        # As long as none is a circuit, the latest is the best there is.
        better = (error < best.rrse) | ~jnp.isfinite(best.rrse)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), current, best)
        return (best, a1), converged

    zero = jnp.zeros(())
    nothing = Iterate(
        SkinRC(zero, zero, zero), jnp.array(jnp.inf), jnp.array(0), jnp.array(False), zero > 0
    )
    (best, _), converged = jax.lax.scan(step, (nothing, zero), jnp.arange(iterations))
    return eqx.tree_at(lambda b: b.converged, best, converged[-1])
