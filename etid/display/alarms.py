"""Tests of the pulses: for a change of skin or driver, for another gain, and for another circuit.

**The innovation** of a pulse is the difference between the logarithms of the elements that this
pulse alone shows and their prediction:

    d = ϑ̂ − ϑ⁻,    S = cov d = H⁻¹ + Λ⁻⁻¹

with the symbols of `etid.display.tracker`. While the skin varies as the tracker expects, the
innovations of different pulses are independent, with mean 0 (Mehra and Peschon 1971). With the
posterior ϑ = ϑ⁻ + (Λ⁻ + H)⁻¹ H d, S⁻¹ d is Λ⁻ (ϑ − ϑ⁻).

**Jump.** The generalised likelihood ratio of a change between this pulse and the one before is
T = dᵀ S⁻¹ d (Willsky and Jones 1976). Its distribution is χ² with one degree of freedom per
element. An electrode whose T exceeds the limit, or whose pulse does not fit at all, is identified
anew from this pulse alone. It is a jump if the new elements explain the pulse and their T exceeds
the limit as well.

**Drift.** A slow change hides in the noise of a pulse, but not in a moving mean of innovations:

    m ← (1 − λ) m + λ d,    P ← (1 − λ)² P + λ² S,    Q = mᵀ P⁻¹ m

(multivariate exponentially weighted moving average, Lowry et al. 1992; P is computed, so that the
chart holds from its first pulse on). Q has the distribution of T.

**Element.** A change of element j alone explains (e_jᵀ S⁻¹ d)² / (e_jᵀ S⁻¹ e_j) of T. The element
that explains most is reported.

**Driver.** A change of Z_th by a factor moves the elements of all electrodes along one direction a,
the powers of impedance to which the elements are proportional. z = aᵀS⁻¹d / √(aᵀS⁻¹a) is a normal
variable for each electrode. Its deciles over n electrodes are ±1.282, with the standard deviation
1.709/√n. A change is the driver's if nine tenths of the z lie on one side: if the lower decile
of z, or of the z of the moving means, is `DRIVER` standard deviations above −1.282, or the upper
one as far below 1.282. Half of the electrodes cannot do this. It is also the driver's if more than
half of the electrodes jump at once. Skin that changes at all electrodes at once looks the same.

**Gain.** A wrong gain 1 + g of V_out, or of the amplitude, lies nearly in the span of the elements:
1 % moves R_p of dry skin by 20 %, and χ² of a pulse hardly shows it. Rao's score test finds what
the elements and the delay of the pulse cannot imitate. Let r be the residual of a pulse in standard
deviations, J its derivatives with respect to elements and delay, and d = G √w / σ. Then

    d⊥ = d − Jᵀ (J Jᵀ)⁻¹ J d,      s = d⊥ᵀ r,      I = d⊥ᵀ d⊥

are the score of g and its information. Elements and delay are free in each pulse, so that the
scores do not depend on how the skin varies. While g is 0, those of different pulses have the mean 0
and the variance I, and are independent but for the error of Z_th, the tolerances of the instrument
and the noise of the unloaded record. This part of s, with the standard deviation c, does not
average out. With the sums over the pulses since the electrode began anew,

    z² = (Σs)² / (ΣI + (Σc)²)

has at most the distribution χ² with one degree of freedom. A gain g₀ that moves an element by
`MOVED` does not matter (`etid.circuits.directions`), and instruments have smaller
ones, which many pulses show. So a gain is wrong if it exceeds this one:

    |Σs| − g₀ ΣI  >  SEEN_IN_PULSES √(ΣI + (Σc)²).

As in a fit of a whole record, the verdict is then `misfit`.

**Another circuit.** Skin whose time constants are spread (Cole 1940) hides in the same way: with
α = 0.98, R_s is a tenth off at a χ² that may be noise. Its score is that of the gain with
d = ∂G/∂α √w / σ, and a spread below `SPREAD` does not matter.
"""

from typing import NamedTuple

import jax.numpy as jnp
import scipy
from jaxtyping import Array, Bool, Float, Int

from etid.display.pulse_fit import Expected, Pulse
from etid.estimators.online import MOVED, SEEN_IN_PULSES, SPREAD
from etid.likelihood.scores import NOTHING, Scores
from etid.precision import namespace
from etid.signals.transfer import AnyArray
from etid.solvers.matrices import inverse_of_few

FALSE_ALARMS = 0.05  # per electrode and hour, expected if T and Q have exactly their distributions
WEIGHT = 0.1  # λ, of the newest innovation in the moving mean
DRIVER = 9.0  # standard deviations; no false alarm is expected in a year
COMMON = 8  # electrodes that are needed to tell the driver from the skin


def limit(elements: int, pulse_rate: float) -> float:
    """Value that T and Q exceed `FALSE_ALARMS` times per hour together.

    Args:
        elements: Number of elements of the circuit.
        pulse_rate: Pulses per second [Hz].
    """
    return float(scipy.special.chdtri(elements, FALSE_ALARMS / 2 / (3600 * pulse_rate)))


