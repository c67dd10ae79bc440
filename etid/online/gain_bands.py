"""Gain in bands of frequency, from the samples of one pulse.

**A window** is one period, cut at the nearest samples. A few samples at its end are not used, so
that its Fourier transform is cheap. The windows begin and end in the quiet between two pulses.
Y(f) = G(f) X(f) therefore holds at the frequencies of the window, although they are not exactly
harmonics. With 3332 samples for a period of 3333⅓, the bias of an element is less than a tenth of
the standard error of 100 pulses at 60 dB. To fill a window up to 3360 samples gave a bias of 1.5
times this standard error, because the voltage between two pulses is not at rest.

**A band** is a few neighbouring bins k, at most a sixteenth of their frequency wide. Over a band
the gain is nearly linear. The pulse determines it as

    Ĝ = Σ X̄_k Y_k / Σ (|X_k|² − σ_x²)    at    f = Σ |X_k|² f_k / Σ |X_k|².

The residual of a straight line through the band is the noise of Y; this needs no model of the load.
The bands reduce the numbers to be fitted to a fifth, without loss of information.

**Aliases**, X(f − fs), cannot be distinguished from X(f) in one period. If a period is not a whole
number of samples, each period is sampled at a different phase φ [samples] and contains
X(f) + e^(−j2πφ) X(f − fs). An unloaded record of several periods therefore separates X from its
aliases, and predicts the aliases behind a load.

**The tail** of the pulse before reaches into a window, because the transformer is not at rest after
one period. If the amplitude has changed from B to A, the window lacks (A − B) / A of the tail that
it would have in the steady state. The tail decays exponentially, with the time constant τ of the
unloaded record; its value is what the window itself has at its end. With a step from 0.3 to 0.75
this part is 0.2 % of the pulse, which is far above the noise.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.harmonics import ALIASED
from etid.signals.noise import RIPPLE
from etid.signals.transfer import as_complex, power

RELATIVE = 16  # frequency of a band over its width
WIDEST = 16  # [bins] largest width of a band
REACH = 1e-3  # fraction of a period that the transform may leave out
PRESENT = 0.5  # minimum fraction of a band's power in X that must be signal
TAIL_SPREAD = 0.2  # of the rate of the tail, by the load, relative to that of the unloaded record
TAIL_ERROR = 0.2  # of the tail that an amplitude lacks after it has changed
LAST = 1 / 26  # fraction of a period at its end whose mean is the tail
DIVERSE = 0.9  # |mean e^(−j2πφ)| above which the sampling phases are too similar


def cut(
    v: Float[np.ndarray, "*lane time"], period: float
) -> Float[np.ndarray, "pulse *lane sample"]:
    """Windows of one pulse each, cut from longer records.

    Args:
        v: Records that begin between two pulses [V].
        period: Length of a period [samples].

    Returns:
        Windows of round(period) samples [V]. Each begins at the sample nearest to the start of its
        period.
    """
    size = round(period)
    begins = [round(p * period) for p in range(math.ceil(v.shape[-1] / period) + 1)]
    windows = [v[..., at : at + size] for at in begins if at + size <= v.shape[-1]]
    return np.stack(windows) if windows else np.zeros((0, *v.shape[:-1], size))


def _groups(bins: int) -> tuple[tuple[int, int, int], ...]:
    """Groups of bands of one width, from bin 1 upwards: (first bin, width [bins], bands)."""
    groups, first = [], 1
    for doubling in range(int(math.log2(WIDEST)) + 1):
        width = 2**doubling
        end = bins if width == WIDEST else min(bins, 2 * RELATIVE * width - 1)
        count = math.ceil((end - first + 1) / width)
        groups.append((first, width, count))
        first += width * count
    return tuple(group for group in groups if group[2] > 0)


class Gains(NamedTuple):
    """The measured gain of one pulse.

    Attributes:
        gain: Ĝ in each band; it includes the phase of the trigger delay.
        variance: E|noise|² of a Fourier coefficient of V_out [V²].
        weight: Weight of |Ĝ − G|².
    """

    gain: Complex[Array, "lane band"]
    variance: Float[Array, " lane"]
    weight: Float[Array, "lane band"]


class Bands(eqx.Module):
    """The unloaded pulse, and the bands in which loaded pulses are compared with it.

    Attributes:
        x: Fourier coefficients of the unloaded pulse, not normalised, from bin 1 on [V].
        variance_x: E|noise|² of a coefficient in `x` [V²].
        offset: Distance of each bin from the centre of its band [bins].
        frequency: Centre of each band [Hz].
        strength: Σ |X|² over each band [V²].
        signal: `strength` without the expected noise; equal to `strength` where noise dominates.
        weight: Weight of |Ĝ − G|² before division by the variance of V_out [V²].
        width: Σ |X|² offset² over each band [V²]; 0 for a band of one bin.
        bent: Coefficients of a function's values in the band before, the band itself and the next
            band. The sum of products is the function's mean over the band minus its value at the
            centre.
        turned: The same for the part that is proportional to a delay, per sample of delay and
            divided by −j.
        spread: Coefficient of the part that is proportional to the squared delay, per squared
            sample of delay and divided by −½ [rad²].
        alias: Σ X̄(f) X(f − fs) / Σ |X|², the alias per unit of gain at fs − f; 0 if it is unknown.
        tail: Σ X̄ E / Σ (|X|² − σ_x²), where E is the spectrum of the tail of the pulse before, per
            volt of the mean over the last samples of a window [1/V]; and its derivative with
            respect to the logarithm of the rate of decay. 0 if it is unknown.
        tail_left: Part of the tail that is left after one period.
        floor: Smallest variance that is accepted for a coefficient of V_out [V²].
        sample_rate: Samples per second [Hz].
        samples: Length of a window [samples].
        size: Length of the Fourier transform [samples].
        groups: Groups of bands of one width, as `_groups` returns them.
    """

    x: Complex[Array, " bin"]
    variance_x: Float[Array, ""]
    offset: Float[Array, " bin"]
    frequency: Float[Array, " band"]
    strength: Float[Array, " band"]
    signal: Float[Array, " band"]
    weight: Float[Array, " band"]
    width: Float[Array, " band"]
    bent: Float[Array, "3 band"]
    turned: Float[Array, "3 band"]
    spread: Float[Array, " band"]
    alias: Complex[Array, " band"]
    tail: Complex[Array, "2 band"]
    tail_left: Float[Array, ""]
    floor: Float[Array, ""]
    sample_rate: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    groups: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    def summed(self, values: Array) -> Array:
        """Sum over the bins of each band, along the last axis."""
        sums = []
        for first, width, count in self.groups:
            part = values[..., first - 1 : first - 1 + width * count]
            sums.append(part.reshape(*part.shape[:-1], count, width).sum(-1))
        return jnp.concatenate(sums, axis=-1)

    def departure(
        self, gain: Complex[Array, " band"], delay: Float[Array, ""]
    ) -> Complex[Array, " band"]:
        """Mean of a delayed gain over each band, minus its value at the centre of the band.

        The phase of the delay at the centre is removed. The difference is
        ½ s² (G″ − 2jτ G′ − τ² G), where s² is the variance of the frequency within the band.

        Args:
            gain: Gain G without a delay, at the centres.
            delay: Delay τ [samples].
        """
        ends = jnp.concatenate([gain[:1], gain, gain[-1:]])
        values = jnp.stack([ends[:-2], gain, ends[2:]])
        factor = jax.lax.complex(self.bent, -delay * self.turned)
        return jnp.sum(factor * values, axis=0) - as_complex(0.5 * delay**2 * self.spread) * gain

    def measure(
        self,
        v_out: Float[Array, "lane sample"],
        lacking: Float[Array, " lane"],
        offset: Float[Array, " lane"],
    ) -> Gains:
        """Gains and noise of one pulse at all electrodes, as if its amplitude had been constant.

        Args:
            v_out: One window per electrode [V].
            lacking: (A − B) / A, for a pulse of amplitude A after one of amplitude B.
            offset: Offset of the converter [V].
        """
        # Single precision takes two thirds of the time. Its error is 2e-8 of the peak, a
        # five-hundredth of the smallest noise that etid accepts for a record.
        y = _transform(v_out.astype(jnp.float32), self.size, self.x.shape[0]).astype(self.x.dtype)
        product = jnp.conj(self.x)[None, :] * y
        level = self.summed(product)
        slope = self.summed(product * as_complex(self.offset)[None, :])
        wide = self.width > 0
        explained = power(level) / self.strength[None, :]
        explained = explained + power(slope) / jnp.where(wide, self.width, 1.0)[None, :]
        rest = jnp.where(wide[None, :], self.summed(power(y)) - explained, 0.0)
        freedom = sum((width - 2) * count for _, width, count in self.groups if width > 1)
        variance = jnp.maximum(rest.sum(-1) / max(freedom, 1), self.floor)
        tail = self._lacking_tail(v_out, lacking, offset, variance)
        unsure = self.weight[None, :] * power(TAIL_ERROR * tail) / 2
        weight = self.weight[None, :] / (variance[:, None] + unsure)
        return Gains(level / as_complex(self.signal)[None, :] + tail, variance, weight)

    def _lacking_tail(
        self,
        v_out: Float[Array, "lane sample"],
        lacking: Float[Array, " lane"],
        offset: Float[Array, " lane"],
        variance: Float[Array, " lane"],
    ) -> Complex[Array, "lane band"]:
        """What the tail of the pulse before would add to the gain in the steady state.

        In the steady state, the mean over the last samples is late / (1 − lacking ρ). ρ is the part
        of the tail that is left after one period.
        """
        last, middle = round(LAST * self.samples), self.samples // 2
        late = v_out[:, -last:].mean(axis=1) - offset
        left = late / (1 - lacking * self.tail_left)
        # The rate of the loaded driver, as far as the noise lets it be seen.
        early = v_out[:, middle : middle + last].mean(axis=1) - offset
        decay = -jnp.log(self.tail_left) * (1 - (middle + last) / self.samples)
        ratio = early / late
        rate = jnp.log(jnp.where(ratio > 1, ratio, 1.0)) / decay - 1
        noise = variance / self.size / last * (1 / early**2 + 1 / late**2) / decay**2
        rate = rate * TAIL_SPREAD**2 / (TAIL_SPREAD**2 + noise)
        rate = jnp.where((ratio > 1) & jnp.isfinite(rate), rate, 0.0)
        shape = self.tail[0][None, :] + as_complex(rate)[:, None] * self.tail[1][None, :]
        return as_complex(lacking * left)[:, None] * shape


def _transform(v: Array, size: int, bins: int) -> Array:
    """Fourier coefficients from bin 1 on."""
    return jnp.fft.rfft(v[..., :size])[..., 1 : bins + 1]


def _cheap_size(samples: int) -> int:
    """The length near a period whose largest prime factor is smallest."""

    def largest(size: int) -> int:
        factor = 2
        while factor * factor <= size:
            if size % factor == 0:
                size //= factor
            else:
                factor += 1
        return size

    return min(range(samples, samples - round(REACH * samples) - 1, -1), key=largest)


def _slopes(
    x: Float[np.ndarray, " band"],
) -> tuple[Float[np.ndarray, "3 band"], Float[np.ndarray, "3 band"]]:
    """Coefficients of the first and second derivative at each point; 0 at the ends.

    The coefficients multiply the values before, at and after the point.
    """
    before, after = np.diff(x)[:-1], np.diff(x)[1:]
    both = before + after
    first = [-after / before / both, (after - before) / before / after, before / after / both]
    second = [2 / before / both, -2 / before / after, 2 / after / both]
    slopes = np.zeros((2, 3, x.size))
    slopes[:, :, 1:-1] = first, second
    return slopes[0], slopes[1]


def _tail_rate(v: Float[np.ndarray, " sample"]) -> float:
    """Rate at which the end of an unloaded window decays [1/sample]; 0 if it does not.

    Args:
        v: The window [V].
    """
    v = v - v.mean()
    last, middle = round(LAST * v.size), v.size // 2
    early, late = v[middle : middle + last].mean(), v[-last:].mean()
    ratio = early / late if late else 0.0
    return math.log(ratio) / (v.size - last - middle) if ratio > 1 else 0.0


def unloaded_bands(
    v_th: Float[np.ndarray, " time"],
    sigma_th: float,
    sample_rate: float,
    period: float,
) -> Bands:
    """Bands of an unloaded record.

    Args:
        v_th: Unloaded voltage of at least one whole period; it begins between two pulses [V].
        sigma_th: Standard deviation of the noise of a sample [V].
        sample_rate: Samples per second [Hz].
        period: Length of a period [samples].
    """
    windows = cut(v_th, period)
    samples = windows.shape[-1]
    size = _cheap_size(samples)
    bins = int(ALIASED * size)
    groups = _groups(bins)
    bins = sum(width * count for _, width, count in groups)
    phase = np.array([round(p * period) - p * period for p in range(len(windows))])
    turned = np.exp(-2j * np.pi * np.outer(phase, np.arange(1, bins + 1)) / size)
    y = np.asarray(_transform(jnp.asarray(windows), size, bins)) * turned
    # Unknowns: X(f) and, if the phases differ enough, X(f − fs).
    design = np.exp(-2j * np.pi * np.outer(phase, [0, 1]))
    if abs(design[:, 1].mean()) > DIVERSE:
        design = design[:, :1]
    found = np.linalg.pinv(design) @ y
    share = np.linalg.inv(design.conj().T @ design)[0, 0].real
    variance = share * size * sigma_th**2
    x, aliased = found[0], found[1] if len(found) > 1 else np.zeros(bins)

    number = np.arange(1.0, bins + 1)
    of = [
        (np.arange(first, first + width * count).reshape(count, width) - 1)
        for first, width, count in groups
    ]

    def summed(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values[index].sum(-1) for index in of])

    wide = np.concatenate([np.full(count, width) for _, width, count in groups])
    strength = summed(np.abs(x) ** 2)
    centre = summed(np.abs(x) ** 2 * number) / strength
    offset = number - np.repeat(centre, wide)
    angle = 2 * np.pi * centre / size
    width = np.where(wide > 1, summed(np.abs(x) ** 2 * offset**2), 0.0)
    signal = strength - wide * variance
    present = signal > PRESENT * strength
    divisor = np.where(present, signal, strength)
    rate = _tail_rate(windows.mean(axis=0))
    # From the middle of the last samples to each sample of the next window.
    later = rate * (np.arange(samples) + round(LAST * samples) / 2)
    tail = np.exp(-later) if rate > 0 else np.zeros(samples)
    tails = np.asarray(_transform(jnp.asarray([tail, -later * tail]), size, bins))
    spread = width / strength * (2 * np.pi / size) ** 2
    first, second = _slopes(angle)
    return Bands(
        x=jnp.asarray(x),
        variance_x=jnp.asarray(variance),
        offset=jnp.asarray(offset),
        frequency=jnp.asarray(centre * sample_rate / size),
        strength=jnp.asarray(strength),
        signal=jnp.asarray(divisor),
        weight=jnp.asarray(np.where(present, 2 * signal**2 / strength, 0.0)),
        width=jnp.asarray(width),
        bent=jnp.asarray(0.5 * spread * second),
        turned=jnp.asarray(spread * first),
        spread=jnp.asarray(spread),
        alias=jnp.asarray(summed(x.conj() * aliased) / strength),
        tail=jnp.asarray(np.stack([summed(x.conj() * one) for one in tails]) / divisor),
        tail_left=jnp.asarray(np.exp(-rate * samples) if rate > 0 else 0.0),
        floor=jnp.asarray(size * (RIPPLE * np.ptp(v_th)) ** 2),
        sample_rate=sample_rate,
        samples=samples,
        size=size,
        groups=groups,
    )
