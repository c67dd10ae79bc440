"""Aliases that fall on the harmonics: their size, and the variance that stands for them.

If a period is a whole number of samples, the alias of the harmonic at fs − f falls on the harmonic
at f. The record then holds X + A with |A(f)| = |X(fs − f)|, and all periods are alike. A is not
known, but its size is: near half the sample rate fs/2 and beyond, the spectrum of a pulse falls
with a power of the frequency,

    |X(f)|² = S f^(−p).

Two bands of the record determine S and p. They end below fs/2, where A may cancel X. An anti-alias
filter makes the spectrum fall faster and faster, so that this A is up to three times too large.

A load acts on A as on X at fs − f, not as on X at f. So A is an error of the measured gain. Unlike
noise, it is smooth in frequency: the n harmonics within a part `COHERENT` of the sample rate have
nearly the same relative error. They determine the gain as well as if they had independent errors
of the variance n |A|². This variance adds to that of the noise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.harmonics import ALIASED, namespace

# All are relative to the sample rate.
LOWER, UPPER = (0.33, 0.38), (0.40, 0.45)  # bands that show how the spectrum falls
COHERENT = 0.05  # width over which aliases have nearly the same relative error


class Aliases(NamedTuple):
    """What has aliased onto the harmonics of a record.

    Attributes:
        power: |A|² at each harmonic [V²]; 0 if the spectrum ends in the noise.
        fall: The power p; 0 if the spectrum does not fall.
        harmonics: Number of harmonics with the same relative error, n.
    """

    power: Float[Array | np.ndarray, " harmonic"]
    fall: Float[Array | np.ndarray, ""]
    harmonics: float

    @property
    def variance(self) -> Float[Array | np.ndarray, " harmonic"]:
        """Variance of independent errors that stand for A [V²]."""
        return self.harmonics * self.power

    def are_unknown(self, variance: Float[np.ndarray, " harmonic"]) -> bool:
        """Whether A exceeds noise of this variance, and its size does not follow from the record.

        A is compared at the highest harmonic of a fit, where it is largest. A spectrum may be
        continued beyond half the sample rate if it falls by 30 dB per octave there. Drivers whose
        parts differ by 10 % have p of 11.5 to 14.8 behind an anti-alias filter of fourth order at
        0.4 of 200 to 500 kHz, and without one 7.3 to 12.8, half of them less than 9. Without one
        the elements were up to six standard errors off, because the spectrum falls more slowly
        where nothing is measured.
        """
        last = int(ALIASED * self.harmonics / COHERENT) - 1
        return bool(self.variance[last] > variance[last] and self.fall < 11.0)


def aliases(
    coefficients: Complex[Array | np.ndarray, " harmonic"],
    variance: Float[Array | np.ndarray, " harmonic"],
    periods: int,
    samples: int,
) -> Aliases:
    """The aliases on the harmonics of a record.

    Args:
        coefficients: Fourier coefficients of the harmonics 1, 2, … [V].
        variance: E|noise|² of each of them [V²].
        periods: Number of periods from `etid.signals.harmonics.whole_periods`.
        samples: Number of samples from `etid.signals.harmonics.whole_periods`.
    """
    xp = namespace(variance)
    position = np.arange(1.0, variance.size + 1) * (periods / samples)
    squares = xp.real(coefficients) ** 2 + xp.imag(coefficients) ** 2
    signals, errors = [], []
    for low, high in (LOWER, UPPER):
        inside = (position >= low) & (position < high)
        count = max(np.count_nonzero(inside), 1)
        noise = xp.sum(xp.where(inside, variance, 0.0)) / count
        signals.append(xp.sum(xp.where(inside, squares, 0.0)) / count - noise)
        errors.append(noise / np.sqrt(count))
    exceeds_noise = signals[1] > 3.0 * errors[1]
    falls = exceeds_noise & (signals[0] > signals[1])
    lower, upper = (xp.where(falls, signal, 1.0) for signal in signals)
    middle = sum(UPPER) / 2
    fall = xp.log(lower / upper) / np.log(middle * 2 / sum(LOWER))
    level = xp.where(exceeds_noise, signals[1], 0.0)
    # Padded harmonics lie above half the sample rate; they have no aliases.
    mirrored = np.maximum(1 - position, 0.5) / middle
    return Aliases(level * mirrored**-fall, fall, COHERENT * samples / periods)
