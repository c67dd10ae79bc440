"""The noise by frequency at each electrode, as the pulses before have shown it.

**In a band**, the variance is that of the quiet between two pulses (`etid.display.projection`),
times a factor, which is smooth in time. Amplifiers before a filter, 1/f noise and other lines make
it differ from 1. It begins as the unloaded record has it. With e and e⁻, the residuals of a band at
this pulse and at the one before, each in standard deviations, it follows

    |e − e⁻|² / 4.

What a circuit that is not exact leaves is the same in both (`etid.display.discrepancy`).
The part of a residual that a gain or another circuit explains (`etid.display.alarms`) is taken out
before. What does not change is the model's, too: the difference does not hide it. Hum that is
locked to the pulses, such as 60 Hz with pulses of 60 Hz, does not change, either. Up to the seventh
multiple of the mains, a residual of seven standard deviations is taken for hum, and |e|² / 2 for
the variance.

**The line of the mains that falls between the harmonics**, such as 50 Hz with pulses of 60 Hz,
leaks into all bands, because a window has less than one period of it. Independent noise in each
band would be wrong by a factor of five. The line is a sine and a cosine of unknown amplitude, each
a normal variable of each pulse with the deviation h. Its square is the mean of the squares of the
amplitudes that fit the residuals, where these exceed seven standard errors. The covariance of a
pulse is

    C = 1 + Σ p pᵀ

in standard deviations of the other noise; p are the sines and cosines. Residuals and derivatives
are multiplied by a root of C⁻¹.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from etid.precision import Module, namespace
from etid.signals.transfer import AnyArray

MEMORY = 256  # pulses from which the noise is known
SOON = 32.0  # pulses from which hum on a harmonic is known
LINE = 8.0  # pulses from which a line between the harmonics is known
BEFORE = 64.0  # pulses that the unloaded record counts as
FAINT = 0.1  # least deviation of a line, relative to the standard error of its amplitude
GROSS = 24.5  # of |e|² / 2 of hum: seven standard deviations
JUMP = 25.0  # largest growth of the variance that a pulse may show


class Noise(Module):
    """What is known of the noise before a pulse, at one electrode or at all along a leading axis.

    Attributes:
        bands: Variance in each band, relative to that in the quiet between two pulses.
        line: Deviation h of each line of the mains between the harmonics [V].
        residual: Residual of the last pulse in standard deviations, with what the circuit leaves;
            NaN if it shows nothing.
        pulses: Number of pulses that have shown the noise in the bands.
        least: Least deviation of a line [V].
    """

    bands: Float[Array, "*lane band"]
    line: Float[Array, "*lane line"]
    residual: Float[Array, "*lane part"]
    pulses: Float[Array, "*lane"]
    least: Float[Array, "*lane"]

    @classmethod
    def of(cls, bands: Float[Array, " band"], lines: int, sigma: float, electrodes: int) -> "Noise":
        """The noise of new electrodes.

        Args:
            bands: Variance in each band in the unloaded record.
            lines: Number of lines of the mains between the harmonics.
            sigma: Standard error of the amplitude of a line [V].
            electrodes: Number of electrodes.
        """
        return cls(
            bands=jnp.broadcast_to(bands[None, :], (electrodes, bands.size)),
            line=jnp.full((electrodes, lines), FAINT * sigma),
            residual=jnp.full((electrodes, 2 * bands.size), jnp.nan),
            pulses=jnp.zeros(electrodes),
            least=jnp.full(electrodes, FAINT * sigma),
        )

    def after(
        self,
        hum: Bool[Array, " band"],
        residual: Float[Array, " part"],
        rough: Float[Array, " part"],
        patterns: Float[Array, "pattern part"],
        shown: Bool[Array, ""],
    ) -> "Noise":
        """The noise at one electrode after one more pulse.

        Args:
            hum: Bands where hum may be.
            residual: Residual of the pulse, cleared, in standard deviations.
            rough: The same, with what the circuit leaves.
            patterns: Cosine and sine of each line, cleared as the residual.
            shown: Whether the pulse shows the noise.
        """
        size = jnp.sum(patterns**2, axis=1)
        fitted = (patterns @ residual) / size
        own, change, rest = (
            jnp.sum(of.reshape(2, -1) ** 2, axis=0)
            for of in (residual, rough - self.residual, residual - fitted @ patterns)
        )
        # A residual that is everywhere is the model's.
        elsewhere = (
            jnp.sum(jnp.where(hum, 0.0, rest))
            / 2
            / jnp.maximum(jnp.sum(~hum, dtype=own.dtype), 1.0)
        )
        gross = GROSS * jnp.maximum(elsewhere, 1.0)
        heard = hum & (own / 2 * self.bands > gross)
        found = jnp.where(heard, own / 2, jnp.minimum(change / 4, JUMP))
        known = jnp.where(heard, SOON, jnp.minimum(BEFORE + self.pulses, MEMORY - 1) + 1)
        bands = self.bands * (1 + (found - 1) / known)
        bands = jnp.where(shown & jnp.isfinite(bands), bands, self.bands)
        squares, size = (of.reshape(-1, 2).mean(axis=1) for of in (fitted**2 * size, size))
        # Cleared, an amplitude is smaller by 1 − |p|² / (1 + |p|²).
        heard = squares > gross * jnp.maximum(1 - size, 1e-12)
        line = jnp.where(heard, squares / size, 0.0)  # h², relative to what was known
        squares = self.line**2 * (1 + (line - 1) / LINE)
        lines = jnp.sqrt(jnp.maximum(squares, self.least**2))
        return Noise(
            bands=bands,
            line=jnp.where(shown & jnp.isfinite(lines), lines, self.line),
            residual=jnp.where(shown, rough, jnp.nan),
            pulses=self.pulses + jnp.where(shown, 1.0, 0.0),
            least=self.least,
        )


def directions(
    patterns: Float[AnyArray, "*row pattern part"],
) -> Float[AnyArray, "*row pattern part"]:
    """Vectors q of which `cleared` makes a root of C⁻¹ = (1 + Σ p pᵀ)⁻¹.

    Args:
        patterns: Sines and cosines p, in standard deviations of the other noise.
    """
    xp, found = namespace(patterns), list[AnyArray]()
    for number in range(patterns.shape[-2]):
        p = patterns[..., number, :]
        for q in found:
            p = p - q * (q * p).sum(-1, keepdims=True)
        root = xp.sqrt(1 + (p * p).sum(-1, keepdims=True))
        found.append(p / xp.sqrt(root * (root + 1)))  # (1 + p pᵀ)^(-½) = 1 − q qᵀ
    return xp.stack(found, -2) if found else xp.zeros_like(patterns)


def cleared(
    values: Float[AnyArray, "*row value part"],
    lines: Float[AnyArray, "*row pattern part"],
) -> Float[AnyArray, "*row value part"]:
    """`values` times a root of C⁻¹."""
    for number in range(lines.shape[-2]):
        q = lines[..., number, :]
        values = values - (values @ q[..., None]) * q[..., None, :]
    return values
