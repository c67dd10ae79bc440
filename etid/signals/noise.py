"""The noise of a record, estimated from the record itself.

**By frequency.** Noise is measured where it acts: at each harmonic of the pulse rate. Pulses repeat
and noise does not, so the bins of the transform between the harmonics hold noise alone (Pintelon
and Schoukens, *System Identification*, 2012, chapter 2): white, 1/f, that of an amplifier before an
anti-alias filter, of a converter, and hum. Where the pulse rate is not exactly that of the
transform, pulses leak into these bins, and aliases of their edges fall there. So the record is
first multiplied by a window that repeats in each period and is 0 at the edges. The window is smooth
and leaves the quiet parts as they are. For a periodic signal it changes nothing between the
harmonics. A signal without quiet parts, such as a multisine, is left as it is.

A single period has no bins between harmonics. There the quiet part shows the noise, except at the
lowest frequencies, where the tail of the pulse is larger.

The power is averaged over bands of neighbouring bins. The mean of n powers m has the gamma
distribution, so E[1/m] = n/(n − 1)/σ²; it is enlarged by this factor, so that weights are right in
the mean.

**White noise.** High-order differences remove the smooth part of a pulse response and keep the
white noise. The median of their magnitude gives its standard deviation (Donoho & Johnstone 1994 use
the finest wavelet coefficients in the same way). The median ignores the few per cent of samples at
the edges. This serves a single period without a quiet part. A tone at 0.18 of the sample rate
passes these differences with a twentieth of its size. In a record whose differences do not change
their sign as often as those of white noise, the top of the band shows the noise too. The smaller
noise is taken (`_quietest`).

The noise of a converter is at least resolution/√12.
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

# Order of the differences; the ringing after the edges, at a quarter of the rate, is still smooth
# to them.
ORDER = 6
DIFFERENCE = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
# Noise of a sample over the median size of a difference; a normal x has σ = 1.4826 · median |x|.
PER_MEDIAN = 1.482602218505602 / math.sqrt(np.sum(DIFFERENCE**2))
# Shares of sixth differences of white noise that have another sign than the first and the second
# one after them: arccos(ρ)/π, with the correlations ρ of −6/7 and 15/28.
CHANGES = np.arccos([-6 / 7, 15 / 28]) / np.pi
RIPPLE = 1e-5  # error of the interpolation relative to the signal: a lower limit of the noise


# --- By frequency --------------------------------------------------------------------------------

BLOCKS = 128  # parts of a period that are quiet or not
LOUD = 4.0  # power of the differences of a part that is not quiet, relative to that of quiet parts
PULSED = 30.0  # the same of the edges of a pulse; the crests of a multisine stay below
EDGE = 8  # parts over which the window rises
FEWEST = 12  # powers that are averaged at least: a band is known to 30 %
UNSEEN = 48  # bins of a single period that its own tail fills
EXACT = 0.01  # [samples] the leakage of a multisine to 6 kHz at 60 dB stays below its noise
QUIET = 0.1  # mean of a window that leaves enough of a record


class _Layout(NamedTuple):
    """How records of one length are divided.

    Attributes:
        at: First sample of each part of each period.
        part: Part of whose centre each sample is the next one.
        beyond: Place of each sample between the centres of this part and the next one, 0 to 1.
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

    at: Int[np.ndarray, " part"]
    part: Int[np.ndarray, " time"]
    beyond: Float[np.ndarray, " time"]
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
    length = samples / (periods * BLOCKS)
    place = np.arange(samples) / length - 0.5
    part = np.floor(place).astype(int)
    at = np.minimum(np.rint(np.arange(periods * BLOCKS) * length), samples - 2).astype(int)
    bins = np.arange(periods, (samples + 1) // 2, periods)
    of_harmonic = max(periods - 1, 1)
    least = math.ceil(FEWEST / of_harmonic)
    most = max(bins.size // 64, least)
    # Below the pulse rate are drifts, and 1/f noise that is stronger than at any harmonic.
    edges = [1 if periods > 1 else min(UNSEEN, bins.size // 2)]
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
        at=at,
        part=part % BLOCKS,
        beyond=place - part,
        used=used.astype(np.float32),
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
    def of_each(self) -> Float[Array | np.ndarray, "*record harmonic"]:
        """`power`, but harmonics of the ends are not enlarged to be together as good as one."""
        return namespace(self.power).where(
            self.of_ends, self.power / self.power.shape[-1], self.power
        )

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
) -> Noise:
    """The noise of records.

    Args:
        v: Samples of the records.
        periods: Number of periods from `etid.signals.harmonics.whole_periods`; 1 if it is 0.
        samples: Number of samples from there; all of them if there is no period.
        rest: By how much the periods are longer [samples].
    """
    v = v[..., :samples]
    found, kept = _measured(v, periods)
    if isinstance(v, jax.Array):  # the choice of periods below depends on the values
        if periods > 1:
            return found
        white = jnp.vectorize(noise_std, signature="(time)->()")(v) ** 2 / samples
        return found._replace(
            power=jnp.where(kept < 1, found.power, white[..., None]),
            bins=jnp.where(kept[..., 0] < 1, found.bins, 0.0),
        )
    rest = np.broadcast_to(rest, v.shape[:-1])
    for place in map(tuple, np.argwhere(kept[..., 0] == 1)):
        of = _of_loud(v[place], periods, float(rest[place]), found.power.shape[-1])
        found.power[place], found.bins[place] = of
    return found


def _of_loud(
    v: Float[np.ndarray, " time"], periods: int, rest: float, count: int
) -> tuple[Float[np.ndarray, " harmonic"], float]:
    """Power and bins of the noise of a record whose signal is never quiet, such as a multisine.

    It leaks between the harmonics unless the periods end at a sample. If two or more of them do,
    the noise is measured in these; if not, it is taken for white.
    """
    whole = np.arange(2, periods + 1)
    ends = whole * ((v.size + rest) / periods)
    exact = np.flatnonzero(np.abs(ends - np.rint(ends)) < EXACT)
    if exact.size == 0:
        return np.full(count, _quietest(v) ** 2 / v.size), 0.0
    last = exact[-1]
    samples = round(float(ends[last]))
    of, _ = _measured(v[:samples], int(whole[last]))
    power = np.asarray(of.power)[np.minimum(np.arange(count), of.power.size - 1)]
    return power * (samples / v.size), float(of.bins)


def _measured(
    v: Float[Array | np.ndarray, "*record time"], periods: int
) -> tuple[Noise, Float[Array | np.ndarray, "*record 1"]]:
    """The noise at each harmonic, and the part of the record that the window has kept."""
    xp, samples = namespace(v), v.shape[-1]
    layout = _layout(periods, samples)
    if xp is np:  # one record after the other, because each fits into the cache of a processor
        each = zip(*(_between(of, periods) for of in v.reshape(-1, samples)), strict=True)
        sums, kept, usual = (np.reshape(of, (*v.shape[:-1], -1)) for of in each)
    else:
        sums, kept, usual = _between(v, periods)
    means = _smooth(sums / (samples**2 * kept), layout.number)
    rise = xp.concatenate([xp.diff(means, axis=-1), xp.zeros_like(kept)], axis=-1)
    power, rise = (xp.take(of, layout.below, axis=-1) for of in (means, rise))
    power = power + layout.above * rise
    # What a filter has left of the noise may be less than what the ends of the record bring. That
    # is one number, so that all these harmonics together are as good as one.
    # Drifts and hum below are treated elsewhere.
    leak = layout.leak * (2 * periods * power[..., power.shape[-1] // 64 :].sum(-1)[..., None])
    of_ends = leak * (10 * periods) > power
    power = xp.where(of_ends, xp.maximum(power, leak) * leak.shape[-1], power)
    bins = xp.full(kept.shape[:-1], layout.number.sum())
    return Noise(power, of_ends, usual[..., 0], bins), kept


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
    v: Float[Array | np.ndarray, "*record time"], periods: int
) -> tuple[Array | np.ndarray, ...]:
    """Mean power of the bins between the harmonics in each band, after a window.

    Returns:
        These powers, the mean square of the window, and `Noise.usual` with an axis of length 1.
    """
    xp, samples = namespace(v), v.shape[-1]
    layout = _layout(periods, samples)
    change = xp.diff(v)
    change = xp.add.reduceat(change * change, layout.at, axis=-1)
    change = change.reshape(*change.shape[:-1], periods, BLOCKS)
    loud = _loud(xp.sort(change, axis=-2)[..., periods // 2, :])
    of_period = xp.where(loud[..., None, :], 0.0, change).sum(-1)
    middle = xp.sort(of_period, axis=-1)[..., [periods // 2]]
    mean = of_period.mean(-1)[..., None]
    usual = xp.where((mean > 0) & (periods > 2), middle / xp.where(mean > 0, mean, 1.0), 1.0)
    if xp is np:
        window = _known(loud.tobytes(), periods, samples)
    else:
        window = _risen(loud, periods, samples)
    slope = xp.vecdot(v, layout.stairs)[..., None]
    quiet = (v - xp.mean(v, axis=-1, keepdims=True) - slope * layout.line) * window
    # In single precision it is faster, and exact to 1e-7 of the quiet parts.
    transform = np.fft.rfft(quiet.astype(np.float32)) if xp is np else jnp.fft.rfft(quiet)
    squares = xp.real(transform) ** 2 + xp.imag(transform) ** 2
    used = squares[..., : layout.used.size] * xp.asarray(layout.used, squares.dtype)
    sums = xp.add.reduceat(used, layout.edges, axis=-1) / np.maximum(layout.number - 1, 1.0)
    return sums, xp.vecdot(window, window)[..., None] / samples, usual


def _loud(
    change: Float[Array | np.ndarray, "*record part"],
) -> Bool[Array | np.ndarray, "*record part"]:
    """Which parts of a period change by more than the noise."""
    xp = namespace(change)
    usual = xp.sort(change, axis=-1)[..., [BLOCKS // 4]]
    # Without much louder parts nothing shows that the rest is quiet.
    pulsed = xp.max(change, axis=-1, keepdims=True) > PULSED * usual
    return (change > LOUD * usual) & pulsed


@functools.lru_cache(maxsize=64)
def _known(loud: bytes, periods: int, samples: int) -> Float[np.ndarray, " time"]:
    return np.asarray(_risen(np.frombuffer(loud, bool), periods, samples))


def _rise(place: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """A raised cosine from 0 to 1, over 2 `EDGE` parts around 0."""
    turn = np.clip(place / (2 * EDGE), -0.5, 0.5)
    return turn + 0.5 + np.sin(2 * np.pi * turn) / (2 * np.pi)


def _risen(
    loud: Bool[Array | np.ndarray, "*record part"], periods: int, samples: int
) -> Float[Array | np.ndarray, "*record time"]:
    """The window of records with these loud parts: 0 there, 1 from 2 `EDGE` parts beside them."""
    xp, layout = namespace(loud), _layout(periods, samples)
    near = xp.zeros(loud.shape, bool)
    for beside in range(-EDGE, EDGE + 1):
        near = near | xp.roll(loud, beside, axis=-1)
    far = xp.where(near, 0.0, 1.0)
    window = 0.0
    for part in range(-EDGE, EDGE + 2):  # smooth at every sample: kinks would be lines of the tail
        place = layout.beyond - part
        share = _rise(place + 0.5) - _rise(place - 0.5)
        window = window + far[..., (layout.part + part) % BLOCKS] * share
    return xp.where(xp.mean(window, axis=-1)[..., None] > QUIET, window, 1.0)


# --- White noise ---------------------------------------------------------------------------------


def _median(x: Float[Array, " sample"]) -> Float[Array, ""]:
    """Median of numbers that are not negative, by bisection.

    For an even count the result is one of the two middle numbers. `jnp.median` sorts, which costs
    ten times as much.
    """
    half, fixed = x.shape[0] / 2, jax.lax.stop_gradient(x)

    def halve(
        _: int | Int[Array, ""], bounds: tuple[Float[Array, ""], Float[Array, ""]]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        low, high = bounds
        middle = (low + high) / 2
        below = jnp.sum(fixed <= middle, dtype=x.dtype) < half
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    # To 1e-12 of the largest difference, which is at most 1e5 times the noise (at an edge).
    bounds = jnp.zeros((), x.dtype), jnp.max(fixed)
    low, high = jax.lax.fori_loop(0, 40, halve, bounds)
    return x[jnp.argmin(jnp.abs(fixed - (low + high) / 2))]


def noise_std(
    v: Float[Array | np.ndarray, "*record time"],
    resolution: Float[Array | np.ndarray, "*record"] | float = 0.0,
) -> Float[Array | np.ndarray, "*record"]:
    """Standard deviation of the white noise in `v`, in the unit of `v`.

    In records of more than 30 000 samples it comes from every second difference, in half of the
    time. Neighbouring differences share most of their samples, so the standard error grows from
    0.94 to 1.02 % only (33 330 samples). It is a weight, and enters standard errors and limits of
    tests in proportion.

    Args:
        v: Samples of the record, or of several records as an array of NumPy.
        resolution: Step of the converter, in the unit of `v`; 0 if it is not known.
    """
    floor = resolution / math.sqrt(12.0)
    if isinstance(v, np.ndarray):  # nothing is compiled
        middle = np.reshape(
            [_middle(record) for record in v.reshape(-1, v.shape[-1])], v.shape[:-1]
        )
        return np.asarray(np.maximum(PER_MEDIAN * middle, floor))
    size = jnp.abs(jnp.diff(v, ORDER)[:: _every(v.shape[0])])
    return jnp.maximum(PER_MEDIAN * _median(size), floor)


def _middle(v: Float[np.ndarray, " time"]) -> float:
    """The median size of the differences, one of them.

    Only the sizes between two limits are sorted, those around the median of every 16th size. This
    takes less than half of the time of a partition of all sizes.
    """
    sizes = np.abs(np.convolve(v, DIFFERENCE)[ORDER : v.size : _every(v.size)])
    half = sizes.size // 2
    sample = np.sort(sizes[::16])
    reach = round(1.5 * math.sqrt(sample.size))
    low = sample[max(sample.size // 2 - reach, 0)]
    high = sample[min(sample.size // 2 + reach, sample.size - 1)]
    between = np.compress((sizes >= low) & (sizes <= high), sizes)
    place = half - np.count_nonzero(sizes < low)
    if not 0 <= place < between.size:  # one record of a thousand, or it is not finite
        between, place = sizes, half
    between.partition(place)
    return float(between[place])


def _quietest(v: Float[np.ndarray, " time"]) -> float:
    """`noise_std` of a record without quiet parts, or the noise at the top of its band.

    The latter if the differences do not change their sign as those of white noise do, and if it is
    surely smaller.
    """
    sigma = float(noise_std(v))
    signs = np.signbit(np.convolve(v, DIFFERENCE)[ORDER : v.size])
    changes = [np.count_nonzero(signs[lag:] != signs[:-lag]) / v.size for lag in (1, 2)]
    if np.abs(np.subtract(changes, CHANGES)).max() < 2.5 / math.sqrt(v.size):
        return sigma
    window = np.hanning(v.size)
    squares = np.abs(np.fft.rfft(v * window)) ** 2 / np.sum(window**2)
    top = squares[round(0.38 * v.size) :]
    if top.size == 0:
        return sigma
    found = math.sqrt(float(np.median(top)) / math.log(2))
    # The median of n such powers has a relative error of 1.44/√n, its root of half of it.
    return found if found < (1 - 8 * 0.72 / math.sqrt(top.size)) * sigma else sigma


def _every(samples: int) -> int:
    """Step from one difference to the next."""
    return 2 if samples > 30_000 else 1


class Measurement(Module):
    """Both voltages of a recording and the noise of each.

    Attributes:
        v_th: Unloaded voltage [V].
        v_out: Loaded voltage [V].
        sigma_th: Standard deviation of the noise of `v_th` [V].
        sigma_out: Standard deviation of the noise of `v_out` [V].
        sample_rate: Sampling rate [Hz].
    """

    v_th: Float[Array, "*lane time"]
    v_out: Float[Array, "*lane time"]
    sigma_th: Float[Array, "*lane"]
    sigma_out: Float[Array, "*lane"]
    sample_rate: Float[Array, "*lane"]


def noise(
    v: Float[Array | np.ndarray, " time"], resolution: Float[Array | np.ndarray, ""]
) -> Float[Array | np.ndarray, ""]:
    """Noise of a record, in its unit and at least as large as the error of the interpolation."""
    xp = namespace(v)
    return xp.asarray(xp.maximum(noise_std(v, resolution), RIPPLE * xp.ptp(v)))
