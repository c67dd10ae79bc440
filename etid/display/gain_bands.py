"""Gain in bands of frequency, from the samples of one pulse.

**A window** is one period, cut at the nearest samples. It begins and ends in the quiet between two
pulses. Y(f) = G(f) X(f) therefore holds at the frequencies of the window, although they are not
exactly harmonics. With 3333 samples for a period of 3333⅓, the bias of an element is less than a
tenth of the standard error of 100 pulses at 60 dB. To fill a window up to 3360 samples gave a bias
of 1.5 times this standard error, because the voltage between two pulses is not at rest.

**A band** is a few neighbouring bins k, at most a quarter of their frequency wide. Over a band
the gain is nearly linear. The pulse determines it as

    Ĝ = Σ X̄_k Y_k / Σ (|X_k|² − σ_x²)    at    f = Σ |X_k|² f_k / Σ |X_k|².

`etid.display.projection` makes Ĝ of the samples. The bands reduce the numbers to be fitted to a
thirtieth. For the skin of Tables II and III and a delay of up to one sample, they bias no gain by
more than 0.05 standard errors of a pulse at 60 dB, and lose at most 0.7 % of the information about
an element.

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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.display.projection import BandSums, Projection
from etid.precision import Module
from etid.signals.harmonics import ALIASED
from etid.signals.mains import MAINS, MULTIPLES
from etid.signals.noise import RIPPLE
from etid.signals.transfer import as_complex, power

RELATIVE = 4  # frequency of a band over its width
WIDEST = 64  # [bins] largest width of a band
LAST_BAND = 8  # [bins] width of the last band, which has no neighbour to show its curvature
TAIL_SPREAD = 0.2  # of the rate of the tail, by the load, relative to that of the unloaded record
LAST = 1 / 26  # fraction of a period at its end whose mean is the tail
LOCKED = 0.03  # [harmonics] distance from a harmonic up to which the mains is locked to the pulses
FREE = 5  # windows of the unloaded record, beyond its unknowns, that must show its noise
ALIKE = 3  # bands on either side of a band that have nearly its noise


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


def _edges(bins: int) -> Int[np.ndarray, " band1"]:
    """First bin of each band, from bin 1 upwards, and the bin after the last band."""
    first, inner = [1], bins + 1 - LAST_BAND
    while first[-1] < inner:
        width = min(max(first[-1] // RELATIVE, 1), WIDEST)
        first.append(min(first[-1] + width, inner))
    return np.array([*first, bins + 1])


class Bands(Module):
    """The unloaded pulse, and the bands in which loaded pulses are compared with it.

    Attributes:
        x: Fourier coefficients of the unloaded pulse, not normalised, from bin 1 on [V].
        variance_x: E|noise|² of a coefficient in `x`, in each band [V²].
        noise: Variance of the noise in each band of the unloaded record, relative to that in the
            quiet between two pulses.
        hum: Bands in which hum of the mains may be locked to the pulses.
        lines: Cosine and sine of each line of the mains between the harmonics, as gains [1/V].
        frequency: Centre of each band [Hz].
        weight: Weight of |Ĝ − G|² before division by the variance of V_out [V²].
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
        sample_rate: Samples per second [Hz].
        samples: Length of a window [samples].
    """

    x: Complex[Array, " bin"]
    variance_x: Float[Array, " band"]
    noise: Float[Array, " band"]
    hum: Bool[Array, " band"]
    lines: Complex[Array, "pattern band"]
    frequency: Float[Array, " band"]
    weight: Float[Array, " band"]
    bent: Float[Array, "3 band"]
    turned: Float[Array, "3 band"]
    spread: Float[Array, " band"]
    alias: Complex[Array, " band"]
    tail: Complex[Array, "2 band"]
    tail_left: Float[Array, ""]
    sample_rate: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def waveform(
        self, gain: Complex[np.ndarray, " band"] | None = None, delay: float = 0.0
    ) -> Float[np.ndarray, " sample"]:
        """The pulse in the band of `x` [V].

        Args:
            gain: Gain in each band; the unloaded pulse without it.
            delay: Delay [samples].
        """
        spectrum = np.zeros(self.samples // 2 + 1, complex)
        turn = np.arange(1, self.x.size + 1) / self.samples  # per sample
        spectrum[1 : self.x.size + 1] = self.x * np.exp(-2j * np.pi * turn * delay)
        if gain is not None:
            centres = np.asarray(self.frequency) / self.sample_rate
            spectrum[1 : self.x.size + 1] *= np.interp(turn, centres, gain)
        return np.fft.irfft(spectrum, self.samples)

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
        sums: BandSums,
        noise: Float[Array, "lane band"],
        lacking: Float[Array, " lane"],
        offset: Float[Array, " lane"],
    ) -> tuple[Complex[Array, "lane band"], Float[Array, "lane band"]]:
        """Gains of one pulse at all electrodes, as if its amplitude had been constant.

        Args:
            sums: The bands of the windows.
            noise: Variance of the noise in each band, relative to that of the quiet.
            lacking: (A − B) / A, for a pulse of amplitude A after one of amplitude B.
            offset: Offset of the converter [V].

        Returns:
            Ĝ in each band, with the phase of the trigger delay, and the weight of |Ĝ − G|².
        """
        gain = sums.gain()
        tail = self._lacking_tail(sums, lacking, offset)
        unsure = self.weight[None, :] * power(0.2 * tail) / 2  # a fifth of the tail
        weight = self.weight[None, :] / (sums.variance[:, None] * noise + unsure)
        return gain + tail, weight

    def _lacking_tail(
        self, sums: BandSums, lacking: Float[Array, " lane"], offset: Float[Array, " lane"]
    ) -> Complex[Array, "lane band"]:
        """What the tail of the pulse before would add to the gain in the steady state.

        In the steady state, the mean over the last samples is late / (1 − lacking ρ). ρ is the part
        of the tail that is left after one period.
        """
        last, middle = round(LAST * self.samples), self.samples // 2
        means = sums.means()
        late = means.late - offset
        left = late / (1 - lacking * self.tail_left)
        # The rate of the loaded driver, as far as the noise lets it be seen.
        early = means.middle - offset
        decay = -jnp.log(self.tail_left) * (1 - (middle + last) / self.samples)
        ratio = early / late
        rate = jnp.log(jnp.where(ratio > 1, ratio, 1.0)) / decay - 1
        noise = sums.variance / self.samples / last * (1 / early**2 + 1 / late**2) / decay**2
        rate = rate * TAIL_SPREAD**2 / (TAIL_SPREAD**2 + noise)
        rate = jnp.where((ratio > 1) & jnp.isfinite(rate), rate, 0.0)
        shape = self.tail[0][None, :] + as_complex(rate)[:, None] * self.tail[1][None, :]
        return as_complex(lacking * left)[:, None] * shape


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


def _smoothed(
    values: Float[np.ndarray, " band"], hum: Bool[np.ndarray, " band"]
) -> Float[np.ndarray, " band"]:
    """Geometric means of neighbouring bands; where hum may be, that of the first ones above it."""
    first = min(int(hum.sum()), values.size - 1)
    ends = [slice(max(at - ALIKE, first), at + ALIKE + 1) for at in range(values.size)]
    logs = np.log(values)
    return np.exp([logs[ends[max(at, first)]].mean() for at in range(values.size)])


def unloaded_bands(
    v_th: Float[np.ndarray, " time"],
    sigma_th: float,
    sample_rate: float,
    period: float,
) -> tuple[Bands, Projection]:
    """Bands of an unloaded record, and the projection of loaded pulses on them.

    Args:
        v_th: Unloaded voltage of at least one whole period; it begins between two pulses [V].
        sigma_th: Standard deviation of the noise of a sample [V].
        sample_rate: Samples per second [Hz].
        period: Length of a period [samples].

    Raises:
        ValueError: The quiet between two pulses is too short.
    """
    windows = cut(v_th, period)
    size = windows.shape[-1]
    bins = int(ALIASED * size)
    number = np.arange(1, bins + 1)
    phase = np.array([round(p * period) - p * period for p in range(len(windows))])
    turned = np.exp(-2j * np.pi * np.outer(phase, number) / size)
    y = np.fft.rfft(windows)[:, 1 : bins + 1] * turned
    # Unknowns: X(f) and, if the phases differ enough, X(f − fs).
    design = np.exp(-2j * np.pi * np.outer(phase, [0, 1]))
    if abs(design[:, 1].mean()) > 0.9:
        design = design[:, :1]
    found = np.linalg.pinv(design) @ y
    share = np.linalg.inv(design.conj().T @ design)[0, 0].real
    variance = share * size * sigma_th**2
    x, aliased = found[0], found[1] if len(found) > 1 else np.zeros(bins)

    edges = _edges(bins)
    wide = np.diff(edges)

    def summed(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, edges[:-1] - 1, axis=-1)

    strength = summed(np.abs(x) ** 2)
    centre = summed(np.abs(x) ** 2 * number) / strength
    angle = 2 * np.pi * centre / size
    width = summed(np.abs(x) ** 2 * (number - np.repeat(centre, wide)) ** 2)
    signal = strength - wide * variance
    present = signal > 0.5 * strength  # a band whose X is mostly noise has no weight
    divisor = np.where(present, signal, strength)

    mean = windows.mean(axis=0)
    last, middle = round(LAST * size), size // 2
    means = np.zeros((3, size))
    means[0], means[1, middle : middle + last], means[2, -last:] = 1 / size, 1 / last, 1 / last
    chosen = np.repeat(np.arange(len(wide)), wide) == np.arange(len(wide))[:, None]
    weighted = np.where(chosen, x.conj() / np.repeat(divisor, wide), 0.0)
    spectra = np.zeros((len(wide), size), complex)
    spectra[:, 1 : bins + 1] = weighted
    rows = np.fft.fft(spectra, axis=1)
    whole = Projection.of(
        mean,
        sigma_th / math.sqrt(len(windows)),
        np.concatenate([rows.real, rows.imag, means]),
        size * (RIPPLE * float(np.ptp(v_th))) ** 2,
    )
    real, imaginary = np.split(whole.rows[:, :-3].T, 2)
    kept = (real + 1j * imaginary) * np.sqrt(whole.shares())
    shared = (kept @ kept.conj().T).real
    alone = np.diagonal(shared)
    correlation = shared / np.sqrt(alone[:, None] * alone)
    noise = alone * correlation.sum(axis=1)
    rate = _tail_rate(mean)
    # From the middle of the last samples to each sample of the next window.
    later = rate * (np.arange(size) + last / 2)
    tail = np.exp(-later) if rate > 0 else np.zeros(size)
    tails = np.stack([tail, -later * tail])
    spread = width / strength * (2 * np.pi / size) ** 2
    hum = centre * sample_rate / size < (MULTIPLES + 0.5) * max(MAINS)
    level, by_band = size * sigma_th**2, np.ones(len(wide))
    if len(windows) - len(found) >= FREE:
        level = float(whole.band_sums(windows, np.array([-np.inf, np.inf])).variance.mean())
        rest = summed((y - design @ found) * x.conj())
        squares = np.sum(np.abs(rest) ** 2, axis=0) / (len(windows) - len(found))
        by_band = _smoothed(np.maximum(squares / strength, whole.floor) / level, hum)
    time, cycles = np.arange(size) / sample_rate, [f * size / sample_rate for f in MAINS]
    between = [f for f, n in zip(MAINS, cycles, strict=True) if abs(n - round(n)) > LOCKED]
    waves = [wave(2 * np.pi * f * time) for f in between for wave in (np.cos, np.sin)]
    lines = np.reshape(waves, (len(waves), size)) @ rows.T
    first, second = _slopes(angle)
    bands = Bands(
        x=jnp.asarray(x),
        variance_x=jnp.asarray(share * level * by_band),
        noise=jnp.asarray(by_band),
        hum=jnp.asarray(hum),
        lines=jnp.asarray(lines),
        frequency=jnp.asarray(centre * sample_rate / size),
        weight=jnp.asarray(np.where(present, 2 * size / noise, 0.0)),
        bent=jnp.asarray(0.5 * spread * second),
        turned=jnp.asarray(spread * first),
        spread=jnp.asarray(spread),
        alias=jnp.asarray(summed(x.conj() * aliased) / strength),
        tail=jnp.asarray(tails @ rows.T),
        tail_left=jnp.asarray(np.exp(-rate * size) if rate > 0 else 0.0),
        sample_rate=sample_rate,
        samples=size,
    )
    return bands, whole.single()
