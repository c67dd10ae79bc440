"""Score test whether the known resistors of the calibrations agree.

Only ratios to Z_th are observable. The error of a single resistor is therefore not visible: Z_th
has the same relative error. Several resistors must show the same Z_th. For each resistor the score
test estimates how far its value differs from the value that the others show, with

    ∂G/∂ log R = G Z_th / (R + Z_th) = G (1 − G₀),      G = G₀ e^(−jωτ).

Z_th and all delays are free.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.estimators.maximum_likelihood.driver import Calibrations
from etid.estimators.maximum_likelihood.terms import excess, weights
from etid.estimators.sandwich import Linear
from etid.recordings.preflight import Inspected
from etid.signals.transfer import as_complex

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


def mismatch(calibrations: Calibrations, linear: Linear) -> Float[Array, "2 record"]:
    """Excess of each log R over the value that the other calibrations show, and its standard error.

    Args:
        calibrations: Two or more calibrations at the minimum of their likelihood.
        linear: Their terms.
    """
    c, records = calibrations.start(), calibrations.records
    value = calibrations.terms(c, records)
    z_th, alone = calibrations.z_th(c).response, jnp.eye(len(records))
    slopes = [
        as_complex(alone[i])[:, None] * _slope(g, r, z_th(s.frequency))[None, :]
        for i, (g, r, s) in enumerate(
            zip(calibrations.gains(c), calibrations.calibration.r_load, records, strict=True)
        )
    ]
    rows = calibrations.by_gains(c, slopes)
    directions = rows - linear.told(rows) @ linear.bread() @ linear.jacobian
    own = jnp.sum(rows * linear.share[None, :] * directions, axis=1)
    score = directions @ value
    # Estimate the noise after the resistor that explains most: its error must not count as noise.
    best = jnp.argmax(score**2 / own)
    rest = value - directions[best] * (score / own)[best]
    size = records[0].x.size
    of_noise = [
        excess(rest[2 * i * size : 2 * (i + 1) * size], s.selected) for i, s in enumerate(records)
    ]
    error = jnp.sqrt(jnp.sum(weights(of_noise, value.size)[None, :] * directions**2, axis=1)) / own
    return jnp.stack([score / own, error])


def _slope(
    g: Complex[Array, " harmonic"], r: Float[Array, ""], z_th: Complex[Array, " harmonic"]
) -> Complex[Array, " harmonic"]:
    """∂G/∂ log R."""
    return g * z_th / (as_complex(r) + z_th)


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
