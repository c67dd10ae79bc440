"""Score tests whether a load is another circuit than the fitted one.

`etid.circuits.directions` has the changes, and `etid.likelihood.scores` the statistics.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from etid.circuits.directions import DIRECTIONS, named, scored
from etid.likelihood.sandwich import Linear
from etid.likelihood.scores import DOUBTED, GAIN
from etid.signals.transfer import AnyArray

# For a methods section.
NO_OTHER_CIRCUIT = (
    "score tests find no relaxation of the load that is spread over time constants (at most "
    f"{DIRECTIONS['spread'].limit:.2g} standard deviations) and no further relaxation (at most "
    f"{DIRECTIONS['relaxation'].limit:.2g})"
)
NO_OTHER_GAIN = (
    "a score test finds no difference between the gains of the two records (at most "
    f"{DIRECTIONS['gain'].limit:.2g} standard deviations)"
)
NOTHING = 1e-9  # of the power of a change; rounding leaves less of one that the circuit can make


class Score(NamedTuple):
    """Scores of changes of one kind for one residual.

    Attributes:
        z: Standard deviations; NaN if the circuit can make the change itself.
        size: Estimate of ε.
        moved: Largest change of the logarithm of an element by this ε.
        stderr: Standard error of ε.
        slope: Change of the logarithm of each element for each unit of ε.
        others: What the parameters do of the change.
    """

    z: Float[Array, "*change"]
    size: Float[Array, "*change"]
    moved: Float[Array, "*change"]
    stderr: Float[Array, "*change"]
    slope: Float[Array, "*change element"]
    others: Float[Array, "*change q"]

    def possible(self) -> tuple[Float[Array, "*change"], Float[Array, "*change element"]]:
        """Standard errors of ε, and slopes of the elements; 0 if the circuit makes the change."""
        finite = jnp.isfinite(self.z) & jnp.isfinite(self.stderr)
        stderr = jnp.where(finite, self.stderr, 0.0)
        return stderr, jnp.where(finite[..., None], self.slope, 0.0)

    def would_show(self, powers: Float[AnyArray, " element"]) -> Float[Array, ""]:
        """Standard deviations of one change with ε = 1, if no element would be negative then.

        Z is linear in R and in 1/C, whose logarithms are those of the elements times `powers`.

        Returns:
            Infinity if R or 1/C would be negative; 0 if the circuit can make the change itself.
        """
        negative = jnp.min(self.slope * powers) < -1
        deviations = jnp.where(negative, jnp.inf, 1 / self.stderr)
        return jnp.where(jnp.isfinite(self.z), deviations, 0.0)

    def doubt(self) -> tuple[Bool[Array, ""], Float[Array, "element element"]]:
        """Whether a gain is likely, and the covariance that it then adds.

        One standard deviation of the logarithms of the elements is what they change by its mean,
        given the score and a prior of width `GAIN`.
        """
        likely = jnp.abs(self.z) > DOUBTED
        mean = self.size / (1 + (self.stderr / GAIN) ** 2)
        moved = jnp.where(likely, mean, 0.0) * self.slope
        return likely, jnp.outer(moved, moved)


class Scores(NamedTuple):
    """Scores of all changes for one residual.

    Attributes:
        each: Scores of each of `scored`.
    """

    each: Mapping[str, Score]

    @classmethod
    def of(cls, scores: Score, currents: int) -> "Scores":
        """Name the scores of `scored`, in their order, with so many scales of currents."""
        counts = [currents if DIRECTIONS[n].of_others else DIRECTIONS[n].count for n in scored()]
        ends = np.cumsum(counts).tolist()
        places = zip(scored(), map(slice, [0, *ends[:-1]], ends), strict=True)
        return cls({n: jax.tree.map(lambda leaf, at=at: leaf[at], scores) for n, at in places})

    def of_one(self, name: str) -> Score:
        """The score of a change of which there is one."""
        return jax.tree.map(lambda leaf: leaf[0], self.each[name])

    def _seen(self, names: Iterable[str]) -> Bool[Array, ""]:
        each = [DIRECTIONS[name].seen(*self.each[name][:3]) for name in names]
        return jnp.any(jnp.concatenate(each))

    def seen(self) -> Bool[Array, ""]:
        """Whether the scores show another circuit."""
        return self._seen(n for n in self._of("misfit") if DIRECTIONS[n].of_circuit)

    def relevant(self) -> Float[Array, " change"]:
        """Z of all changes that have a name; 0 if a change is too small to matter."""
        each = [DIRECTIONS[name].relevant(*self.each[name][:3]) for name in named()]
        return jnp.concatenate(each)

    def _of(self, verdict: str) -> list[str]:
        return [name for name in self.each if DIRECTIONS[name].verdict == verdict]

    @property
    def misfit(self) -> Bool[Array, ""]:
        """Whether the scores show another circuit, or a fault of V_out."""
        return self._seen(self._of("misfit"))

    @property
    def inconsistent(self) -> Bool[Array, ""]:
        """Whether the scale of a measured current is wrong."""
        return self._seen(self._of("inconsistent"))

    def doubt(self) -> tuple[Bool[Array, ""], Float[Array, "element element"]]:
        """`Score.doubt` of the gain; none if it is proven, for then the fit is a misfit."""
        likely, cov = self.of_one("gain").doubt()
        proven = self._seen(["gain"])
        return likely & ~proven, jnp.where(proven, 0.0, cov)


class Fitted(NamedTuple):
    """The parameters of a fit, as scores of further ones see them.

    Attributes:
        pull: Gradient of the priors.
        spread: Covariance of this gradient.
        covariance: Inverse of the information, including that of other terms.
        elements: Slice of the parameters that are the logarithms of the elements.
    """

    pull: Float[Array, " q"]
    spread: Float[Array, "q q"]
    covariance: Float[Array, "q q"]
    elements: slice


def scores(
    rows: Float[Array, "change term"],
    linear: Linear,
    residual: Float[Array, " term"],
    fitted: Fitted,
) -> Score:
    """Score of each change.

    The parameters need not be at a minimum: the part of the residual that they could still explain
    is projected out (Neyman's C(α)).

    Args:
        rows: Derivatives of the residual with respect to ε.
        linear: The terms, linear in the parameters.
        residual: Residual [standard deviations].
        fitted: The parameters.
    """
    directions, others = linear.projected(rows, fitted.covariance)
    score = directions @ residual - others @ fitted.pull
    # Matrix products take a fifth of the time of sums.
    of_priors = jnp.sum((others @ fitted.spread) * others, axis=1)
    variance, curvature = (
        directions**2 @ jnp.stack([linear.noise, linear.share], axis=1)
    ).T + of_priors[None]
    can = curvature <= NOTHING * (rows**2 @ linear.share)
    size = score / curvature
    slope = -others[:, fitted.elements]
    moved = jnp.abs(size) * jnp.max(jnp.abs(slope), axis=1)
    deviation = jnp.sqrt(variance)
    z = jnp.where(can, jnp.nan, score / deviation)
    return Score(z, size, moved, deviation / curvature, slope, others)
