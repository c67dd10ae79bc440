"""Score test whether the known resistors of the calibrations agree.

Only ratios to Z_th are observable. The error of a single resistor is therefore not visible: Z_th
has the same relative error. Several resistors must show the same Z_th. For each resistor the score
test estimates how far its value differs from the value that the others show, with

    ∂G/∂ log R = G Z_th / (R + Z_th) = G (1 − G₀),      G = G₀ e^(−jωτ).

Z_th and all delays are free.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.estimators.maximum_likelihood.condensed import means
from etid.estimators.maximum_likelihood.driver import Calibrations
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


def mismatch(calibrations: Calibrations, linear: Linear) -> Float[Array, "2 record"]:
    """Excess of each log R over the value that the other calibrations show, and its standard error.

    Args:
        calibrations: Two or more calibrations at the minimum of their likelihood.
        linear: Their terms.
    """
    c, value = calibrations.start(), calibrations.terms(calibrations.start())
    small, found = calibrations.at_knots(), calibrations.likelihood(c)
    z_th = jax.vmap(small.z_th(c).response)(small.spectra.frequency)
    alone = as_complex(jnp.eye(z_th.shape[0]))[:, :, None]
    by_resistor = alone * (-z_th * small.by_z(c))[None]
    rows = found.condensed.rows(by_resistor)
    rows = jnp.pad(rows, ((0, 0), (0, value.size - rows.shape[1])))
    others = linear.told(rows) @ linear.bread()
    directions = rows - others @ linear.jacobian
    own = jnp.sum(rows * linear.share[None, :] * directions, axis=1)
    score = directions @ value
    # Estimate the noise after the resistor that explains most: its error must not count as noise.
    best = jnp.argmax(score**2 / own)
    slopes = small.gain_slopes(c)
    made = combined(others[best], slopes.reshape(c.size, -1)).reshape(slopes.shape[1:])
    change = (made - by_resistor[best]) * as_complex((score / own)[best])
    noise = calibrations.noise(calibrations.likelihood(c, calibrations.knots.between(change)))
    [noise] = means(found.size, calibrations.knots, noise[None])
    noise = jnp.pad(noise, (0, value.size - noise.size), constant_values=1.0)
    error = jnp.sqrt(jnp.sum(noise[None, :] * directions**2, axis=1)) / own
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
