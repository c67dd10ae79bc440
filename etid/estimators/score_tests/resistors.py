"""Score test whether the known resistors of the calibrations agree.

Only ratios to Z_th are observable. The error of a single resistor is therefore not visible: Z_th
has the same relative error. Several resistors must show the same Z_th. For each resistor the score
test estimates how far its value differs from the value that the others show, with

    ∂G/∂ log R = G Z_th / (R + Z_th) = G (1 − G₀),      G = G₀ e^(−jωτ).

Z_th and all delays are free.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.maximum_likelihood.calibrations import Calibrations, NearCalibrations
from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.sandwich import Linear
from etid.recordings.preflight import Inspected
from etid.signals.transfer import as_complex, combined

# Standard errors; by chance one calibration in two million exceeds this.
SEEN = 5.0
# Relative error. Resistors of 0.1 % and meters are better. A smaller error changes an element by no
# more than this.
SIZE = 0.005
# Part of the excess of chi2 that one wrong resistor must explain. Otherwise the records have
# another fault, which can imitate a wrong resistor.
EXPLAINED = 0.5
# Factor by which rough values of |Z_th| may differ between resistors. At low frequency Z_th is real
# to a few per cent.
ROUGHLY = 3.0


def mismatch(
    calibrations: Calibrations, near: NearCalibrations, linear: Linear
) -> Float[Array, "2 record"]:
    """Excess of each log R over the value that the other calibrations show, and its standard error.

    Args:
        calibrations: Two or more calibrations.
        near: The calibrations at the minimum of their likelihood.
        linear: Their terms there.
    """
    slopes, every = near.slopes, calibrations.knots
    alone = as_complex(jnp.eye(slopes.gains.shape[0]))[:, :, None]
    by_resistor = alone * (-slopes.z * slopes.by_z)[None]
    rows = near.rows(by_resistor)
    others = linear.told(rows) @ linear.bread()
    directions = rows - others @ linear.jacobian
    own = jnp.sum(rows * linear.share[None, :] * directions, axis=1)
    score = directions @ near.terms
    # Estimate the noise after the resistor that explains most: its error must not count as noise.
    best = jnp.argmax(score**2 / own)
    made = combined(others[best], slopes.by_unknown.reshape(linear.jacobian.shape[0], -1))
    change = (made.reshape(slopes.gains.shape) - by_resistor[best]) * as_complex(score / own)[best]
    part = calibrations.terms(near.profiles[0].gains + every.between(change))
    noise = near.padded(means(near.profiles, every, calibrations.noise(part)[None]), 1.0)
    error = jnp.sqrt(jnp.sum(noise * directions**2, axis=1)) / own
    return jnp.stack([score / own, error])


def disagree(
    mismatch: Float[Array, "2 record"], chi2: Float[Array, ""], terms: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether a known resistor is seen to be wrong.

    Args:
        mismatch: Result of the function `mismatch`.
        chi2: χ² per degree of freedom of the driver.
        terms: Number of terms in χ².
    """
    off, error = mismatch
    squares = (off / error) ** 2
    # The errors use the noise without the wrong resistor; χ² uses the noise of the records.
    left = jnp.maximum(chi2 / (1 + squares / terms), 1.0)
    explained = squares * left > EXPLAINED * (chi2 - 1) * terms
    return jnp.any((squares > SEEN**2) & (jnp.abs(off) > SIZE) & explained)


def rough_impedance(calibration: Inspected, r_load: float) -> float:
    """Rough |Z_th| [Ω] from a resistor [Ω] and the amplitudes of both records."""
    x, y = (v - v.mean() for v in calibration.aligned)
    return r_load * abs(float(x @ x / (y @ x)) - 1)
