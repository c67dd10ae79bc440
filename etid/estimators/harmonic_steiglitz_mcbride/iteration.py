"""Steiglitz-McBride on the harmonics of the pulse rate, for the skin of eq. (7).

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

**The covariance** is that of a fixed point q = Φ(q, X, Y, Z_th), whose differential is

    dq = (1 − ∂Φ/∂q)⁻¹ (∂Φ/∂X dX + ∂Φ/∂Y dY + ∂Φ/∂Z_th dZ_th).

All three are taken as independent. If a calibration has the same unloaded record, the effects of
its noise on Z_th and on the skin partly cancel. The standard errors are then a quarter too large.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import SkinRC
from etid.estimators.steiglitz_mcbride.iteration import ITERATIONS, SETTLED
from etid.results.driver import SourceImpedance
from etid.results.fit import complex_rrse
from etid.signals.harmonics import Spectrum
from etid.signals.knots import knots
from etid.signals.transfer import as_complex, power, reciprocal, turns

RATE = 3e4  # [rad/s] rate of a skin's relaxation; in this unit the coefficients are near 1


class Iterate(eqx.Module):
    """The best iterate of a run.

    Attributes:
        circuit: Circuit with its elements, which may be negative.
        delay_samples: Trigger delay of V_out [samples].
        rrse: RRSE of the predicted harmonics of V_out; infinite if an element is not positive.
        iteration: Number of its iteration.
        converged: Whether the *last* iterations converged.
        stable: Whether the pole of Z_bio lies in the left half-plane.
    """

    circuit: SkinRC
    delay_samples: Float[Array, ""]
    rrse: Float[Array, ""]
    iteration: Int[Array, ""]
    converged: Bool[Array, ""]
    stable: Bool[Array, ""]


class _Products(NamedTuple):
    """Products of the records at each harmonic, from which the sums are computed."""

    omega: Float[Array, " harmonic"]
    used: Bool[Array, " harmonic"]
    xx: Float[Array, " harmonic"]
    yy: Float[Array, " harmonic"]
    xy: Complex[Array, " harmonic"]
    z_th: Complex[Array, " harmonic"]

    def loaded(
        self, q: Float[Array, " coefficient"]
    ) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"]]:
        """N and N + Z_th D."""
        b0, b1, a1, _ = q
        n = jax.lax.complex(jnp.full_like(self.omega, b0), b1 * self.omega)
        d = jax.lax.complex(jnp.ones_like(self.omega), a1 * self.omega)
        return n, n + self.z_th * d

    def solve(
        self, q: Float[Array, " coefficient"], turn: Complex[Array, " harmonic"]
    ) -> Float[Array, " coefficient"]:
        """b₀, b₁, a₁ and τ of the next iteration."""
        omega, used, xx, yy, xy, z_th = self
        v = xy * turn - as_complex(yy)
        k = self.loaded(q)[1]
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


def _products(spectrum: Spectrum, z_th: Complex[Array, " harmonic"]) -> _Products:
    """The products without the variance of the noise."""
    return _Products(
        2 * jnp.pi / RATE * spectrum.frequency,
        spectrum.selected,
        power(spectrum.x) - spectrum.variance_x,
        power(spectrum.y) - spectrum.variance_y,
        jnp.conj(spectrum.x) * spectrum.y,
        z_th,
    )


def _turn(
    q: Float[Array, " coefficient"], frequency: Float[Array, " harmonic"]
) -> Complex[Array, " harmonic"]:
    """e^(jωτ)."""
    return turns(q[3] / RATE * frequency[0], frequency.size)


def _elements(q: Float[Array, " coefficient"]) -> SkinRC:
    """The skin with these coefficients."""
    b0, b1, a1, _ = q
    r_s = b1 / a1
    r_p = b0 - r_s
    return SkinRC(r_s, r_p, a1 / RATE / r_p)


_Carry = tuple[Iterate, Float[Array, " coefficient"], Complex[Array, " harmonic"]]


def fit_skin(
    spectrum: Spectrum,
    z_th: Complex[Array, " harmonic"],
    sample_rate: Float[Array, ""],
    iterations: int = ITERATIONS,
) -> Iterate:
    """Identify the continuous first-order Z_bio and a delay from harmonics (paper, eqs. 7-9).

    Args:
        spectrum: Harmonics of a recording.
        z_th: Source impedance at these harmonics [Ω].
        sample_rate: Sampling rate of the recording [Hz].
        iterations: Number of iterations.
    """
    of = _products(spectrum, z_th)
    used = spectrum.selected
    measured = jnp.where(used, spectrum.y, 0.0)

    def step(carry: _Carry, iteration: Int[Array, ""]) -> tuple[_Carry, Bool[Array, ""]]:
        best, previous, turn = carry
        q = of.solve(previous, turn)
        a1, tau = q[2:]
        circuit = _elements(q)
        n, total = of.loaded(q)
        turn = _turn(q, spectrum.frequency)
        predicted = n * reciprocal(total) * spectrum.x * jnp.conj(turn)
        error = complex_rrse(jnp.where(used, predicted, 0.0), measured)
        error = jnp.where((circuit.values() > 0).all() & jnp.isfinite(error), error, jnp.inf)
        converged = jnp.abs(q - previous)[2:].max() < SETTLED * jnp.abs(a1)
        current = Iterate(circuit, tau / RATE * sample_rate, error, iteration, converged, a1 > 0)
        # While no iterate is a circuit, keep the latest.
        better = (error < best.rrse) | ~jnp.isfinite(best.rrse)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), current, best)
        return (best, q, turn), converged

    typical = SkinRC()
    zero = jnp.zeros(())
    nothing = Iterate(
        typical, zero, jnp.array(jnp.inf), jnp.array(0), jnp.array(False), jnp.array(False)
    )
    start = nothing, _typical(), jnp.ones_like(z_th)
    (best, *_), converged = jax.lax.scan(step, start, jnp.arange(iterations))
    return eqx.tree_at(lambda b: b.converged, best, converged[-1])


def start_of_skin(
    spectrum: Spectrum,
    z_th: Complex[Array, " harmonic"],
    sample_rate: Float[Array, ""],
    iterations: int,
) -> tuple[SkinRC, Float[Array, ""]]:
    """The last iterate with its delay [samples], from sums at the knots: a start of other fits.

    The products of the records are summed once; an iteration then takes a tenth of the time.

    Args:
        spectrum: Harmonics of a recording.
        z_th: Source impedance at these harmonics [Ω].
        sample_rate: Sampling rate of the recording [Hz].
        iterations: Number of iterations.
    """
    every, fine = knots(z_th.size), _products(spectrum, z_th)
    parts = jnp.stack([fine.xx, fine.yy, fine.xy.real, fine.xy.imag])
    xx, yy, real, imaginary = every.summed(jnp.where(fine.used[None, :], parts, 0.0))
    omega = every.at(fine.omega)
    used = jnp.ones(omega.shape, bool)
    of = _Products(omega, used, xx, yy, jax.lax.complex(real, imaginary), every.at(z_th))

    def step(q: Float[Array, " coefficient"], _: None) -> tuple[Float[Array, " coefficient"], None]:
        turn = omega * q[3]
        return of.solve(q, jax.lax.complex(jnp.cos(turn), jnp.sin(turn))), None

    q, _ = jax.lax.scan(step, _typical(), length=iterations)
    return _elements(q), q[3] / RATE * sample_rate


def _typical() -> Float[Array, " coefficient"]:
    """Coefficients of typical skin without a delay."""
    typical = SkinRC()
    b0, a1 = typical.r_s + typical.r_p, RATE * typical.r_p * typical.c_p
    return jnp.stack([b0, typical.r_s * a1, a1, jnp.zeros(())])


def covariance(
    spectrum: Spectrum,
    noise: Float[Array, " harmonic"],
    source: SourceImpedance,
    source_cov: Float[Array, "parameter parameter"],
    sample_rate: Float[Array, ""],
    best: Iterate,
) -> tuple[Float[Array, "element element"], Float[Array, "element element"]]:
    """Covariance of the logarithms of the elements, to first order in the noise.

    Args:
        spectrum: The recording.
        noise: Variance of its noise, relative to the variance in `spectrum`.
        source: Source impedance of the fit.
        source_cov: Covariance of the flattened parameters of `source`.
        sample_rate: Sampling rate of the recording [Hz].
        best: The converged estimate.

    Returns:
        The covariance by the noise of both records, and the covariance by that of the source.
    """
    of = best.circuit
    a1 = RATE * of.r_p * of.c_p
    delay = best.delay_samples / sample_rate
    q = jnp.stack([of.r_s + of.r_p, of.r_s * a1, a1, RATE * delay])
    parameters, unflatten = ravel_pytree(source)

    def following(
        q: Float[Array, " coefficient"],
        x: Float[Array, "2 harmonic"],
        y: Float[Array, "2 harmonic"],
        parameters: Float[Array, " parameter"],
    ) -> Float[Array, " coefficient"]:
        there = eqx.tree_at(lambda s: (s.x, s.y), spectrum, (as_one(x), as_one(y)))
        z_th = unflatten(parameters).response(spectrum.frequency)
        return _products(there, z_th).solve(q, _turn(q, spectrum.frequency))

    def as_one(parts: Float[Array, "2 harmonic"]) -> Complex[Array, " harmonic"]:
        return jax.lax.complex(parts[0], parts[1])

    x, y = (jnp.stack([v.real, v.imag]) for v in (spectrum.x, spectrum.y))
    by_q = jax.jacfwd(following)(q, x, y, parameters)
    by_element = jax.jacfwd(lambda q: jnp.log(_elements(q).values()))(q)
    rows = jnp.linalg.solve((jnp.eye(q.size) - by_q).T, by_element.T).T
    _, pullback = jax.vjp(lambda *data: following(q, *data), x, y, parameters)
    by_x, by_y, by_source = jax.vmap(pullback)(rows)

    def of_noise(
        slope: Float[Array, "element 2 harmonic"], variance: Float[Array, " harmonic"]
    ) -> Float[Array, "element element"]:
        # Half of the variance is in each of both parts.
        return jnp.einsum("ipk,jpk,k->ij", slope, slope, variance / 2)

    own = of_noise(by_x, noise * spectrum.variance_x) + of_noise(by_y, noise * spectrum.variance_y)
    return own, by_source @ source_cov @ by_source.T
