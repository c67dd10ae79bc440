"""A likelihood near some gains, condensed to a few knots.

Gains are smooth in frequency, records are not. Near gains G₀ the likelihood of
`etid.estimators.maximum_likelihood.profile` is therefore known from sums at the knots
(`etid.signals.knots`),

    ½ D ≈ ½ Σ_b |C_b (G(f_b) − G₀(f_b)) − t_b|² + constant,

    C_bᴴ C_b = Σ_k φ_b(k) P_k,      C_bᴴ t_b = Σ_k φ_b(k) ρ_k.

C is lower triangular, so that the term of an output contains the gains of this output and of those
before it, like its innovation. The terms are a residual for any solver, at a few per cent of the
cost of all harmonics.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.estimators.maximum_likelihood.profile import Profile, total
from etid.signals.harmonics import real_parts
from etid.signals.knots import Knots
from etid.signals.transfer import as_complex


class Slopes(eqx.Module):
    """Gains and their derivatives at each frequency.

    Attributes:
        z: The impedance that acts on them [Ω]: Z_L of a load, Z_th of each calibration.
        gains: The gains.
        by_z: Derivatives with respect to this impedance.
        by_unknown: Derivatives with respect to the unknowns of a fit.
    """

    z: Complex[Array, "*output frequency"]
    gains: Complex[Array, "output frequency"]
    by_z: Complex[Array, "output frequency"]
    by_unknown: Complex[Array, "q output frequency"]


class Condensed(eqx.Module):
    """A likelihood as a function of the gains at the knots.

    Attributes:
        gains: G₀.
        root: C.
        target: t.
    """

    gains: Complex[Array, "output knot"]
    root: Complex[Array, "output output knot"]
    target: Complex[Array, "output knot"]

    @classmethod
    def of(cls, profiles: Sequence[Profile], every: Knots) -> "Condensed":
        """The likelihood near the gains of `profiles`, one for each input."""
        information = total([of.information for of in profiles])
        score, outputs = total([of.score for of in profiles]), information.shape[0]
        rows = jnp.concatenate([information.reshape(outputs**2, -1), score])
        real, imaginary = every.summed(jnp.stack([rows.real, rows.imag]))
        sums = jax.lax.complex(real, imaginary)
        p, score = sums[: outputs**2].reshape(outputs, outputs, -1), sums[outputs**2 :]
        root, target = [], []
        for number in reversed(range(outputs)):  # Cholesky's factors, the last output first
            left = p[number, number].real
            scale = as_complex(jnp.where(left > 0, 1 / jnp.sqrt(jnp.where(left > 0, left, 1)), 0))
            root.append(p[number] * scale[None, :])
            target.append(score[number] * scale)
            p = p - jnp.conj(root[-1])[:, None] * root[-1][None]
            score = score - jnp.conj(root[-1]) * target[-1][None]
        return cls(every.at(profiles[0].gains), jnp.stack(root[::-1]), jnp.stack(target[::-1]))

    def rows(self, changes: Complex[Array, "row output knot"]) -> Float[Array, "row part"]:
        """Changes of the terms by changes of the gains."""
        found = [
            sum(self.root[i, j][None, :] * changes[:, j] for j in range(i + 1))
            for i in range(self.root.shape[0])
        ]
        return -real_parts(jnp.concatenate(found, axis=-1))

    def terms(self, gains: Complex[Array, "output knot"]) -> Float[Array, " part"]:
        """The terms at gains near G₀."""
        return self.rows((gains - self.gains)[None])[0] + self.part

    @property
    def part(self) -> Float[Array, " part"]:
        """The terms at G₀."""
        return real_parts(self.target.reshape(-1))


class Near(eqx.Module):
    """A likelihood near the unknowns q₀.

    Attributes:
        q: q₀.
        profiles: The likelihood of each input and its outputs at all harmonics.
        condensed: The same of all of them at the knots.
        slopes: The gains and their derivatives at the knots.
        by_x: Relative derivatives of X with respect to z at the knots; None if X does not depend
            on z.
    """

    q: Float[Array, " q"]
    profiles: list[Profile]
    condensed: Condensed
    slopes: Slopes
    by_x: Complex[Array, "z knot"] | None = None

    @property
    def profile(self) -> Profile:
        """The likelihood of the only input."""
        (profile,) = self.profiles
        return profile

    @property
    def objective(self) -> Float[Array, ""]:
        """½ Σ r² of the records, at all harmonics."""
        return total([of.objective for of in self.profiles])

    def by_unknown(self, slopes: Slopes) -> Complex[Array, "q output knot"]:
        """Derivatives of G X/X̂ with respect to the unknowns."""
        found = slopes.by_unknown
        if self.by_x is not None:
            z = self.by_x[:, None] * slopes.gains[None]
            found = found.at[found.shape[0] - z.shape[0] :].add(z)
        return found[: self.q.size]

    @property
    def jacobian(self) -> Float[Array, "q part"]:
        """Transposed Jacobian of the condensed terms."""
        return self.condensed.rows(self.by_unknown(self.slopes))


def means(
    profiles: Sequence[Profile], every: Knots, values: Float[Array, "row output harmonic"]
) -> Float[Array, "row part"]:
    """Means of `values` of the innovations for each condensed term, weighted by information."""
    size = total([of.size for of in profiles])
    whole, sums = jnp.split(every.summed(jnp.concatenate([size[None], values * size[None]])), (1,))
    found = sums / jnp.where(whole > 0, whole, 1.0)
    return jnp.tile(found.reshape(values.shape[0], -1), (1, 2))


def apart(evaluate: Callable[[Array], Any], q: Float[Array, " q"]) -> Any:
    """`evaluate(q)`, computed once; NaN if `q` is not finite.

    XLA repeats a computation in every loop that reads its result, here a dozen times. It computes
    the result of a branch only once.
    """
    # JAX remembers the trace of this function, so that branches within branches are traced once.
    once = jax.jit(lambda q: evaluate(q))
    shapes = jax.eval_shape(once, q)

    def nothing(_) -> Any:
        return jax.tree.map(lambda of: jax.lax.full(of.shape, np.nan, of.dtype), shapes)

    return jax.lax.cond(jnp.isfinite(q).all(), once, nothing, q)
