"""Do the known resistors of a driver's calibrations belong together?

Only ratios to Z_th are observable, so one resistor that is wrong shows nowhere: Z_th is wrong by
as much. Several must show the same Z_th. For each of them the score test asks how much larger or
smaller the others say that it is, with

    ∂G/∂ log R = G Z_th / (R + Z_th) = G (1 − G₀),      G = G₀ e^(−jωτ),

and Z_th and all delays free.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from etid.estimators.maximum_likelihood.driver import Calibrations
from etid.estimators.maximum_likelihood.terms import excess, weights
from etid.recordings.preflight import Inspected
from etid.signals.transfer import as_complex

# Standard errors: one calibration in two million is off by chance.
SEEN = 5.0
# Resistors of 0.1 % and meters are better than this. A smaller mistake costs elements no more.
SIZE = 0.005
# Part of what chi2 has too much that one wrong resistor must explain; or else the records are
# wrong in another way, which can imitate a wrong resistor.
EXPLAINED = 0.5
# By which resistances at low frequency may differ in what they say of Z_th, roughly. It is real
# there to a few per cent.
ROUGHLY = 3.0


def mismatch(calibrations: Calibrations) -> Float[Array, "2 record"]:
    """By how much each log R exceeds what the other calibrations say, and its standard error.

    Args:
        calibrations: Two or more, at the minimum of their likelihood.
    """
    c, records = calibrations.start(), calibrations.records
    linear, value = calibrations.linear(c), calibrations.terms(c, records)
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
    # The noise is what is left after the resistor that explains most, whose mistake is none.
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
        mismatch: From `mismatch`.
        chi2: Of the driver.
        terms: How many terms χ² is the mean of.
    """
    off, error = mismatch
    squares = (off / error) ** 2
    # Errors are those of the noise that a resistor leaves, χ² counts in that of the records.
    left = jnp.maximum(chi2 / (1 + squares / terms), 1.0)
    explained = squares * left > EXPLAINED * (chi2 - 1) * terms
    return jnp.any((squares > SEEN**2) & (jnp.abs(off) > SIZE) & explained)


def rough_impedance(calibration: Inspected, r_load: float) -> float:
    """About |Z_th| [Ω] by a resistor [Ω], from the amplitudes of both records alone."""
    x, y = (v - v.mean() for v in calibration.aligned)
    return r_load * abs(float(x @ x / (y @ x)) - 1)