class Innovation(NamedTuple):
    """Difference between a pulse and its prediction.

    Attributes:
        d: New minus predicted logarithms.
        weight: S⁻¹.
        cov: S.
    """

    d: Float[Array, " element"]
    weight: Float[Array, "element element"]
    cov: Float[Array, "element element"]

    @classmethod
    def of(
        cls,
        d: Float[Array, " element"],
        spread: Float[Array, "element element"],
        information: Float[Array, "element element"],
    ) -> "Innovation":
        """The innovation.

        Args:
            d: Elements by the pulse alone minus predicted elements.
            spread: Covariance of the elements by the pulse alone, H⁻¹.
            information: Inverse covariance of the prediction, Λ⁻; not singular.
        """
        cov = spread + inverse_of_few(information)
        return cls(d, inverse_of_few(cov), cov)

    def statistic(self) -> Float[Array, ""]:
        """T."""
        return self.d @ self.weight @ self.d

    def element(self) -> Int[Array, ""]:
        """Number of the element whose change alone explains most of T."""
        return jnp.argmax((self.weight @ self.d) ** 2 / jnp.diagonal(self.weight))

    def along(self, direction: Float[Array, " element"]) -> Float[Array, ""]:
        """Component along a direction [standard deviations]."""
        weighted = self.weight @ direction
        return weighted @ self.d / jnp.sqrt(weighted @ direction)


def averaged(
    mean: Float[Array, " element"], cov: Float[Array, "element element"], new: Innovation
) -> Innovation:
    """The moving mean of the innovations after one more of them."""
    cov = (1 - WEIGHT) ** 2 * cov + WEIGHT**2 * new.cov
    return Innovation((1 - WEIGHT) * mean + WEIGHT * new.d, inverse_of_few(cov), cov)


def driver_change(
    jumped: Bool[Array, " lane"],
    z: Float[Array, "test lane"],
    counts: Bool[Array, " lane"],
    running: Bool[Array, " lane"],
) -> Bool[Array, ""]:
    """Whether the electrodes have changed together.

    Args:
        jumped: Electrodes that have jumped.
        z: z of the innovation and of the moving mean.
        counts: Electrodes that have a prediction, touch something, and keep their amplitude.
        running: Electrodes that have a prediction. If only a few of them count, these are the ones
            in trouble while the amplitude of the others rises.
    """
    number = jnp.sum(counts, dtype=float)
    limit = DRIVER * 1.709 / jnp.sqrt(jnp.maximum(number, 1.0)) - 1.282
    above, below = (
        jnp.sum(counts[None, :] & of, axis=1, dtype=float) for of in (z > limit, z < -limit)
    )
    moved = jnp.any(jnp.maximum(above, below) >= jnp.floor(0.9 * number))
    enough = (number >= COMMON) & (number > jnp.sum(running, dtype=float) / 2)
    return enough & (moved | (jnp.sum(jumped & counts, dtype=float) > number / 2))


class PulseScores(NamedTuple):
    """Scores of a gain and of a spread of one pulse, and sums of several.

    Attributes:
        sums: s, I and c of each.
        moved: Change of the logarithms of the elements for each unit of the gain.
    """

    sums: Float[Array, "*lane change 3"]
    moved: Float[Array, "*lane element"]

    @classmethod
    def of(
        cls,
        pulse: Pulse,
        expected: Expected,
        residual: Float[Array, " part"],
        inverse: Float[Array, "own own"],
    ) -> tuple["PulseScores", Float[Array, " part"]]:
        """The scores of a pulse, and the residual that neither a gain nor a spread explains.

        Args:
            pulse: The objective.
            expected: Gain near the minimum.
            residual: Residual at the minimum.
            inverse: (J Jᵀ)⁻¹.
        """
        gain = expected.gain
        jacobian = pulse.jacobian(expected)
        along = pulse.whitened(jnp.stack([gain, expected.spread]))
        others = along @ jacobian.T @ inverse
        d = along - others @ jacobian
        score, information = d @ residual, jnp.sum(d**2, axis=1)
        tested = information > NOTHING * jnp.sum(along**2, axis=1)
        freedom = 2 * jnp.sum(pulse.weight > 0, dtype=score.dtype) - others.shape[1] - 1
        explained = score**2 / jnp.where(tested, information, 1.0)
        chi2 = (residual @ residual - explained) / freedom
        of_source = pulse.errors_along(gain, d)
        common = jnp.sqrt(jnp.sum(of_source**2, axis=1) + d**2 @ pulse.by_x(gain))
        # More noise than stated lessens the weight of a pulse, as it does in a fit of a record.
        sums = jnp.stack([score, information, common], axis=1) / jnp.maximum(chi2, 1.0)[:, None]
        left = residual
        for row, used in zip(d, tested, strict=True):
            size = jnp.where(used, jnp.dot(row, row), jnp.inf)
            left = left - row * jnp.dot(row, left) / size
        return cls(jnp.where(tested[:, None], sums, 0.0), -others[0, :-1]), left

    def wrong(self) -> Bool[Array, ""]:
        """Whether sums over pulses show another gain, or a spread, that matters."""
        size, stderr = estimate(self.sums)
        allowed = jnp.stack([MOVED / jnp.max(jnp.abs(self.moved)), jnp.asarray(SPREAD)])
        return jnp.any(jnp.abs(size) - SEEN_IN_PULSES * stderr > allowed)


def estimate(
    sums: Float[AnyArray, "*change 3"],
) -> tuple[Float[AnyArray, "*change"], Float[AnyArray, "*change"]]:
    """Estimate of a change from its sums s, I and c, and its standard error; 0 if I is 0."""
    xp, (score, information, common) = namespace(sums), (sums[..., part] for part in range(3))
    known = xp.where(information > 0, information, xp.inf)
    return score / known, xp.sqrt(information + common**2) / known


def score_of(sums: Float[AnyArray, "*row 3"], slope: Float[AnyArray, "*row element"]) -> Scores:
    """The score of a change from its sums s, I and c, and the slopes of the elements."""
    xp, (size, stderr) = namespace(sums), estimate(sums)
    moved, z = xp.abs(size) * xp.abs(slope).max(-1), size / stderr
    return Scores(z, size, moved, stderr, slope, slope, z**2)
