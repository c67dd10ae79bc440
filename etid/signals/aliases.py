"""Aliases that fall on the harmonics: their size, and the errors that stand for them.

If a period is a whole number of samples, the alias of the harmonic at fs − f falls on the harmonic
at f. The record then holds X + A with |A(f)| = |X(fs − f)|, and all periods are alike. A is not
known, but its size is: near half the sample rate fs/2 and beyond, the spectrum of a pulse falls
with a power of the frequency,

    |X(f)|² = S f^(−p).

Two bands of the record determine S and p. They end below fs/2, where A may cancel X. An anti-alias
filter makes the spectrum fall faster and faster; without a filter it falls more slowly beyond the
bands. There p is larger by `FASTER` if it is at least `FILTERED`, and otherwise smaller by
`SLOWER`: a record that may lack a filter has wide errors.

A load acts on A as on X at fs − f, not as on X at f:

    y = G(f) X + conj(G(fs − f)) A = G x + (conj(G(fs − f)) − G) A,      x = X + A.

So only a part of A is an error of y, given x, and none of it is an error of x. Unlike noise, it is
smooth in frequency: the n harmonics within a part `COHERENT` of the sample rate have nearly the
same relative error. They determine the gain as well as if they had independent errors of the
variance n |A|². `etid.signals.harmonics.Spectrum` has this variance and the part in y.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.harmonics import ALIASED, UNLIKE, namespace

# All are relative to the sample rate.
LOWER, UPPER = (0.33, 0.38), (0.40, 0.45)  # bands that show how the spectrum falls
# With the true |A|², the elements of 30 drawn drivers at 60 dB are 1.04 standard errors off (root
# mean square) if n is this part, and 0.9 if it is twice as large; at 80 dB 1.2 and 0.9.
COHERENT = 0.025
SURE = 3.0  # [standard errors] the power of the upper band must exceed its noise by this
# Least p of a spectrum that may be continued beyond half the sample rate, 30 dB per octave. Drivers
# whose parts differ by 10 % have 11.5 to 14.8 behind an anti-alias filter of fourth order at 0.4 of
# 200 to 500 kHz, and without one 7.3 to 12.8, half of them less than 9. There the elements were up
# to six standard errors off, because the spectrum falls more slowly where nothing is measured.
SLOWEST = 11.0
# Least p of a spectrum that is surely behind a filter; without one, 12.1 is the largest of 360
# drivers. Beyond the bands p is larger by 1.7 to 5 behind a filter, and smaller by 2 to 4 without.
# What the model of Z_th says beyond half the sample rate is then wrong too, so `SLOWER` is larger.
FILTERED, FASTER, SLOWER = 12.2, 3.0, 7.0


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

        A is compared at the highest harmonic of a fit, where it is largest.
        """
        last = int(ALIASED * self.harmonics / COHERENT) - 1
        return bool(UNLIKE * self.variance[last] > variance[last] and self.fall < SLOWEST)


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
    of = namespace(variance)
    position = np.arange(1.0, variance.size + 1) * (periods / samples)
    squares = of.real(coefficients) ** 2 + of.imag(coefficients) ** 2
    signals, errors = [], []
    for low, high in (LOWER, UPPER):
        inside = (position >= low) & (position < high)
        count = max(np.count_nonzero(inside), 1)
        noise = of.sum(of.where(inside, variance, 0.0)) / count
        signals.append(of.sum(of.where(inside, squares, 0.0)) / count - noise)
        errors.append(noise / np.sqrt(count))
    shown = (signals[1] > SURE * errors[1]) & (signals[0] > signals[1])
    lower, upper = (of.where(shown, one, 1.0) for one in signals)
    middle = sum(UPPER) / 2
    fall = of.log(lower / upper) / np.log(middle * 2 / sum(LOWER))
    level = of.where(signals[1] > SURE * errors[1], signals[1], 0.0)
    # Padded harmonics lie above half the sample rate; they have no aliases.
    mirrored = np.maximum(1 - position, 0.5) / middle
    change = of.where(fall < SLOWEST, 0.0, of.where(fall < FILTERED, -SLOWER, FASTER))
    return Aliases(level * mirrored ** -(fall + change), fall, COHERENT * samples / periods)
