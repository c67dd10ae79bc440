"""Test whether the gain of V_out, or the amplitude of the pulses, is another one than stated.

A wrong gain 1 + g lies nearly in the span of the elements: 1 % moves R_p of dry skin by 20 %, and
χ² of a pulse hardly shows it. Rao's score test finds what the elements and the delay of the pulse
cannot imitate. Let r be the residual of a pulse in standard deviations, J its derivatives with
respect to elements and delay, and d = G √w / σ. Then

    d⊥ = d − Jᵀ (J Jᵀ)⁻¹ J d,      s = d⊥ᵀ r,      I = d⊥ᵀ d⊥

are the score of g and its information. Elements and delay are free in each pulse, so that the
scores do not depend on how the skin varies. While g is 0, those of different pulses have the mean 0
and the variance I, and are independent but for the error of Z_th and the noise of the unloaded
record. This part of s, with the standard deviation c, does not average out. With the sums over the
pulses since the electrode began anew,

    z² = (Σs)² / (ΣI + (Σc)²)

has at most the distribution χ² with one degree of freedom. A gain g₀ that moves an element by
`MOVED` does not matter (`etid.estimators.score_tests.other_circuit`), and instruments have smaller
ones, which many pulses show. So a gain is wrong if it exceeds this one:

    |Σs| − g₀ ΣI  >  SEEN_GAIN √(ΣI + (Σc)²).

As in a fit of a whole record, the verdict is then `misfit`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.score_tests.other_circuit import MOVED
from etid.online.pulse_fit import Expected, Pulse
from etid.signals.harmonics import real_parts
from etid.signals.transfer import as_complex, power

SEEN_GAIN = 5.3  # standard deviations that noise exceeds once in 10⁷ pulses


class GainScore(NamedTuple):
    """Score of the gain of one pulse, and sums of several.

    Attributes:
        sums: s, I and c.
        moved: Change of the logarithms of the elements for each unit of g.
    """

    sums: Float[Array, "*lane 3"]
    moved: Float[Array, "*lane element"]

    @classmethod
    def of(
        cls,
        pulse: Pulse,
        variance: Float[Array, ""],
        expected: Expected,
        residual: Float[Array, " part"],
        inverse: Float[Array, "own own"],
    ) -> "GainScore":
        """The score of a pulse.

        Args:
            pulse: The objective.
            variance: E|noise|² of a Fourier coefficient of V_out [V²].
            expected: Gain near the minimum.
            residual: Residual at the minimum, but for a step along the elements and the delay.
            inverse: (J Jᵀ)⁻¹.
        """
        gain, model = expected.gain, pulse.model
        weighted = gain * as_complex(jnp.sqrt(pulse.weight))
        jacobian, along = pulse.jacobian(expected), real_parts(weighted)
        others = inverse @ (jacobian @ along)
        d = along - others @ jacobian
        score, information = d @ residual, d @ d
        freedom = 2 * jnp.sum(pulse.weight > 0, dtype=score.dtype) - others.size - 1
        chi2 = (residual @ residual - score**2 / information) / freedom
        # ∂G/∂ log Z_th = −G (1 − G)
        towards = jax.lax.complex(*jnp.split(d, 2)) * jnp.conj(weighted * (1 - gain))
        of_source = model.source_error.real @ towards.real + model.source_error.imag @ towards.imag
        of_x = power(gain) * model.bands.variance_x / variance
        common = jnp.sqrt(of_source @ of_source + d**2 @ jnp.tile(of_x, 2))
        # More noise than stated lessens the weight of a pulse, as it does in a fit of a record.
        sums = jnp.stack([score, information, common]) / jnp.maximum(chi2, 1.0)
        return cls(sums, -others[:-1])

    def wrong(self) -> Bool[Array, ""]:
        """Whether sums over pulses show another gain that matters."""
        score, information, common = self.sums
        scatter = jnp.sqrt(information + common**2)
        moved = jnp.max(jnp.abs(self.moved))
        return moved * (jnp.abs(score) - SEEN_GAIN * scatter) > MOVED * information
