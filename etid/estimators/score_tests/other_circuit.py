"""Score tests whether a load is another circuit than the fitted one.

Let Z be the fitted impedance, and r the residual in standard deviations. Rao's score test checks
whether r correlates with a change of Z that the circuit cannot make. Let d be the derivative of r
with respect to the size ε of the change, with the effect of the other parameters projected out. If
the circuit is right, z = d·r / σ(d·r) is normal. The test detects changes that χ² over all
harmonics does not show. There are two kinds of change.

**A relaxation that is spread over time constants.** The most common model of skin that is not one
RC is that of Cole (1940). It replaces jω by (jω)^α; α = 1 is the circuit itself:

    ∂Z/∂α = s ln s dZ/ds.

At 40 dB, α = 0.9 changes R_s by a quarter of its value; χ² is 1.1 and z above 10. A circuit with
its own α can make this change itself. For such a circuit the test checks whether the spread is
symmetric. Cole's spread is symmetric; that of Davidson and Cole (1951) is not. ln s becomes
ln s + ε ln² (s/s₀) around the middle s₀ of the band, and

    ∂Z/∂ε = s ln² (s/s₀) dZ/ds.

**One more relaxation**, ΔZ = ε |Z(j/τ)| / (1 + sτ), for each τ of a grid that exceeds the band.
This test also has power if dZ/ds = 0, as for a resistor. A change that the circuit can make itself
is no evidence: d vanishes. An example is a relaxation with a τ that the circuit has already.

The same score also tests for another gain of V_out, which is no change of the circuit. Most gains
of 1 % are not seen at 40 dB, and would change R_p of dry skin by 14 %. What the score shows of a
gain without proving it goes into the standard errors.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.impedance import AbstractImpedance
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests import SEEN
from etid.likelihood.fit import DOUBTED, GAIN, MOVED, SCALE, SEEN_RELAXATION, SPREAD
from etid.signals.transfer import AnyArray, as_complex, combined, frequency_variable

# For a methods section.
NO_OTHER_CIRCUIT = (
    "score tests find no relaxation of the load that is spread over time constants (at most "
    f"{SEEN:g} standard deviations) and no further relaxation (at most {SEEN_RELAXATION:g})"
)
NO_OTHER_GAIN = (
    "a score test finds no difference between the gains of the two records (at most "
    f"{SEEN:g} standard deviations)"
)
GRID = 7  # time constants, two per decade; a relaxation is wider than that
BEYOND = 2.0  # factor by which they exceed the band
# Faster relaxations of a layer of diffusion, by √(τ₁/τ). The rest adds 3 % of R_p to R_s.
FASTER = np.arange(3.0, 17.0, 2.0)
NOTHING = 1e-9  # of the power of a change; rounding leaves less of one that the circuit can make


def changes(
    impedance: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> tuple[Complex[Array, " harmonic"], Complex[Array, "change harmonic"]]:
    """Z and ∂Z/∂ε [Ω] of all changes at real frequencies [Hz]; the first is the spread."""
    z, by_spread = spread(impedance, frequency)
    corner, level = relaxations(impedance, frequency[0], frequency[-1])
    x = frequency_variable(frequency).imag[None, :] * (1 / corner)[:, None]
    real = level[:, None] / (1 + x**2)
    return z, jnp.concatenate([by_spread[None, :], jax.lax.complex(real, -x * real)])


def spread(
    impedance: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> tuple[Complex[Array, " harmonic"], Complex[Array, " harmonic"]]:
    """Z, and ∂Z/∂α, or ∂Z/∂ε of a circuit that has an α [Ω]."""
    s = frequency_variable(frequency)
    log_s = jax.lax.complex(jnp.log(s.imag), jnp.full_like(frequency, jnp.pi / 2))
    if impedance.exponents():
        log_s = log_s - as_complex((log_s.real[0] + log_s.real[-1]) / 2)
        log_s = log_s * log_s
    return jax.jvp(impedance, (s,), (s * log_s,))


def relaxations(
    impedance: AbstractImpedance, lowest: Float[Array, ""], highest: Float[Array, ""]
) -> tuple[Float[Array, " relaxation"], Float[Array, " relaxation"]]:
    """1/τ [rad/s] and |Z(j/τ)| [Ω] of the relaxations for a band [Hz]."""
    corner = 2 * jnp.pi * jnp.geomspace(lowest / BEYOND, highest * BEYOND, GRID)
    return corner, jnp.abs(impedance(jax.lax.complex(jnp.zeros_like(corner), corner)))


def layer(
    impedance: AbstractImpedance, frequency: Float[Array, " harmonic"]
) -> Complex[Array, " harmonic"]:
    """∂Z/∂ε [Ω] that turns, at ε = 1, each relaxation into a layer through which charge diffuses.

    Such a layer, tanh √(sτ) / √(sτ), is a slow relaxation, a ninth of it that is nine times as
    fast, a 25th of it that is 25 times as fast, and so on. With Z(0) as it is,

        ∂Z/∂ε = Σ (Z(s/n²) − Z(s)) / n² / (1 + Σ 1/n²),      n = 3, 5, 7, …
    """
    s, shares = frequency_variable(frequency), jnp.asarray(FASTER**-2)
    faster = impedance(as_complex(shares)[:, None] * s[None, :]) - impedance(s)[None, :]
    return combined(shares / (1 + shares.sum()), faster)


class Score(NamedTuple):
    """Scores of changes of one kind for one residual.

    Attributes:
        z: Standard deviations; NaN if the circuit can make the change itself.
        size: Estimate of ε.
        moved: Largest change of the logarithm of an element by this ε.
        stderr: Standard error of ε.
        slope: Change of the logarithm of each element for each unit of ε.
    """

    z: Float[Array, "*change"]
    size: Float[Array, "*change"]
    moved: Float[Array, "*change"]
    stderr: Float[Array, "*change"]
    slope: Float[Array, "*change element"]

    def exceeds(self, limit: float) -> Bool[Array, "*change"]:
        """Whether z exceeds this limit and the change moves an element."""
        return (jnp.abs(self.z) > limit) & (self.moved > MOVED)

    def relevant(self) -> Float[Array, "*change"]:
        """z; 0 if the change moves no element or if the circuit can make it itself."""
        return jnp.where(self.moved > MOVED, jnp.nan_to_num(self.z), 0.0)

    def possible(self) -> tuple[Float[Array, "*change"], Float[Array, "*change element"]]:
        """Standard errors of ε, and slopes of the elements; 0 if the circuit makes the change."""
        tested = jnp.isfinite(self.z) & jnp.isfinite(self.stderr)
        stderr = jnp.where(tested, self.stderr, 0.0)
        return stderr, jnp.where(tested[..., None], self.slope, 0.0)

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

    def contradicts(self) -> Bool[Array, "*change"]:
        """Whether the scale of a measured current is wrong; all changes must be such scales."""
        return (jnp.abs(self.z) > SEEN) & (self.moved > SCALE)

    def relaxes(self) -> Bool[Array, ""]:
        """Whether one more relaxation is seen; all changes must be relaxations."""
        return jnp.any(self.exceeds(SEEN_RELAXATION))


class Scores(NamedTuple):
    """Scores of all changes for one residual.

    Attributes:
        spread: Score of the spread.
        relaxation: Scores of one more relaxation, for each time constant.
        gain: Score of the gain of V_out.
    """

    spread: Score
    relaxation: Score
    gain: Score

    @classmethod
    def of(cls, scores: Score) -> "Scores":
        """Name the scores of all `changes`, which that of a gain follows."""

        def part(which: int | slice) -> Score:
            return jax.tree.map(lambda leaf: leaf[which], scores)

        return cls(part(0), part(slice(1, -1)), part(-1))

    def seen(self) -> Bool[Array, ""]:
        """Whether the scores show another circuit."""
        spread = (jnp.abs(self.spread.z) > SEEN) & (jnp.abs(self.spread.size) > SPREAD)
        return spread | self.relaxation.relaxes()

    def relevant(self) -> Float[Array, " change"]:
        """Z of all changes; 0 if a change is too small to matter."""
        spread = jnp.where(jnp.abs(self.spread.size) > SPREAD, self.spread.z, 0.0)
        parts = jnp.nan_to_num(spread), self.relaxation.relevant(), self.gain.relevant()
        return jnp.concatenate([jnp.atleast_1d(part) for part in parts])

    def has_other_gain(self) -> Bool[Array, ""]:
        """Whether the score shows that V_out and V_th have different gains."""
        return self.gain.exceeds(SEEN)

    @property
    def misfit(self) -> Bool[Array, ""]:
        """Whether the scores show another circuit or another gain of V_out."""
        return self.seen() | self.has_other_gain()

    def doubt(self) -> tuple[Bool[Array, ""], Float[Array, "element element"]]:
        """`Score.doubt` of the gain; none if it is proven, for then the fit is a misfit."""
        likely, cov = self.gain.doubt()
        proven = self.has_other_gain()
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
    return Score(z, size, moved, deviation / curvature, slope)
