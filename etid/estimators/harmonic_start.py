"""Start of a skin: Steiglitz-McBride on the harmonics of the pulse rate, for the skin of eq. (7).

In the periodic steady state X N/D = W holds exactly at every harmonic, with X = V_th − V_out, W =
Z_th V_out and the continuous Z_bio = N/D (paper, eqs. 7-9),

    N = b₀ + b₁ s,      D = 1 + a₁ s,      R_s = b₁/a₁,   R_p = b₀ − R_s,   C_p = a₁/R_p.

Nothing is discretised. Eqs. (1), (2) become sums over harmonics of |X N_i − W D_i|² with the
weights 1/|D_{i−1}|². This module adds two things.

**A trigger delay τ** multiplies V_out by e^{jωτ} = 1 + jωτ + …. It is one more linear unknown with
the coefficient T = −jω V_out (N + Z_th D)_{i−1}. V_out is then corrected by the delay found.

**Noise** of V_out is in X and in W, and biases the sums. The sums contain the records only in three
products, x*x, y*y and x*y. The noise adds its known variance to the first two. The variances are
subtracted (bias-compensating least squares; Söderström 2007, "Errors-in-variables methods in system
identification", Automatica 43). The remaining bias comes from the errors of the variances.

Let v = (x − y)* y, and let ⟨ ⟩ be the weighted sum over all harmonics. k and l are coefficients
without −jω and y: that of a₁ is Z_th, and that of τ is N + Z_th D. The normal equations consist of

    ⟨X* X⟩ = ⟨|x − y|²⟩,            ⟨X* k⟩ = ⟨ω Im kv⟩,
    ⟨k* l⟩ = ⟨ω² Re k*l y*y⟩,   ⟨(jωX)* k⟩ = −⟨ω² Re kv⟩,

and ⟨Re Z_th v⟩, ⟨ω Im Z_th v⟩, 0 and −⟨ω Im k*Z_th y*y⟩ on the right. X and jωX are orthogonal.
Therefore b₀ and b₁ are eliminated one by one, and a₁ and τ remain. A pole in the right half-plane
needs no reflection, because |1 + jωa₁| does not depend on the sign of a₁.

The products of the records are summed once, at the knots: an iteration then takes a tenth of the
time. A start needs no more.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import SkinRC
from etid.signals.harmonics import Spectrum
from etid.signals.knots import knots
from etid.signals.transfer import as_complex, power

RATE = 3e4  # [rad/s] rate of a skin's relaxation; in this unit the coefficients are near 1


def start_of_skin(
    spectrum: Spectrum,
    z_th: Complex[Array, " harmonic"],
    sample_rate: Float[Array, ""],
    iterations: int,
) -> tuple[SkinRC, Float[Array, ""]]:
    """The last iterate, whose elements may be negative, and its trigger delay [samples]."""
    every = knots(z_th.size)
    xx = power(spectrum.x) - spectrum.variance_x
    yy = power(spectrum.y) - spectrum.variance_y
    xy = jnp.conj(spectrum.x) * spectrum.y
    parts = jnp.stack([xx, yy, xy.real, xy.imag])
    xx, yy, real, imaginary = every.summed(jnp.where(spectrum.selected[None, :], parts, 0.0))
    omega = every.at(2 * jnp.pi / RATE * spectrum.frequency)
    sums = _Sums(omega, xx, yy, jax.lax.complex(real, imaginary), every.at(z_th))

    def step(q: Float[Array, " coefficient"], _: None) -> tuple[Float[Array, " coefficient"], None]:
        return sums.solve(q), None

    q, _ = jax.lax.scan(step, _typical(), length=iterations)
    return _elements(q), q[3] / RATE * sample_rate


class _Sums(NamedTuple):
    """Sums of the products of the records at each knot."""

    omega: Float[Array, " knot"]
    xx: Float[Array, " knot"]
    yy: Float[Array, " knot"]
    xy: Complex[Array, " knot"]
    z_th: Complex[Array, " knot"]

    def solve(self, q: Float[Array, " coefficient"]) -> Float[Array, " coefficient"]:
        """b₀, b₁, a₁ and τ of the next iteration."""
        omega, xx, yy, xy, z_th = self
        turn = jax.lax.complex(jnp.cos(omega * q[3]), jnp.sin(omega * q[3]))  # e^(jωτ)
        v = xy * turn - as_complex(yy)
        n = jax.lax.complex(jnp.full_like(omega, q[0]), q[1] * omega)
        d = jax.lax.complex(jnp.ones_like(omega), q[2] * omega)
        k = n + z_th * d
        zv, kv = z_th * v, k * v
        square = omega**2
        both = xx - yy - 2 * v.real  # |x − y|²
        zk = jnp.conj(z_th) * k
        terms = [both, zv.real, omega * zv.imag, omega * kv.imag]
        terms += [square * both, -square * zv.real, -square * kv.real]
        terms += [square * yy * power(z_th), square * yy * zk.real, square * yy * power(k)]
        terms += [omega * yy * zk.imag]
        weight = 1 / (1 + (omega * q[2]) ** 2)
        p0, h0, z0, k0, p2, z1, k1, zz, kz, kk, hk = jnp.stack(terms) @ weight
        # Schur complements of b₀ and b₁; their right sides are h0 and z0.
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


def _elements(q: Float[Array, " coefficient"]) -> SkinRC:
    """The skin with these coefficients."""
    b0, b1, a1, _ = q
    r_s = b1 / a1
    r_p = b0 - r_s
    return SkinRC(r_s, r_p, a1 / RATE / r_p)


def _typical() -> Float[Array, " coefficient"]:
    """Coefficients of typical skin without a delay."""
    typical = SkinRC()
    b0, a1 = typical.r_s + typical.r_p, RATE * typical.r_p * typical.c_p
    return jnp.stack([b0, typical.r_s * a1, a1, jnp.zeros(())])
