"""From the samples of one pulse to the gain in bands of frequency.

One period is cut out as the samples nearest to it, less the few that make its Fourier transform
dear. Where windows begin and end in the quiet between two pulses, Y(f) = G(f) X(f) holds at their
frequencies too, although they are not quite harmonics: 3332 samples for a period of 3333⅓ bias an
element by less than a tenth of what the noise of 100 pulses at 60 dB leaves. The tail between two
pulses is not at rest: 3360 samples, those that are missing filled in, biased it by 1.5 times that.

**A band** is a few neighbouring bins k, a sixteenth of their frequency at most, over which a
gain is nearly linear. All that a pulse tells of it is

    Ĝ = Σ X̄_k Y_k / Σ (|X_k|² − σ_x²)    at    f = Σ |X_k|² f_k / Σ |X_k|²,

and what a straight line through the band leaves of Y is its noise, without a model of the load. A
fifth of the numbers is left to be fitted, without a loss.

**What has aliased**, X(f − fs), cannot be told from X(f) in one period. But periods that are no
whole number of samples are sampled at different phases φ [samples], and show
X(f) + e^(−j2πφ) X(f − fs): an unloaded record of several periods tells them apart, and with them
what aliases in a load.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.signals.harmonics import ALIASED
from etid.signals.measurement import RIPPLE
from etid.signals.transfer import as_complex, power

RELATIVE = 16  # bins of a band's frequency for each of its own
WIDEST = 16  # bins
REACH = 1e-3  # of a period, that its transform may leave out
PRESENT = 0.5  # part of a band's power in X that must not be noise
DIVERSE = 0.9  # |mean e^(−j2πφ)| from which on sampling phases are too much alike


def cut(
    v: Float[np.ndarray, "*lane time"], period: float
) -> Float[np.ndarray, "pulse *lane sample"]:
    """Windows of one pulse each from a longer record.

    Args:
        v: Records that begin between two pulses [V].
        period: Length of a period in samples.

    Returns:
        Windows of round(period) samples, each beginning at the sample nearest to its period.
    """
    size = round(period)
    begins = [round(p * period) for p in range(math.ceil(v.shape[-1] / period) + 1)]
    windows = [v[..., at : at + size] for at in begins if at + size <= v.shape[-1]]
    return np.stack(windows) if windows else np.zeros((0, *v.shape[:-1], size))


def _groups(bins: int) -> tuple[tuple[int, int, int], ...]:
    """(first bin, bins of a band, number of bands) of bands of one width, upwards from bin 1."""
    groups, first = [], 1
    for doubling in range(int(math.log2(WIDEST)) + 1):
        width = 2**doubling
        end = bins if width == WIDEST else min(bins, 2 * RELATIVE * width - 1)
        count = math.ceil((end - first + 1) / width)
        groups.append((first, width, count))
        first += width * count
    return tuple(group for group in groups if group[2] > 0)


class Gains(NamedTuple):
    """What one pulse tells.

    Attributes:
        gain: Ĝ, and with it the turn of a delay.
        variance: E|noise|² of a Fourier coefficient of V_out [V²].
    """

    gain: Complex[Array, "lane band"]
    variance: Float[Array, " lane"]


class Bands(eqx.Module):
    """The unloaded pulse, and the bands in which pulses are compared with it.

    Attributes:
        x: Its Fourier coefficients, unscaled, from bin 1 on [V].
        variance_x: E|noise|² of one of them [V²].
        offset: Bins from the centre of their band.
        frequency: Centres of the bands [Hz].
        strength: Σ |X|² [V²].
        signal: The same without noise; as it is where there is little else.
        weight: Σ of the squares of Ĝ − G is to be weighed with it, by the variance of V_out [V²].
        width: Σ |X|² offset²; 0 for a band of one bin.
        bent: By how much the mean over a band of a function of frequency differs from the function
            at its centre, by its values in the band before, itself and the next one.
        turned: By how much it differs for a delay of one sample, by the same values, divided by −j.
        spread: The same by the square of a delay, divided by −½ [rad²].
        alias: Σ X̄(f) X(f − fs) / Σ |X|²: what aliases, per gain at fs − f; 0 where it is not known.
        floor: Variance that no coefficient of V_out is trusted to have less of [V²].
        sample_rate: [Hz].
        samples: Of a window.
        size: Of a Fourier transform.
        groups: Bands of one width.
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
    floor: Float[Array, ""]
    sample_rate: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    size: int = eqx.field(static=True)
    groups: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    def summed(self, values: Array) -> Array:
        """Sums over the bins of each band, along the last axis."""
        sums = []
        for first, width, count in self.groups:
            part = values[..., first - 1 : first - 1 + width * count]
            sums.append(part.reshape(*part.shape[:-1], count, width).sum(-1))
        return jnp.concatenate(sums, axis=-1)

    def departure(
        self, gain: Complex[Array, " band"], delay: Float[Array, ""]
    ) -> Complex[Array, " band"]:
        """How the mean over a band of a delayed gain, turned back, departs from that at its centre.

        ½ s² (G″ − 2jτ G′ − τ² G), s² the variance of the frequency within the band.
        """
        ends = jnp.concatenate([gain[:1], gain, gain[-1:]])
        values = jnp.stack([ends[:-2], gain, ends[2:]])
        factor = jax.lax.complex(self.bent, -delay * self.turned)
        return jnp.sum(factor * values, axis=0) - as_complex(0.5 * delay**2 * self.spread) * gain

    def measure(self, v_out: Float[Array, "lane sample"]) -> Gains:
        """Gains and noise of one pulse at all electrodes."""
        # In single precision, which takes two thirds of the time: it loses 2e-8 of the peak, a
        # five-hundredth of what any record is trusted with.
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
        return Gains(level / as_complex(self.signal)[None, :], variance)


