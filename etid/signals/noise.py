"""The noise of a record by frequency, estimated from the record itself.

Noise is measured where it acts: at each harmonic of the pulse rate. Pulses repeat and noise does
not, so the bins of the transform between the harmonics hold noise alone (Pintelon and Schoukens,
*System Identification*, 2012, chapter 2): white, 1/f, that of an amplifier before an anti-alias
filter, of a converter, and hum. Where the pulse rate is not exactly that of the transform, pulses
leak into these bins, and aliases of their edges fall there. So the record is first multiplied by a
window that leaves its quiet parts only (`etid.signals.quiet_parts`). A signal without quiet parts,
such as a multisine, is left as it is.

A single period has no bins between harmonics. There the quiet part shows the noise, except at the
lowest frequencies, where the tail of the pulse is larger.

The power is averaged over bands of neighbouring bins. The mean of n powers m has the gamma
distribution, so E[1/m] = n/(n − 1)/σ²; it is enlarged by this factor, so that weights are right in
the mean.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from etid.precision import Module
from etid.signals.harmonics import namespace
from etid.signals.quiet_parts import BLOCKS, are_loud, changes, window_of
from etid.signals.transfer import AnyArray
from etid.signals.white_noise import noise_std, quietest

RIPPLE = 1e-5  # error of the interpolation relative to the signal: a lower limit of the noise

FEWEST = 12  # powers that are averaged at least: a band is known to 30 %
UNSEEN = 48  # bins of a single period that its own tail fills
EXACT = 0.01  # [samples] the leakage of a multisine to 6 kHz at 60 dB stays below its noise
TOGETHER = 100_000  # samples of records that are transformed together; more leave the cache


class _Layout(NamedTuple):
    """How records of one length are divided.

    Attributes:
        used: 1 for each bin below half the sample rate that is used, 0 for harmonics.
        edges: First bin of each band.
        number: Number of bins in each band.
        below: Band whose centre is below each harmonic.
        above: Place of each harmonic between the centres of this band and the next one, 0 to 1.
        leak: Part of the power of a sample that the ends of the record bring to each harmonic.
        line: A straight line over the record, with a mean of 0.
        stairs: Weights whose product with a record is its slope, in units of this line; from
            the means of the periods, because the pulses of a period are no drift.
    """

    used: Float[np.ndarray, " bin"]
    edges: Int[np.ndarray, " band"]
    number: Float[np.ndarray, " band"]
    below: Int[np.ndarray, " harmonic"]
    above: Float[np.ndarray, " harmonic"]
    leak: Float[np.ndarray, " harmonic"]
    line: Float[np.ndarray, " time"]
    stairs: Float[np.ndarray, " time"]


@functools.lru_cache(maxsize=16)
def _layout(periods: int, samples: int) -> _Layout:
    """The layout of records of whole periods.

    The width of a band is a fifth of its frequency, at most 1/64 of all.
    """
    bins = np.arange(periods, (samples + 1) // 2, periods)
    of_harmonic = max(periods - 1, 1)
    least = math.ceil(FEWEST / of_harmonic)
    most = max(bins.size // 64, least)
    # Below the pulse rate are drifts, and 1/f noise that is stronger than at any harmonic.
    edges = [min(1, bins.size - 1) if periods > 1 else min(UNSEEN, bins.size // 2)]
    while (after := edges[-1] + min(max(least, edges[-1] // 5), most)) + least <= bins.size:
        edges.append(after)
    width, edges = np.diff([*edges, bins.size]), np.array(edges)
    # The bins between are those below a harmonic; of a single period, they are the harmonics.
    centres = edges + width / 2 + (0.0 if periods > 1 else 0.5)
    between = np.interp(np.arange(1.0, bins.size + 1), centres, np.arange(edges.size))
    below = np.minimum(between.astype(int), max(edges.size - 2, 0))
    # Noise does not end as it begins: a step of twice its power. At the lowest bins this is a part
    # of the noise itself.
    step = 0.5 / (samples * np.sin(np.pi * bins / samples)) ** 2
    leak = np.where(bins**2 > 8 * samples * periods, step, 0.0)
    used = np.arange(bins.size * periods + (periods == 1))
    used = used % periods != 0 if periods > 1 else used > 0
    line = np.linspace(-1, 1, samples)
    turn = np.arange(samples + 1) / (samples / periods)
    before = np.floor(turn)
    stairs = np.diff(before * (turn - (before + 1) / 2)) - (periods - 1) / 2 * periods / samples
    return _Layout(
        used=1.0 * used,
        edges=edges * periods + (periods == 1),
        number=1.0 * width * of_harmonic,
        below=below,
        above=between - below,
        leak=leak,
        line=line,
        stairs=stairs / (stairs @ line) if periods > 1 else 0 * line,
    )


class Noise(NamedTuple):
    """The noise of records of whole periods.

    Attributes:
        power: E|noise|² of each coefficient of `etid.signals.harmonics.harmonics`, in the unit of
            the record squared.
        of_ends: Harmonics whose noise is what the ends of the record bring.
        usual: Noise power of the median of three or more periods, relative to their mean.
        bins: Number of bins of the transform that show the noise; 0 if it is taken for white.
    """

    power: Float[Array | np.ndarray, "*record harmonic"]
    of_ends: Bool[Array | np.ndarray, "*record harmonic"]
    usual: Float[Array | np.ndarray, "*record"]
    bins: Float[Array | np.ndarray, "*record"]

    @property
    def variance(self) -> Float[Array | np.ndarray, "*record harmonic"]:
        """Variance of independent errors that stand for this noise.

        What the ends bring is one number: all harmonics of the ends together are as good as one.
        """
        enlarged = self.power * self.power.shape[-1]
        return namespace(self.power).where(self.of_ends, enlarged, self.power)

    def std(self, samples: int) -> Float[Array | np.ndarray, "*record"]:
        """Standard deviation of a sample of white noise as strong as this noise is in the middle.

        That is between 1/128 and 1/8 of the sample rate, which tests of a few samples see. The
        noise of a sample itself is less where a filter follows the amplifier. A burst in one
        period, which these tests shall find, is left out.
        """
        xp, count = namespace(self.power), self.power.shape[-1]
        middle = self.power[..., count // 64 : max(count // 4, 1)].mean(-1)
        return xp.asarray(xp.sqrt(samples * middle * self.usual))


def noise_of(
    v: Float[Array | np.ndarray, "*record time"],
    periods: int,
    samples: int,
    rest: Float[np.ndarray, "*record"] | float = 0.0,
    whole: bool = True,
) -> Noise:
    """The noise of records.

    Args:
        v: Samples of the records.
        periods: Number of periods from `etid.signals.harmonics.whole_periods`; 1 if it is 0.
        samples: Number of samples from there; all of them if there is no period.
        rest: By how much the periods are longer [samples].
        whole: Whether the record ends where it begins; if not, its ends are left out.
    """
    v = v[..., :samples]
    found, kept = _measured(v, periods, whole)
    if isinstance(v, jax.Array):  # the choice of periods below depends on the values
        if periods > 1:
            return found
        white = jnp.vectorize(noise_std, signature="(time)->()")(v) ** 2 / samples
        return found._replace(
            power=jnp.where(kept < 1, found.power, white[..., None]),
            of_ends=found.of_ends & (kept < 1),
            bins=jnp.where(kept[..., 0] < 1, found.bins, 0.0),
        )
    rest = np.broadcast_to(rest, v.shape[:-1])
    for place in map(tuple, np.argwhere(kept[..., 0] == 1)):
        of = _of_loud(v[place], periods, float(rest[place]), found.power.shape[-1])
        found.power[place], found.of_ends[place], found.bins[place] = of
    return found


def _of_loud(
    v: Float[np.ndarray, " time"], periods: int, rest: float, count: int
) -> tuple[Float[np.ndarray, " harmonic"], Bool[np.ndarray, " harmonic"], float]:
    """`Noise.power`, `of_ends` and `bins` of a record that is never quiet, such as a multisine.

    It leaks between the harmonics unless the periods end at a sample. If two or more of them do,
    the noise is measured in these; if not, it is taken for white.
    """
    whole = np.arange(2, periods + 1)
    ends = whole * ((v.size + rest) / periods)
    exact = np.flatnonzero(np.abs(ends - np.rint(ends)) < EXACT)
    if exact.size == 0:
        return np.full(count, quietest(v) ** 2 / v.size), np.zeros(count, bool), 0.0
    last = exact[-1]
    samples = round(float(ends[last]))
    of, _ = _measured(v[:samples], int(whole[last]))
    at = np.minimum(np.arange(count), of.power.size - 1)
    power, of_ends = np.asarray(of.power)[at], np.asarray(of.of_ends)[at]
    return power * (samples / v.size), of_ends, float(of.bins)


def _measured(
    v: Float[Array | np.ndarray, "*record time"], periods: int, whole: bool = True
) -> tuple[Noise, Float[Array | np.ndarray, "*record 1"]]:
    """The noise at each harmonic, and the part of the record that the window has kept."""
    xp, samples = namespace(v), v.shape[-1]
    layout = _layout(periods, samples)
    if xp is np:
        flat, some = v.reshape(-1, samples), max(TOGETHER // samples, 1)
        parts = (_between(flat[i : i + some], periods, whole) for i in range(0, len(flat), some))
        each = map(np.concatenate, zip(*parts, strict=True))
        sums, kept, usual = (of.reshape(*v.shape[:-1], -1) for of in each)
    else:
        sums, kept, usual = _between(v, periods, whole)
    means = _smooth(sums / (samples**2 * kept), layout.number)
    rise = xp.concatenate([xp.diff(means, axis=-1), xp.zeros_like(kept)], axis=-1)
    power, rise = (xp.take(of, layout.below, axis=-1) for of in (means, rise))
    power = power + layout.above * rise
    # What a filter has left of the noise may be less than what the ends of the record bring.
    # Drifts and hum below are treated elsewhere.
    leak = layout.leak * (2 * periods * power[..., power.shape[-1] // 64 :].sum(-1)[..., None])
    of_ends = leak * (10 * periods) > power
    bins = xp.full(kept.shape[:-1], layout.number.sum())
    return Noise(xp.maximum(power, leak), of_ends, usual[..., 0], bins), kept


def _smooth(
    power: Float[Array | np.ndarray, "*record band"], number: Float[np.ndarray, " band"]
) -> Float[Array | np.ndarray, "*record band"]:
    """Powers of bands, averaged with two bands on each side where these five agree.

    A better known noise is worth a tenth of the variance of C_p at 40 dB; an edge of a filter or a
    line stays as it is.
    """
    xp, last = namespace(power), number.size - 1
    near = np.clip(np.arange(number.size)[:, None] + np.arange(-2, 3), 0, last)
    around, weight = xp.take(power, near, axis=-1), number[near]
    mean = xp.vecdot(around, xp.asarray(weight)) / weight.sum(1)
    off = xp.abs(around - mean[..., None]) * np.sqrt(weight)
    return xp.where((off < 3.0 * mean[..., None]).all(-1), mean, power)


def _between(
    v: Float[Array | np.ndarray, "*record time"], periods: int, whole: bool
) -> tuple[Array | np.ndarray, ...]:
    """Mean power of the bins between the harmonics in each band, after a window.

    Returns:
        These powers, the mean square of the window, and `Noise.usual` with an axis of length 1.
    """
    xp, samples = namespace(v), v.shape[-1]
    layout = _layout(periods, samples)
    change = changes(v, periods)
    loud = are_loud(change)
    if not whole:  # a record that is never quiet has no loud parts
        ends = np.arange(BLOCKS) % (BLOCKS - 1) == 0
        loud = loud | (ends & loud.any(-1, keepdims=True))
    of_period = xp.where(loud[..., None, :], 0.0, change).sum(-1)
    middle = xp.sort(of_period, axis=-1)[..., [periods // 2]]
    mean = of_period.mean(-1)[..., None]
    usual = xp.where((mean > 0) & (periods > 2), middle / xp.where(mean > 0, mean, 1.0), 1.0)
    window, kept = window_of(loud, periods, samples)
    slope = xp.vecdot(v, layout.stairs)[..., None]
    quiet = v - xp.mean(v, axis=-1, keepdims=True)
    quiet -= slope * layout.line
    quiet *= window
    transform = xp.fft.rfft(quiet)[..., : layout.used.size]
    squares = xp.real(transform) ** 2
    squares += xp.imag(transform) ** 2
    squares *= layout.used
    sums = xp.add.reduceat(squares, layout.edges, axis=-1) / np.maximum(layout.number - 1, 1.0)
    return sums, xp.broadcast_to(kept, usual.shape), usual


class Measurement(Module):
    """Both voltages of a recording and the noise of each.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        sigma_th: Standard deviation of the noise of `v_th` [V].
        sigma_out: Standard deviation of the noise of `v_out` [V].
        sample_rate: Sampling rate [Hz].
    """

    v_th: Float[AnyArray, "*lane time"]
    v_out: Float[AnyArray, "*lane time"]
    sigma_th: Float[AnyArray, "*lane"]
    sigma_out: Float[AnyArray, "*lane"]
    sample_rate: Float[AnyArray, "*lane"]

    @property
    def records(self) -> Float[AnyArray, "*lane 2 time"]:
        """Both voltages [V]."""
        return namespace(self.v_th, self.v_out).stack([self.v_th, self.v_out], -2)


def floor(
    v: Float[Array | np.ndarray, "*record time"],
    resolution: Float[Array | np.ndarray, "*record"],
) -> Float[Array | np.ndarray, "*record"]:
    """Least noise of records, in their unit: rounding by the converter, and the interpolation.

    Args:
        v: Samples of the records, or their smallest and largest sample.
        resolution: Step of the converter; 0 if it is not known.
    """
    xp = namespace(v)
    return xp.asarray(xp.maximum(resolution / math.sqrt(12.0), RIPPLE * xp.ptp(v, axis=-1)))


def noise(
    v: Float[Array | np.ndarray, "*record time"],
    resolution: Float[Array | np.ndarray, "*record"],
) -> Float[Array | np.ndarray, "*record"]:
    """White noise of records, in their unit and at least their `floor`."""
    xp = namespace(v)
    white = noise_std if xp is np else jnp.vectorize(noise_std, signature="(time)->()")
    return xp.asarray(xp.maximum(white(v), floor(v, resolution)))
