"""The "sandwich": covariance of a fit whose noise differs from the expected noise.

    cov = H⁻¹ (J C Jᵀ) H⁻¹,      H = J W Jᵀ + P

J are the derivatives of the terms with respect to the parameters, and C is the variance of each
term. W is the share of signal in each term; without it, noise would count as information. P is the
curvature of the priors that are not among the terms (White 1980, "A heteroskedasticity-consistent
covariance matrix estimator", Econometrica 48).
"""

import dataclasses

import equinox as eqx
from jaxtyping import Array, Float

from etid.solvers.matrices import inverse, inverse_root


class Curvature(eqx.Module):
    """Both parts of a sandwich; the parts of several recordings are added.

    Attributes:
        expected: H.
        score: J C Jᵀ, the covariance of the gradient.
    """

    expected: Float[Array, "n n"]
    score: Float[Array, "n n"]

    def covariance(self) -> Float[Array, "n n"]:
        """H⁻¹ (J C Jᵀ) H⁻¹."""
        bread = inverse(self.expected)
        return bread @ self.score @ bread

    def eliminate(self, kept: int) -> "Curvature":
        """Project out all but the first `kept` parameters: the nuisances of one recording."""
        h, m = self.expected, self.score
        k = -inverse(h[kept:, kept:], drop=True) @ h[kept:, :kept]
        return Curvature(
            h[:kept, :kept] + h[:kept, kept:] @ k,
            m[:kept, :kept]
            + m[:kept, kept:] @ k
            + k.T @ m[kept:, :kept]
            + k.T @ m[kept:, kept:] @ k,
        )


class Linear(eqx.Module):
    """Terms of a likelihood around its minimum, linear in the parameters.

    Attributes:
        jacobian: J.
        share: Diagonal of W.
        noise: Diagonal of C.
        prior: P; None if all priors are among the terms.
    """

    jacobian: Float[Array, "q term"]
    share: Float[Array, " term"]
    noise: Float[Array, " term"]
    prior: Float[Array, "q q"] | None = None

    def curvature(self) -> Curvature:
        """H and J C Jᵀ."""
        return Curvature(self._expected(), (self.jacobian * self.noise[None, :]) @ self.jacobian.T)

    def bread(self) -> Float[Array, "q q"]:
        """H⁻¹, by Cholesky's factors: eigenvectors take five times as long."""
        root = inverse_root(self._expected())
        return root @ root.T

    def covariance(self) -> Float[Array, "q q"]:
        """The sandwich, from the effect of each term on the parameters: loses fewest digits."""
        by_term = self.bread() @ self.jacobian
        return (by_term * self.noise[None, :]) @ by_term.T

    def told(self, rows: Float[Array, "row term"]) -> Float[Array, "row q"]:
        """R W Jᵀ: products of other derivatives R of the terms with those of the parameters."""
        return (rows * self.share[None, :]) @ self.jacobian.T

    def projected(
        self, rows: Float[Array, "row term"], covariance: Float[Array, "q q"] | None = None
    ) -> tuple[Float[Array, "row term"], Float[Array, "row q"]]:
        """Other derivatives R without what the parameters can do of them, and what these do then.

        `covariance` is the inverse of the information if other terms contribute to it.
        """
        others = self.told(rows) @ (self.bread() if covariance is None else covariance)
        return rows - others @ self.jacobian, others

    def along(self, directions: Float[Array, "q z"]) -> "Linear":
        """The terms with coordinates along these directions as parameters, without a prior."""
        return dataclasses.replace(self, jacobian=directions.T @ self.jacobian, prior=None)

    def _expected(self) -> Float[Array, "q q"]:
        told = self.told(self.jacobian)
        return told if self.prior is None else told + self.prior
