"""Bins of the transform of a record of any length and start.

They are k fs/N of a record of N samples, with k = 1 … up to `ALIASED` of the sample rate.
`etid.likelihood.transient` says what the states at both ends of the record make of them.

**Noise.** Where the record holds several pulse periods, the bins between their harmonics show it
(`etid.signals.noise`). Otherwise its quiet parts do. A
signal without rest, such as a random sequence, looks like noise then. But in a few neighbouring
bins Y = G X + T with smooth G and T, and what polynomials for both leave is var Y + |G|² var X (the
local polynomial method of Pintelon and Schoukens, 2012, chapter 7). If this is much less than the
noise that the records seem to have, it counts, half of it for each record, or all for `v_out` if
the other one is a command.

**Aliases** of the edges of pulses fall on all bins, as on the harmonics of a period of whole
samples (`etid.signals.harmonics`, which says how their size follows from the record). The band ends
where they exceed the noise. Aliases of the ends of the record are smooth in frequency, and the
likelihood has unknowns for them. So the ends are tapered before the spectrum is looked at.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from etid.signals.harmonics import ALIASED, aliases, filled, harmonics_of
from etid.signals.noise import Noise, noise_of
from etid.signals.rounding import rounding_variance
from etid.signals.transfer import AnyArray, power

TAPER = 48  # samples at each end, beyond which a jump there does not reach
LEAST = 0.28  # of the sample rate; the band does not end below, or C_p is twice as uncertain
TOO_LARGE = 6.0  # by which the power of aliases that a record tells of exceeds the true one
# Power of aliases at `LEAST` relative to the noise, above which elements are wrong. Where they were
# by five standard errors (100 kHz at 60 and 80 dB, 150 kHz at 80 dB) it was 54 and more, where they
# were not (150 kHz at 50 dB, 200 kHz at 80 dB) at most 2.3.
UNKNOWN = 10.0
# A current has aliases if its power above `LAST` of the rate is surely above the noise, and above
# this part of its power at a third of the rate. Steps have 0.03 to 0.16 after a filter of fourth
# order at 0.4 of the rate, and at most 0.007 after one of eighth order at 0.3.
LAST, STEPS, SURE = 0.45, 0.015, 5.0


LOCAL, DEGREE = 32, 2  # neighbouring bins, and degree of the polynomials of G and of T
STRONG = 10.0  # power of a signal relative to the noise, from which on both records share the noise
SEEMING = 1.2  # noise of both records relative to what polynomials leave, from which on this counts


class Bins(NamedTuple):
    """Both records of a recording at their bins.

    Attributes:
        fields: Those of an `etid.signals.harmonics.Spectrum`.
        is_aliased: Whether aliases of unknown size exceed the noise. A current tells nothing of
            this: its multisines end below half the sample rate, its edges do not.
    """

    fields: tuple[AnyArray, ...]
    is_aliased: bool


def bins(
    both: Float[np.ndarray, "2 time"],
    sample_rate: float,
    noise: tuple[Noise, int, int] | None,
    least: Float[np.ndarray, "2"],
    coarse: Float[np.ndarray, "2"],
    ended: bool,
    of_current: bool,
    commanded: bool = False,
) -> Bins:
    """The bins of two records.

    Args:
        both: The records.
        sample_rate: Sampling rate [Hz].
        noise: Noise at the harmonics of several periods, with their number and that of their
            samples; None if there are no several periods.
        least: Smallest noise of a sample of each record.
        coarse: Step of a converter that exceeds the noise; else 0.
        ended: Whether the spectra surely end below half the sample rate.
        of_current: Whether the first record is a current.
        commanded: Whether the first record is a command, without noise.
    """
    size = both.shape[-1]
    transform, count = np.asarray(harmonics_of(both, 1)), math.ceil(ALIASED * size)
    variance, of_ends = _noise(both, noise, transform.shape[-1])
    if noise is None:
        variance = _of_both(transform, variance, commanded)
    variance = np.maximum(variance, least[:, None] ** 2 / size)
    for row in np.flatnonzero(coarse):
        variance[row] = rounding_variance(both[row], float(coarse[row]), 1, size)
    usable = np.all((coarse > 0)[:, None] | ~of_ends, axis=0)[:count]
    unknown = False
    tapered = _tapered(both)
    if not ended and not (of_current and not _goes_on(tapered[0], variance[0])):
        least = math.ceil(LEAST * size)
        of_aliases = aliases(tapered, variance, 1, size).power
        found = (of_aliases / (TOO_LARGE * variance)).max(0)[:count]
        unknown = bool(found[least - 1] > UNKNOWN) and not of_current
        usable = usable & ((found < 1) | (np.arange(count) < least))
    *fields, selected = filled(transform[:, :count], variance[:, :count], sample_rate, 1, size)
    selected[:count] &= usable
    return Bins((*fields, selected), unknown)


def _noise(
    both: Float[np.ndarray, "2 time"], noise: tuple[Noise, int, int] | None, count: int
) -> tuple[Float[np.ndarray, "2 bin"], Bool[np.ndarray, "2 bin"]]:
    """`Noise.variance` and `Noise.of_ends` of so many bins."""
    size = both.shape[-1]
    if noise is None:
        found = noise_of(both, 1, size, whole=False)
        return np.asarray(found.variance), np.asarray(found.of_ends)
    of, periods, samples = noise
    known = np.arange(1.0, of.power.shape[-1] + 1) * (periods / samples)
    at = np.arange(1.0, count + 1) / size
    power = np.stack([np.interp(at, known, one) for one in np.asarray(of.power)])
    ends = np.stack([np.interp(at, known, one) > 0.5 for one in 1.0 * np.asarray(of.of_ends)])
    return power * (samples / size), ends


def are_coherent(both: Float[np.ndarray, "2 time"]) -> bool:
    """Whether the first of two records explains most of the second, although both look like noise.

    So do white noise, and random numbers that a converter holds.
    """
    transform = np.asarray(harmonics_of(both, 1))
    if transform.shape[-1] < LOCAL:
        return False
    left, explained, _ = _locally(transform)
    return bool(np.median(explained / (LOCAL * left)) > 1.0)


def _locally(
    both: Complex[np.ndarray, "2 bin"],
) -> tuple[Float[np.ndarray, " group"], Float[np.ndarray, " group"], Float[np.ndarray, " group"]]:
    """What polynomials for G and T leave of Y = G X + T in each group of bins, for each bin.

    Also the squares that G X explains beside T, and |G|².
    """
    groups = both.shape[-1] // LOCAL
    both = both[:, : groups * LOCAL].reshape(2, groups, LOCAL)
    powers = np.linspace(-1, 1, LOCAL) ** np.arange(DEGREE + 1)[:, None]
    of_t = np.linalg.qr(powers.T)[0]
    columns = both[0][:, None] * powers
    columns = columns - (columns @ of_t) @ of_t.T
    x, y = both - (both @ of_t) @ of_t.T
    basis = np.linalg.qr(columns.swapaxes(-1, -2))[0]
    left = y - (basis @ (basis.conj().swapaxes(-1, -2) @ y[..., None]))[..., 0]
    found = power(left).sum(-1) / (LOCAL - 2 * (DEGREE + 1) - 1)  # the mean of its inverse is right
    squares = power(x).sum(-1)
    gain = power((x.conj() * y).sum(-1)) / squares**2
    return found, gain * squares, gain


def _of_both(
    both: Complex[np.ndarray, "2 bin"], variance: Float[np.ndarray, "2 bin"], commanded: bool
) -> Float[np.ndarray, "2 bin"]:
    """The variances, or those by what Y = G X + T leaves with polynomials for G and T."""
    groups = both.shape[-1] // LOCAL
    if groups == 0:
        return variance
    found, explained, gain = _locally(both)
    seeming = variance[:, : groups * LOCAL].reshape(2, groups, LOCAL).mean(-1)
    much = (seeming[1] + gain * seeming[0]) / found
    freedom = groups * (LOCAL - 2 * (DEGREE + 1))
    if not np.median(much) > SEEMING + SURE / math.sqrt(freedom):
        return variance
    signal = explained > STRONG * LOCAL * found
    share = 1.0 if commanded else 0.5  # of v_out
    of_x = np.where(signal, (1 - share) * found / np.where(signal, gain, 1.0), seeming[0])
    at = np.minimum(np.arange(both.shape[-1]) // LOCAL, groups - 1)
    # Of a short record the first bins leave more, because G and T bend there.
    less = np.stack([of_x, np.where(signal, share, 1.0) * found])[:, at]
    return np.where((much > 1)[at], less, variance)


def _tapered(both: Float[np.ndarray, "2 time"]) -> Complex[np.ndarray, "2 bin"]:
    """The bins of what lies between the ends."""
    size = both.shape[-1]
    middle = np.arange(size) + 0.5
    window = np.sin(np.pi / 2 * np.clip(np.minimum(middle, size - middle) / TAPER, 0.0, 1.0)) ** 2
    level = (both @ window / window.sum())[:, None]
    return np.asarray(harmonics_of(window * (both - level), 1))


def _goes_on(x: Complex[np.ndarray, " bin"], variance: Float[np.ndarray, " bin"]) -> bool:
    """Whether the spectrum of a current goes on beyond half the sample rate."""
    place = np.arange(1.0, x.size + 1) / (2 * (x.size + 1))
    last, before = ((place >= low) & (place < low + 0.05) for low in (LAST, 0.3))
    excess, noise = power(x) - variance, variance[last].mean()
    found = excess[last].mean()
    sure = found > SURE * noise / math.sqrt(np.count_nonzero(last))
    return bool(sure and found > STEPS * excess[before].mean())
