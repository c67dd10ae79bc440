"""Score test of the calibrations for a pole that the model of the driver lacks.

A Z_th whose order is too low can fit a calibration with χ² = 1 and a residual of the size of the
noise. It can still be wrong by 5 %. At 60 dB, order 3 in place of 5 or 6 changes R_s by three per
cent, ten of its standard errors. The missing part is smooth in frequency, and noise is not. Rao's
score test therefore tests for one more section,

    ∂Z_th = (g + h x) / (1 + 2ζx + x²),      x = s/ω,

at g = h = 0, for three dampings and for each ω of a grid that covers the band. A single pole is
ζ = 1 with g = h. The effect of the other parameters is projected out of the score of g and h. The
statistic has two degrees of freedom, and the largest of all sections decides.

In the map of failures (`python -m benchmarks failure_map`) it is at most 15 if the order is high
enough. It is at least 116 if a lower order changes an element by five of its standard errors.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.maximum_likelihood.calibrations import Calibrations, NearCalibrations
from etid.estimators.sandwich import Linear
from etid.signals.transfer import reciprocal

SEEN = 36.0  # χ² of two degrees of freedom; by chance one of about 100 sections has it once in 10⁶
DAMPINGS = (0.1, 0.3, 1.0)
GRID = 36  # frequencies, eight per decade
BEYOND = 3.0  # factor by which the grid exceeds the band; poles beyond the band still have effect


def sections(
    frequency: Float[Array, " frequency"], highest: Float[Array, ""]
) -> Complex[Array, "section 2 frequency"]:
    """∂Z_th/∂g and ∂Z_th/∂h of all sections.

    Args:
        frequency: Frequencies [Hz].
        highest: End of the band, which begins with the first frequency [Hz].
    """
    grid = jnp.geomspace(frequency[0] / BEYOND, highest * BEYOND, GRID)
    omega, zeta = (of.ravel() for of in jnp.meshgrid(grid, jnp.asarray(DAMPINGS)))
    x = frequency[None, :] / omega[:, None]
    by_g = reciprocal(jax.lax.complex(1 - x * x, 2 * zeta[:, None] * x))
    by_h = jax.lax.complex(-x * by_g.imag, x * by_g.real)
    return jnp.stack([by_g, by_h], axis=1)


def largest(calibrations: Calibrations, near: NearCalibrations, linear: Linear) -> Float[Array, ""]:
    """Largest score statistic of all sections; the calibrations show one more if above `SEEN`.

    Args:
        calibrations: Calibrations.
        near: The calibrations at the minimum of their likelihood.
        linear: Their terms there.
    """
    found = squares(calibrations, near, linear)
    return jnp.nanmax(found)  # NaN if a section has no effect


def squares(
    calibrations: Calibrations, near: NearCalibrations, linear: Linear
) -> Float[Array, " section"]:
    """Score statistic of each section: χ² with two degrees of freedom if the section is absent.

    Args:
        calibrations: Calibrations.
        near: The calibrations at the minimum of their likelihood.
        linear: Their terms there.
    """
    spectra = calibrations.spectra
    # The harmonics of the records differ so little that the sections are equal.
    frequency = calibrations.knots.at(spectra.frequency[0])
    highest = jnp.max(jnp.where(spectra.selected, spectra.frequency, frequency[0]))
    by_z = sections(frequency, highest).reshape(-1, 1, frequency.size)
    rows = near.rows(by_z * near.slopes.by_z[None])
    directions = rows - linear.told(rows) @ linear.bread() @ linear.jacobian
    s, t = (directions @ near.terms).reshape(-1, 2).T  # of g and of h
    by_g, by_h = jnp.moveaxis(directions.reshape(s.size, 2, -1), 1, 0)
    aa, ab, bb = (of @ linear.noise for of in (by_g * by_g, by_g * by_h, by_h * by_h))
    return (s * s * bb - 2 * s * t * ab + t * t * aa) / (aa * bb - ab * ab)
