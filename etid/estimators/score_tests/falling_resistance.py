"""Score test whether the resistance of a load falls with its current.

To first order in 1/I_0, a resistor R / (1 + |i|/I_0) adds the voltage −|u| u / (R I_0) to its own
voltage u. The rest of the circuit filters it like the voltage of the relaxations, and the feed
like a change of Z_L. This signal is no change of an impedance: harmonics mix. The test asks whether
the residual correlates with the part of it that no unknown of the fit can make (Rao's score test,
as in `etid.estimators.score_tests.other_circuit`).

The current is that of the pulse, whose shape the first harmonics give.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.directions import DIRECTIONS
from etid.estimators.maximum_likelihood.condensed import Near
from etid.estimators.score_tests.other_circuit import Fitted
from etid.likelihood.fit import SHARE, UNSURE
from etid.likelihood.scores import FINE, HARMONICS
from etid.signals.knots import Knots
from etid.signals.transfer import as_complex, power, reciprocal

NO_FALL = (  # for a methods section
    "a score test finds no resistance of the load that falls with its current (at most "
    f"{DIRECTIONS['falling'].limit:.2g} standard deviations)"
)


class Falling(NamedTuple):
    """Score of a resistance that falls with its current.

    Attributes:
        z: Standard deviations, positive for a fall; NaN if the circuit can make the change itself.
        moved: Largest change of the logarithm of an element by the fall.
        explained: Part of Σ r² that the fall explains.
    """

    z: Float[Array, ""]
    moved: Float[Array, ""]
    explained: Float[Array, ""]

    def seen(self) -> Bool[Array, ""]:
        """Whether the resistance falls, and the fall moves an element."""
        row = DIRECTIONS["falling"]
        return (self.z > row.limit) & (self.moved > row.moves)

    def causes(
        self, squares: Float[Array, ""], terms: Float[Array, ""], others: Float[Array, " change"]
    ) -> Bool[Array, ""]:
        """Whether the fall is seen and explains most of the excess of Σ r² over its terms.

        `others` are the scores of other changes [standard deviations].
        """
        excess = squares - terms - UNSURE * jnp.sqrt(2 * terms)
        most = self.z >= jnp.max(jnp.abs(others))
        return self.seen() & most & (self.explained > SHARE * excess)


def added_voltage(
    v_out: Complex[Array, " harmonic"],
    z: Complex[Array, " knot"],
    sensitivity: Complex[Array, "output knot"],
    knots: Knots,
) -> Complex[Array, "output harmonic"]:
    """What a falling resistance adds to the outputs, for 1 / (R I_0) = 1 / V.

    Args:
        v_out: V_out [V] at the harmonics.
        z: Z_L [Ω] at the knots.
        sensitivity: Change of each output at the knots, for a voltage of Z_L that is larger by 1 V.
        knots: The knots of the harmonics.
    """
    relaxing = z - as_complex(z[-1].real)  # without the series resistor
    count = min(HARMONICS, v_out.size)
    u = (v_out * knots.between(relaxing * reciprocal(z)))[:count]
    # There is no direct voltage behind a transformer, or with charge-balanced pulses.
    points = jnp.fft.irfft(jnp.pad(u, (1, 0)), 2 * FINE * count, norm="forward")
    added = jnp.fft.rfft(-jnp.abs(points) * points, norm="forward")[1 : count + 1]
    added = jnp.pad(added, (0, v_out.size - count))
    return added[None, :] * knots.between(sensitivity * relaxing[None, :])


def score(
    added: Complex[Array, "output harmonic"],
    near: Near,
    knots: Knots,
    share: Float[Array, " harmonic"],
    noise: Float[Array, "output harmonic"],
    fitted: Fitted,
) -> Falling:
    """Score of a change of the outputs, `added` for each unit of ε.

    `share` is that of the signal in the power of X, `noise` the variances of the innovations
    relative to those expected.
    """
    profile, slopes = near.profile, near.by_unknown(near.slopes)
    weighted = profile.weighted(profile.whitened(added))
    parts = knots.summed(jnp.conj(weighted) * (profile.x * as_complex(share))[None, :]).ravel()
    rows = slopes.reshape(slopes.shape[0], -1)
    others = (rows.real @ parts.real - rows.imag @ parts.imag) @ fitted.covariance
    made = jax.lax.complex(others @ rows.real, others @ rows.imag).reshape(slopes.shape[1:])
    direction = added - profile.x[None, :] * knots.between(made)
    total = jnp.sum((jnp.conj(direction) * profile.pull).real) + jnp.dot(others, fitted.pull)
    of_priors = others @ fitted.spread @ others
    squares = profile.weight * power(profile.whitened(direction))
    variance = jnp.sum(squares * noise) + of_priors
    curvature = jnp.sum(squares * share[None, :]) + of_priors
    return Falling(
        total / jnp.sqrt(variance),
        jnp.abs(total) / curvature * jnp.max(jnp.abs(others[fitted.elements])),
        total**2 / curvature,
    )
