"""Steiglitz-McBride on the harmonics of the pulse rate, for the skin of eq. (7).

In the periodic steady state X N/D = W holds exactly at every harmonic, with X = V_th − V_out, W =
Z_th V_out and the continuous Z_bio = N/D (paper, eqs. 7-9),

    N = b₀ + b₁ s,      D = 1 + a₁ s,      R_s = b₁/a₁,   R_p = b₀ − R_s,   C_p = a₁/R_p.

Nothing is discretised, and eqs. (1), (2) become sums over harmonics of |X N_i − W D_i|² with the
weights 1/|D_{i−1}|². Two things are added to them.

**A trigger delay τ** turns V_out by e^{jωτ} = 1 + jωτ + …, which makes it one more linear unknown
with the coefficient T = −jω V_out (N + Z_th D)_{i−1}; V_out is then turned back by what was found.

**Noise** of V_out is in X and in W, and biases the sums. They contain the records in three products
only, x*x, y*y and x*y, of which the noise adds its known variance to the first two. With the
variances subtracted (bias-compensating least squares; Söderström 2007, "Errors-in-variables methods
in system identification", Automatica 43) what is left of the bias is what they are off.

With v = (x − y)* y, ⟨ ⟩ the weighted sum over all harmonics, and k, l the coefficients without −jω
and y, which are Z_th of a₁ and N + Z_th D of τ, the normal equations consist of

    ⟨X* X⟩ = ⟨|x − y|²⟩,            ⟨X* k⟩ = ⟨ω Im kv⟩,
    ⟨k* l⟩ = ⟨ω² Re k*l y*y⟩,   ⟨(jωX)* k⟩ = −⟨ω² Re kv⟩,

and ⟨Re Z_th v⟩, ⟨ω Im Z_th v⟩, 0 and −⟨ω Im k*Z_th y*y⟩ on the right. X and jωX are orthogonal, so
that b₀ and b₁ are eliminated one by one, and a₁ and τ remain. A pole in the right half-plane needs
no reflection: |1 + jωa₁| does not know the sign of a₁.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits import SkinRC
from etid.results import complex_rrse
from etid.spectra import Spectrum
from etid.steiglitz_mcbride import ITERATIONS, SETTLED
from etid.transfer import as_complex, power, reciprocal, turns

RATE = 3e4  # of a skin's relaxation [rad/s], in units of which the coefficients are near 1


class Iterate(eqx.Module):
    """The best iterate of a run.

    Attributes:
        circuit: Its elements, whatever their sign.
        delay: Trigger delay of V_out [s].
        rrse: Of the harmonics of V_out it predicts; infinite if an element is not positive.
        iteration: At which it was found.
        converged: Whether the *last* iterations settled.
        stable: Whether the pole of Z_bio lies in the left half-plane.
    """

    circuit: SkinRC
    delay: Float[Array, ""]
    rrse: Float[Array, ""]
    iteration: Int[Array, ""]
    converged: Bool[Array, ""]
    stable: Bool[Array, ""]


def fit_skin(
    spectrum: Spectrum, z_th: Complex[Array, " harmonic"], iterations: int = ITERATIONS
) -> Iterate:
    """Identify the continuous first-order Z_bio and a delay from harmonics (paper, eqs. 7-9).

    Args:
        spectrum: Harmonics of a recording.
        z_th: Source impedance at them [Ω].
        iterations: How many.
    """
    omega = 2 * jnp.pi / RATE * spectrum.frequency
    used = spectrum.selected
    xx = power(spectrum.x) - spectrum.variance_x
    yy = power(spectrum.y) - spectrum.variance_y
    xy = jnp.conj(spectrum.x) * spectrum.y
    measured = jnp.where(used, spectrum.y, 0.0)

    def loaded(q: Float[Array, " coefficient"]):
        """N and N + Z_th D."""
        b0, b1, a1, _ = q
        n = jax.lax.complex(jnp.full_like(omega, b0), b1 * omega)
        return n, n + z_th * jax.lax.complex(jnp.ones_like(omega), a1 * omega)

    def solve(q: Float[Array, " coefficient"], turn: Complex[Array, " harmonic"]):
        """b₀, b₁, a₁ and τ of the next iteration."""
        v = xy * turn - as_complex(yy)
        k = loaded(q)[1]
        zv, kv = z_th * v, k * v
        square = omega**2
        both = xx - yy - 2 * v.real  # |x − y|²
        zk = jnp.conj(z_th) * k
        terms = [both, zv.real, omega * zv.imag, omega * kv.imag]
        terms += [square * both, -square * zv.real, -square * kv.real]
        terms += [square * yy * power(z_th), square * yy * zk.real, square * yy * power(k)]
        terms += [omega * yy * zk.imag]
        weight = jnp.where(used, 1 / (1 + (omega * q[2]) ** 2), 0.0)
        p0, h0, z0, k0, p2, z1, k1, zz, kz, kk, hk = jnp.stack(terms) @ weight
        # Schur complements of b₀ and b₁, whose right sides are h0 and z0.
        zz, kz, kk = (
            zz - z0**2 / p0 - z1**2 / p2,
            kz - z0 * k0 / p0 - z1 * k1 / p2,
            kk - k0**2 / p0 - k1**2 / p2,
        )
        hz, hk = -z0 * h0 / p0 - z1 * z0 / p2, hk - k0 * h0 / p0 - k1 * z0 / p2
        determinant = zz * kk - kz**2
        a1, change = (kk * hz - kz * hk) / determinant, (zz * hk - kz * hz) / determinant
        b0, b1 = (h0 - z0 * a1 - k0 * change) / p0, (z0 - z1 * a1 - k1 * change) / p2
        return jnp.stack([b0, b1, a1, q[3] + change])

    def step(carry, iteration):
        best, previous, turn = carry
        q = solve(previous, turn)
        b0, b1, a1, tau = q
        r_s = b1 / a1
        r_p = b0 - r_s
        circuit = SkinRC(r_s, r_p, a1 / RATE / r_p)
        n, total = loaded(q)
        turn = turns(tau / RATE * spectrum.frequency[0], omega.size)
        predicted = n * reciprocal(total) * spectrum.x * jnp.conj(turn)
        error = complex_rrse(jnp.where(used, predicted, 0.0), measured)
        error = jnp.where((circuit.values() > 0).all() & jnp.isfinite(error), error, jnp.inf)
        converged = jnp.abs(q - previous)[2:].max() < SETTLED * jnp.abs(a1)
        current = Iterate(circuit, tau / RATE, error, iteration, converged, a1 > 0)
        # As long as none is a circuit, the latest is the best there is.
        better = (error < best.rrse) | ~jnp.isfinite(best.rrse)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), current, best)
        return (best, q, turn), converged

    typical = SkinRC()
    zero = jnp.zeros(())
    nothing = Iterate(
        typical, zero, jnp.array(jnp.inf), jnp.array(0), jnp.array(False), jnp.array(False)
    )
    b0, a1 = typical.r_s + typical.r_p, RATE * typical.r_p * typical.c_p
    start = jnp.stack([b0, typical.r_s * a1, a1, zero])
    none = jnp.ones_like(z_th)
    (best, *_), converged = jax.lax.scan(step, (nothing, start, none), jnp.arange(iterations))
    return eqx.tree_at(lambda b: b.converged, best, converged[-1])
