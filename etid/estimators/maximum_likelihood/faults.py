"""Errors of the instrument as parameters z of the gains, with a standard normal prior.

A gain g, a crosstalk κ and a capacitance C change the outputs of a load directly:

    V_out / V_th = (1 + g) Z' / (Z' + Z_th) + κ,      Z' = Z_L ‖ C.

g, κ and the known resistors also change the calibrations, whose minimum moves by

    ∂c/∂θ = −H⁻¹ J W (∂terms/∂θ),

with the H, J and W of `etid.estimators.sandwich`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.maximum_likelihood.calibrations import (
    Calibrations,
    GainSlopes,
    NearCalibrations,
)
from etid.estimators.sandwich import Linear
from etid.results.instrument import Instrument
from etid.signals.transfer import as_complex, reciprocal


def seen_through(
    faults: Float[Array, "3"], z_load: Complex[Array, " frequency"], s: Complex[Array, " frequency"]
) -> Complex[Array, " frequency"]:
    """Z_L in parallel with the capacitance of the faults."""
    return z_load * reciprocal(1 + s * as_complex(faults[2]) * z_load)


def disturbed(
    faults: Float[Array, "3"], outputs: Complex[Array, "output frequency"]
) -> Complex[Array, "output frequency"]:
    """The outputs, with the gain and the crosstalk of V_out, which is the first."""
    gain, crosstalk, _ = as_complex(faults)
    return outputs.at[0].set(outputs[0] * (1 + gain) + crosstalk)


def by_z(instrument: Instrument, calibrations: Calibrations, others: int) -> Float[Array, "z 3"]:
    """Gain, crosstalk and capacitance by z: other ones first, and those of the resistors last."""
    resistors = calibrations.calibration.r_load.size
    return jnp.pad(jnp.diag(instrument.of_loads()), ((others, resistors), (0, 0)))


def of_calibrations(
    instrument: Instrument, calibrations: Calibrations, at: GainSlopes
) -> Complex[Array, "z record frequency"]:
    """Changes of the gains of the calibrations by each z, at constant Z_th."""
    r_load = as_complex(calibrations.calibration.r_load)[:, None]
    turned = at.gains * (r_load + at.z_th) / r_load
    each = as_complex(jnp.eye(r_load.shape[0]))[:, :, None] * (-at.by_z * at.z_th)[None]
    of = as_complex(instrument.of_loads())[:, None, None]
    together = jnp.stack([at.gains, turned, jnp.zeros_like(turned)]) * of
    return jnp.concatenate([together, each * as_complex(jnp.asarray(instrument.r_load))])


def moved(
    instrument: Instrument,
    calibrations: Calibrations,
    near: NearCalibrations,
    linear: Linear,
    root: Float[Array, "common common"],
) -> Float[Array, "common z"]:
    """Changes of the minimum of the calibrations by each z; `root` is L, L Lᵀ = H⁻¹."""
    changes = of_calibrations(instrument, calibrations, near.slopes)
    return -root @ (root.T @ linear.told(near.rows(changes)).T)
