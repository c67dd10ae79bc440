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

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.maximum_likelihood.driver import Calibrations
from etid.estimators.maximum_likelihood.terms import apart
from etid.estimators.sandwich import Linear
from etid.signals.transfer import as_complex, frequency_variable, reciprocal

SEEN = 36.0  # χ² of two degrees of freedom; by chance one of about 100 sections has it once in 10⁶
DAMPINGS = (0.1, 0.3, 1.0)
GRID = 36  # frequencies, eight per decade
BEYOND = 3.0  # factor by which the grid exceeds the band; poles beyond the band still have effect


def sections(
    frequency: Float[Array, " harmonic"], lowest: Float[Array, ""], highest: Float[Array, ""]
) -> Complex[Array, "section 2 harmonic"]:
    """∂Z_th/∂g and ∂Z_th/∂h of all sections, for a band [Hz]."""
    omega = 2 * jnp.pi * jnp.geomspace(lowest / BEYOND, highest * BEYOND, GRID)
    omega, zeta = (of.ravel() for of in jnp.meshgrid(omega, jnp.asarray(DAMPINGS)))
    x = frequency_variable(frequency)[None, :] * as_complex(1 / omega)[:, None]
    low = reciprocal(1 + (as_complex(2 * zeta)[:, None] + x) * x)
    return jnp.stack([low, x * low], axis=1)


def largest(calibrations: Calibrations, linear: Linear) -> Float[Array, ""]:
    """Largest score statistic of all sections; the calibrations show one more if above `SEEN`.

    Args:
        calibrations: Calibrations at the minimum of their likelihood.
        linear: Their terms.
    """
    found = squares(calibrations, linear)
    return jnp.nanmax(found)  # NaN if a section has no effect


def squares(calibrations: Calibrations, linear: Linear) -> Float[Array, " section"]:
    """Score statistic of each section: χ² with two degrees of freedom if the section is absent.

    Args:
        calibrations: Calibrations at the minimum of their likelihood.
        linear: Their terms.
    """
    c = calibrations.start()
    slopes = apart(lambda _: _slopes(calibrations), c)
    rows = apart(lambda c: calibrations.by_gains(c, slopes), c)
    terms = calibrations.terms(c, calibrations.records)
    # With D = rows − fitted J, the scores are D r and their covariance is D C Dᵀ. D itself is not
    # computed, because it is large.
    fitted = linear.told(rows) @ linear.bread()
    score = rows @ terms - fitted @ (linear.jacobian @ terms)
    noisy = linear.jacobian * linear.noise[None, :]
    cross = rows @ noisy.T
    between = cross - 0.5 * fitted @ (noisy @ linear.jacobian.T)
    rows, fitted, between = (of.reshape(-1, 2, of.shape[1]) for of in (rows, fitted, between))
    shared = fitted @ between.transpose(0, 2, 1)
    one, other = rows[:, 0], rows[:, 1]
    by_g, by_both, by_h = (
        jnp.sum(a * b * linear.noise[None, :], axis=1)
        for a, b in ((one, one), (one, other), (other, other))
    )
    own = jnp.stack([by_g, by_both, by_both, by_h], axis=1).reshape(-1, 2, 2)
    variance = own - shared - shared.transpose(0, 2, 1)
    score = score.reshape(-1, 2, 1)
    return jnp.sum(score * jnp.linalg.solve(variance, score), axis=(1, 2))


def _slopes(calibrations: Calibrations) -> list[Complex[Array, "row harmonic"]]:
    """Derivatives of the gains G = R/(R + Z_th) with respect to g and h of all sections."""
    spectra, gains = calibrations.spectra, calibrations.gains(calibrations.start())
    lowest = spectra.frequency[0, 0]
    highest = jnp.max(jnp.where(spectra.selected, spectra.frequency, lowest))
    found = []
    for number, (r, g) in enumerate(zip(calibrations.calibration.r_load, gains, strict=True)):
        frequency = spectra.frequency[number]
        of_z = -g * reciprocal(as_complex(r) + calibrations.source.response(frequency))
        by_z = sections(frequency, lowest, highest)
        found.append((by_z * of_z[None, None, :]).reshape(-1, frequency.size))
    return found