def _transform(v: Array, size: int, bins: int) -> Array:
    """Fourier coefficients from bin 1 on."""
    return jnp.fft.rfft(v[..., :size])[..., 1 : bins + 1]


def _cheap_size(samples: int) -> int:
    """A length next to a period whose largest prime factor is small."""

    def largest(size):
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
    """First and second derivative by the values before, at and after each point; 0 at the ends."""
    before, after = np.diff(x)[:-1], np.diff(x)[1:]
    both = before + after
    first = [-after / before / both, (after - before) / before / after, before / after / both]
    second = [2 / before / both, -2 / before / after, 2 / after / both]
    return np.pad(first, ((0, 0), (1, 1))), np.pad(second, ((0, 0), (1, 1)))


def unloaded_bands(
    v_th: Float[np.ndarray, " time"],
    sigma_th: float,
    sample_rate: float,
    period: float,
) -> Bands:
    """Bands of an unloaded record.

    Args:
        v_th: At least one whole period, from between two pulses on [V].
        sigma_th: Noise of a sample [V].
        sample_rate: [Hz].
        period: Length of a period in samples.
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
    # X(f) and, where the phases tell it from that, X(f − fs).
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

    def summed(values):
        return np.concatenate([values[index].sum(-1) for index in of])

    wide = np.concatenate([np.full(count, width) for _, width, count in groups])
    strength = summed(np.abs(x) ** 2)
    centre = summed(np.abs(x) ** 2 * number) / strength
    offset = number - np.repeat(centre, wide)
    angle = 2 * np.pi * centre / size
    width = np.where(wide > 1, summed(np.abs(x) ** 2 * offset**2), 0.0)
    signal = strength - wide * variance
    present = signal > PRESENT * strength
    spread = width / strength * (2 * np.pi / size) ** 2
    first, second = _slopes(angle)
    return Bands(
        x=jnp.asarray(x),
        variance_x=jnp.asarray(variance),
        offset=jnp.asarray(offset),
        frequency=jnp.asarray(centre * sample_rate / size),
        strength=jnp.asarray(strength),
        signal=jnp.asarray(np.where(present, signal, strength)),
        weight=jnp.asarray(np.where(present, 2 * signal**2 / strength, 0.0)),
        width=jnp.asarray(width),
        bent=jnp.asarray(0.5 * spread * second),
        turned=jnp.asarray(spread * first),
        spread=jnp.asarray(spread),
        alias=jnp.asarray(summed(x.conj() * aliased) / strength),
        floor=jnp.asarray(size * (RIPPLE * np.ptp(v_th)) ** 2),
        sample_rate=sample_rate,
        samples=samples,
        size=size,
        groups=groups,
    )
