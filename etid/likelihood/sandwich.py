"""The "sandwich": covariance of a fit whose noise differs from the expected noise.

    cov = H⁻¹ (J C Jᵀ + P) H⁻¹,      H = J W Jᵀ + P

J are the derivatives of the terms with respect to the parameters, and C is the variance of each
term. W is the share of signal in each term; without it, noise would count as information. P is the
curvature of the priors, which is also the covariance of their gradient (White 1980, "A
heteroskedasticity-consistent covariance matrix estimator", Econometrica 48).
"""

import dataclasses

import equinox as eqx
from jaxtyping import Float

from etid.precision import namespace
from etid.signals.transfer import AnyArray
from etid.solvers.matrices import inverse, inverse_root


class Curvature(eqx.Module):
    """Both parts of a sandwich; the parts of several recordings are added.

    Attributes:
        expected: H.
        score: J C Jᵀ + P, the covariance of the gradient.
    """

    expected: Float[AnyArray, "n n"]
    score: Float[AnyArray, "n n"]

    def covariance(self) -> Float[AnyArray, "n n"]:
        """H⁻¹ (J C Jᵀ + P) H⁻¹."""
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
        priors: Transposed Jacobian of the terms of the priors; None if they are among the others.
    """

    jacobian: Float[AnyArray, "q term"]
    share: Float[AnyArray, " term"]
    noise: Float[AnyArray, " term"]
    priors: Float[AnyArray, "q prior"] | None = None

    @property
    def precision(self) -> Float[AnyArray, "q q"]:
        """P."""
        if self.priors is None:
            return namespace(self.jacobian).zeros((len(self.jacobian), len(self.jacobian)))
        return self.priors @ self.priors.T

    def curvature(self) -> Curvature:
        """H and J C Jᵀ + P."""
        score = (self.jacobian * self.noise[None, :]) @ self.jacobian.T
        return Curvature(self._expected(), score + self.precision)

    def bread(self) -> Float[AnyArray, "q q"]:
        """H⁻¹, by Cholesky's factors: eigenvectors take five times as long."""
        root = inverse_root(self._expected())
        return root @ root.T

    def covariance(self) -> Float[AnyArray, "q q"]:
        """The sandwich, from the effect of each term on the parameters: loses fewest digits."""
        bread = self.bread()
        by_term = bread @ self.jacobian
        cov = (by_term * self.noise[None, :]) @ by_term.T
        if self.priors is None:
            return cov
        by_prior = bread @ self.priors
        return cov + by_prior @ by_prior.T

    def told(self, rows: Float[AnyArray, "row term"]) -> Float[AnyArray, "row q"]:
        """R W Jᵀ: products of other derivatives R of the terms with those of the parameters."""
        return (rows * self.share[None, :]) @ self.jacobian.T

    def projected(
        self, rows: Float[AnyArray, "row term"], covariance: Float[AnyArray, "q q"] | None = None
    ) -> tuple[Float[AnyArray, "row term"], Float[AnyArray, "row q"]]:
        """Other derivatives R without what the parameters can do of them, and what these do then.

        `covariance` is the inverse of the information if other terms contribute to it.
        """
        others = self.told(rows) @ (self.bread() if covariance is None else covariance)
        return rows - others @ self.jacobian, others

    def first(self, count: int) -> "Linear":
        """The terms with the first parameters alone; the others are known."""
        priors = None if self.priors is None else self.priors[:count]
        return dataclasses.replace(self, jacobian=self.jacobian[:count], priors=priors)

    def along(self, directions: Float[AnyArray, "q z"]) -> "Linear":
        """The terms with coordinates along these directions as parameters."""
        priors = None if self.priors is None else directions.T @ self.priors
        return dataclasses.replace(self, jacobian=directions.T @ self.jacobian, priors=priors)

    def _expected(self) -> Float[AnyArray, "q q"]:
        return self.told(self.jacobian) + self.precision
