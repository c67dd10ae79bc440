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

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from etid.estimators.maximum_likelihood.calibrations import Calibrations, NearCalibrations
from etid.estimators.maximum_likelihood.condensed import apart
from etid.estimators.sandwich import Linear

SEEN = 36.0  # χ² of two degrees of freedom; by chance one of about 100 sections has it once in 10⁶
DAMPINGS = (0.1, 0.3, 1.0)
GRID = 36  # frequencies, eight per decade
BEYOND = 3.0  # factor by which the grid exceeds the band; poles beyond the band still have effect


class Sections(eqx.Module):
    """1 / (1 + 2ζx + x²) of all sections at the knots of the calibrations.

    With D for it, ∂Z_th/∂g = D and ∂Z_th/∂h = D s/ω. The derivatives of the terms with respect to g
    and h are not computed, because they are large. Only their products are.

    Attributes:
        frequency: The knots [Hz].
        omega: ω of each section / 2π [Hz].
        real: Re D.
        imaginary: Im D.
        effect: e; a change of Z_th changes the terms by Re(e ∂Z_th).
    """

    frequency: Float[Array, " harmonic"]
    omega: Float[Array, " section"]
    real: Float[Array, "section harmonic"]
    imaginary: Float[Array, "section harmonic"]
    effect: Complex[Array, "part harmonic"]

    @classmethod
    def of(
        cls,
        frequency: Float[Array, " harmonic"],
        ends: tuple[Float[Array, ""], Float[Array, ""]],
        effect: Complex[Array, "part harmonic"],
    ) -> "Sections":
        """The sections for the band between `ends` [Hz]."""
        grid = jnp.geomspace(ends[0] / BEYOND, ends[1] * BEYOND, GRID)
        omega, zeta = (of.ravel() for of in jnp.meshgrid(grid, jnp.asarray(DAMPINGS)))
        x = frequency[None, :] / omega[:, None]
        real, imaginary = 1 - x * x, 2 * zeta[:, None] * x
        scale = 1 / (real * real + imaginary * imaginary)
        return cls(frequency, omega, real * scale, -imaginary * scale, effect)

    def times(self, vectors: Float[Array, "column term"]) -> Float[Array, "2 section column"]:
        """Products of the derivatives with respect to g and h with vectors of all terms."""
        parts = vectors.reshape(vectors.shape[0], *self.effect.shape)
        real, imaginary = (jnp.sum(of[None] * parts, axis=1) for of in _parts(self.effect))
        f = self.frequency[None, :]
        by_g = self.real @ real.T - self.imaginary @ imaginary.T
        by_h = self.real @ (f * imaginary).T + self.imaginary @ (f * real).T
        return jnp.stack([by_g, -by_h / self.omega[:, None]])

    def squares(self, weight: Float[Array, " term"]) -> list[Float[Array, " section"]]:
        """Weighted sums, over the terms, of a², a b and b²: the derivatives a by g and b by h."""
        weight, f, (e, d) = weight.reshape(self.effect.shape), self.frequency, _parts(self.effect)
        ee, ed, dd = (jnp.sum(weight * of, axis=0) for of in (e * e, e * d, d * d))
        of_sections = self.real**2, self.real * self.imaginary, self.imaginary**2
        aa, ab, bb = (
            sum((one @ of for one, of in zip(of_sections, weights, strict=True)), jnp.zeros(()))
            for weights in (
                (ee, -2 * ed, dd),
                (f * ed, f * (ee - dd), -f * ed),
                (f * f * dd, 2 * f * f * ed, f * f * ee),
            )
        )
        return [aa, -ab / self.omega, bb / self.omega**2]


def _parts(z: Complex[Array, "*_"]) -> tuple[Float[Array, "*_"], Float[Array, "*_"]]:
    return z.real, z.imag


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
    jacobian, terms = near.jacobian, near.terms
    sections = apart(lambda _: _sections(calibrations, near), terms)
    used = sections.effect.size
    # With D = rows − fitted J, the scores are D r and their covariance is D C Dᵀ, where `rows` are
    # the derivatives of the terms.
    count, noisy = jacobian.shape[0], jacobian * linear.noise[None, :]
    columns = jnp.concatenate([jacobian * linear.share[None, :], noisy, terms[None, :]])
    products = sections.times(columns[:, :used])  # g and h do not affect the priors
    fitted, cross = products[:, :, :count] @ linear.bread(), products[:, :, count:-1]
    s, t = products[:, :, -1] - fitted @ (jacobian @ terms)  # of g and of h
    between = cross - 0.5 * fitted @ (noisy @ jacobian.T)
    aa, ab, bb = (
        own - jnp.sum(fitted[i] * between[j] + fitted[j] * between[i], axis=1)
        for own, (i, j) in zip(
            sections.squares(linear.noise[:used]), ((0, 0), (0, 1), (1, 1)), strict=True
        )
    )
    return (s * s * bb - 2 * s * t * ab + t * t * aa) / (aa * bb - ab * ab)


def _sections(calibrations: Calibrations, near: NearCalibrations) -> Sections:
    """The sections, and their effect on the condensed terms."""
    spectra, by_z = calibrations.spectra, near.slopes.by_z
    rows = near.condensed.rows(jnp.stack([by_z, 1j * by_z]))
    effect = jax.lax.complex(rows[0], -rows[1]).reshape(-1, by_z.shape[-1])
    # The harmonics of the records differ so little that the sections are equal.
    frequency = calibrations.knots.at(spectra.frequency[0])
    highest = jnp.max(jnp.where(spectra.selected, spectra.frequency, frequency[0]))
    return Sections.of(frequency, (frequency[0], highest), effect)
