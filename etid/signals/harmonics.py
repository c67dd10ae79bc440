"""Harmonics of the pulse rate: synchronous averaging and a Fourier transform in one step.

A record is cut to P whole periods, to the nearest sample: M samples. The discrete Fourier transform
at every P-th bin, f_k = k P fs/M, averages the periods. M need not be a multiple of P, and the
clock need not be exact: a linear system that is at rest at both ends of the window obeys
Y(f) = G(f) X(f) at any frequency.

Aliases, k f0 − fs, fall into the bins between the harmonics. There are two exceptions: a period of
a whole number of samples, and a record of one period. Then the upper part of the band is not used,
because anti-alias filters are imperfect there.

**Aliases on the harmonics.** If a period is a whole number of samples, the alias of the harmonic at
fs − f falls on the harmonic at f. The record then holds X + A with |A(f)| = |X(fs − f)|, and all
periods are alike. A is not known, but its size is: near half the sample rate fs/2 and beyond, the
spectrum of a pulse falls with a power of the frequency,

    |X(f)|² = S f^(−p).

Two bands of the record determine S and p. They end below fs/2, where A may cancel X. An anti-alias
filter makes the spectrum fall faster and faster, so that this A is up to three times too large.

A load acts on A as on X at fs − f, not as on X at f. So A is an error of the measured gain. Unlike
noise, it is smooth in frequency: the n harmonics within a part `COHERENT` of the sample rate have
nearly the same relative error. They determine the gain as well as if they had independent errors
of the variance n |A|². This variance adds to that of the noise.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.precision import Module, namespace
from etid.signals.transfer import AnyArray, Values, power

WINDOW = 25  # harmonics over which power is averaged
ALIASED = 0.35  # of the sample rate; above, aliases matter unless they fall between the harmonics
DRIFT_DEGREE = 3  # degree of the polynomial that describes the drift of the mean
ABSENT = 1e-6  # [standard deviations] coefficient and noise of a padded harmonic
ROUNDING = 1e-12  # relative difference of two transforms of the same samples


class Spectrum(Module):
    """Fourier coefficients [V] of both records at the harmonics.

    Attributes:
        frequency: Harmonics of the pulse rate [Hz].
        x: Coefficients of V_th.
        y: Coefficients of V_out.
        variance_x: E|noise|² of each coefficient of `x` [V²].
        variance_y: E|noise|² of each coefficient of `y` [V²].
        selected: Harmonics that are used; all of them if aliases fall between them.
        whole: Whether the records are whole periods. If not, these are the bins of the transform of
            any record, but for bin 0.
        held: Whether `x` is that of a command that a converter holds between samples.
    """

    frequency: Float[AnyArray, "*lane harmonic"]
    x: Complex[AnyArray, "*lane harmonic"]
    y: Complex[AnyArray, "*lane harmonic"]
    variance_x: Float[AnyArray, "*lane harmonic"]
    variance_y: Float[AnyArray, "*lane harmonic"]
    selected: Bool[AnyArray, "*lane harmonic"]
    whole: bool = eqx.field(static=True, default=True)
    held: bool = eqx.field(static=True, default=False)


def same_unloaded(
    one: Complex[AnyArray, "... harmonic"], other: Complex[AnyArray, "... _"]
) -> Bool[AnyArray, "..."] | bool:
    """Whether the X of recordings are transforms of the same unloaded record."""
    if one is other:
        return True
    if one.shape[-1] != other.shape[-1]:
        return False
    return power(one - other).sum(-1) <= ROUNDING**2 * power(other).sum(-1)


def whole_periods(samples: int, sample_rate: float, pulse_rate: float) -> tuple[int, int]:
    """Number of whole periods in a record, and their length in samples.

    The last period may lack half a sample: 3333 samples are one period of 60 Hz at 200 kHz.

    Returns:
        Number of periods (0 if there is none) and number of samples, rounded.
    """
    periods = int((samples + 0.5) * pulse_rate / sample_rate)
    return periods, min(samples, round(periods * sample_rate / pulse_rate))


def separates_aliases(periods: int, samples: int) -> bool:
    """Whether aliases fall between the bins of the harmonics."""
    return periods > 1 and samples % periods != 0


def joins_aliases(periods: int, samples: int) -> bool:
    """Whether aliases fall on the harmonics in all of several periods alike."""
    return periods > 1 and samples % periods == 0


def harmonics(
    v: Float[Array | np.ndarray, "*record time"], periods: int, samples: int
) -> Complex[Array | np.ndarray, "*record harmonic"]:
    """Fourier coefficients (1/M) Σ v[n] e^(−j2πkPn/M) for k = 1 … below half the sample rate.

    The drift of the mean from period to period is removed. Two records at once take as long as one.
    """
    xp, v = namespace(v), v[..., :samples]
    at_harmonics = harmonics_of(v, periods)
    basis, fit, _ = _drift(periods, samples)
    # The transform is linear: the drift needs only the transforms of the powers of time.
    drift = xp.einsum("dp,...p->...d", fit, _sums(v, periods))
    # `@` would start BLAS threads for each recording, and these threads wait for each other.
    if xp is np:  # real and imaginary parts are real products
        return at_harmonics - np.einsum("...d,dh->...h", drift, basis.view(float)).view(complex)
    return at_harmonics - jnp.einsum("...d,dh->...h", drift.astype(basis.dtype), basis)


def harmonics_of(
    v: Float[Array | np.ndarray, "*record time"], periods: int
) -> Complex[Array | np.ndarray, "*record harmonic"]:
    """`harmonics` of records of whole periods, with their drift."""
    # Only bins that are multiples of `parts` are needed. They are the bins of the sum of so many
    # equal parts of the record, which is shorter.
    samples = v.shape[-1]
    parts = math.gcd(periods, samples)
    folded = v if parts == 1 else v.reshape(*v.shape[:-1], parts, -1).sum(-2)
    step = periods // parts
    transform = namespace(v).fft.rfft(folded)
    return transform[..., step : (folded.shape[-1] + 1) // 2 : step] / samples


def flat(v: Float[np.ndarray, "*record time"], periods: int) -> Float[np.ndarray, "*record time"]:
    """Records of whole periods without the drift of the mean that `harmonics` removes."""
    _, fit, powers = _drift(periods, v.shape[-1])
    drift = np.einsum("dp,...p->...d", fit, _sums(v, periods))
    return v - np.einsum("...d,td->...t", drift, powers)


def real_parts(values: Values) -> Values:
    """Real parts, then imaginary parts, along the last axis."""
    xp = namespace(values)
    return xp.concatenate([xp.real(values), xp.imag(values)], axis=-1)


def _sums(v: Array | np.ndarray, periods: int) -> Array | np.ndarray:
    """Sum over each period along the last axis; a period may end between two samples."""
    xp, samples = namespace(v), v.shape[-1]
    ends = np.arange(periods + 1) * (samples / periods)
    whole = np.minimum(ends.astype(int), samples - 1)
    between = xp.add.reduceat(v, whole, axis=-1)[..., :-1]
    return between + xp.diff(xp.einsum("p,...p->...p", ends - whole, v[..., whole]), axis=-1)


@functools.lru_cache(maxsize=64)
def _drift(
    periods: int, samples: int
) -> tuple[
    Complex[np.ndarray, "degree harmonic"],
    Float[np.ndarray, "degree period"],
    Float[np.ndarray, "time degree"],
]:
    """Transforms of the powers of time, the matrix from period sums to coefficients, the powers."""
    powers = np.vander(np.linspace(-1, 1, samples), min(periods, DRIFT_DEGREE + 1), increasing=True)
    transforms = np.fft.rfft(powers, axis=0) / samples
    fit = np.linalg.pinv(np.asarray(_sums(powers.T, periods)).T)
    at_harmonics = transforms[periods : (samples + 1) // 2 : periods]
    return np.ascontiguousarray(at_harmonics.T), fit, powers


def local_sum(values: Float[Values, "*row harmonic"]) -> Float[Values, "*row harmonic"]:
    """Sum over the `WINDOW` harmonics around each harmonic.

    Not `jnp.convolve`: under `vmap` it becomes one convolution over all lanes, so that a NaN in
    one lane spoils the others. Its compiled code has also read beyond its input.
    """
    count = values.shape[-1]
    size = min(WINDOW, count)
    if isinstance(values, np.ndarray):
        before = (size - 1) // 2
        sums = np.zeros((*values.shape[:-1], count + size))
        np.cumsum(values, axis=-1, out=sums[..., before + 1 : before + 1 + count])
        sums[..., before + 1 + count :] = sums[..., [before + count]]
        return sums[..., size:] - sums[..., :-size]
    ones = (1,) * (values.ndim - 1)
    return jax.lax.reduce_window(values, 0.0, jax.lax.add, (*ones, size), (*ones, 1), "SAME")


def signal_share(
    coefficients: Complex[Values, "*row harmonic"], variance: Float[Values, "*row harmonic"]
) -> Float[Values, "*row harmonic"]:
    """Fraction of the power of noisy coefficients that is signal, locally averaged; 0 to 1."""
    xp = namespace(coefficients)
    total, noise = local_sum(power(coefficients)), local_sum(variance)
    return xp.clip(1 - noise / xp.where(total > 0, total, 1.0), 0.0, 1.0)


def filled(
    coefficients: Complex[Array | np.ndarray, "*recording 2 harmonic"],
    noise: Float[Array | np.ndarray, "*recording 2 harmonic"],
    sample_rate: Float[Array | np.ndarray, ""] | float,
    periods: int,
    samples: int,
) -> tuple[Array | np.ndarray, ...]:
    """The fields of a `Spectrum` from the `harmonics` of both records and their noise.

    Harmonics below the noise stay selected: the likelihood weights them correctly. To drop weak
    harmonics would lose more information at 24 to 40 dB than they disturb. Padded harmonics follow
    the last harmonic, up to a multiple of 64. They are not selected and almost zero; they give
    records of most lengths the same number of harmonics, so that compiled programs are shared.
    Several recordings of equal length share `frequency` and `selected`.

    Args:
        coefficients: `harmonics` of the unloaded and of the loaded voltage [V].
        noise: Their E|noise|² [V²], from `etid.signals.noise.noise_of`.
        sample_rate: Sampling rate [Hz].
        periods: Number of periods from `whole_periods`.
        samples: Number of samples from `whole_periods`.
    """
    xp, count = namespace(coefficients), coefficients.shape[-1]
    number = np.arange(1.0, count + -count % 64 + 1)
    frequency = number * (periods * sample_rate / samples)
    absent = xp.broadcast_to(ABSENT**2 * noise[..., :1], (*noise.shape[:-1], number.size - count))
    padded = xp.concatenate([coefficients, absent.astype(coefficients.dtype) ** 0.5], axis=-1)
    variance = xp.concatenate([noise, absent], axis=-1)
    (x, y), (variance_x, variance_y) = (xp.moveaxis(both, -2, 0) for both in (padded, variance))
    highest = 0.5 if separates_aliases(periods, samples) else ALIASED
    selected = (frequency < highest * sample_rate) & (number <= count)
    return frequency, x, y, variance_x, variance_y, selected


# --- Aliases that fall on the harmonics -----------------------------------------------------------


# All are relative to the sample rate.
LOWER, UPPER = (0.33, 0.38), (0.40, 0.45)  # bands that show how the spectrum falls
COHERENT = 0.05  # width over which aliases have nearly the same relative error
OCTAVES, BEYOND = (0.1, 0.05, 0.025, 0.0125), (0.25, 0.5)  # bands that show whether one has ended
END = 5.0  # the power of edges falls with p = 2, behind a filter of 60 kHz at 200 kHz with 3.8


class Aliases(NamedTuple):
    """What has aliased onto the harmonics of a record.

    Attributes:
        power: |A|² at each harmonic [V²]; 0 if the spectrum ends in the noise.
        fall: The power p; 0 if the spectrum does not fall.
        harmonics: Number of harmonics with the same relative error, n.
    """

    power: Float[Array | np.ndarray, "*record harmonic"]
    fall: Float[Array | np.ndarray, "*record"]
    harmonics: float

    @property
    def variance(self) -> Float[Array | np.ndarray, "*record harmonic"]:
        """Variance of independent errors that stand for A [V²]."""
        return self.harmonics * self.power

    def are_unknown(
        self, variance: Float[np.ndarray, "*record harmonic"]
    ) -> Bool[np.ndarray, "*record"]:
        """Whether A exceeds noise of this variance, and its size does not follow from the record.

        A is compared at the highest harmonic of a fit, where it is largest. A spectrum may be
        continued beyond half the sample rate if it falls by 30 dB per octave there. Drivers whose
        parts differ by 10 % have p of 11.5 to 14.8 behind an anti-alias filter of fourth order at
        0.4 of 200 to 500 kHz, and without one 7.3 to 12.8, half of them less than 9. Without one
        the elements were up to six standard errors off, because the spectrum falls more slowly
        where nothing is measured.
        """
        last = int(ALIASED * self.harmonics / COHERENT) - 1
        return np.asarray((self.variance[..., last] > variance[..., last]) & (self.fall < 11.0))


def aliases(
    coefficients: Complex[Array | np.ndarray, "*record harmonic"],
    variance: Float[Array | np.ndarray, "*record harmonic"],
    periods: int,
    samples: int,
) -> Aliases:
    """The aliases on the harmonics of records."""
    xp = namespace(variance)
    position = np.arange(1.0, variance.shape[-1] + 1) * (periods / samples)
    squares = xp.real(coefficients) ** 2 + xp.imag(coefficients) ** 2
    signals, errors = [], []
    for low, high in (LOWER, UPPER):
        inside = (position >= low) & (position < high)
        count = float(max(np.count_nonzero(inside), 1))
        noise = xp.sum(xp.where(inside, variance, 0.0), axis=-1) / count
        signals.append(xp.sum(xp.where(inside, squares, 0.0), axis=-1) / count - noise)
        errors.append(noise / np.sqrt(count))
    exceeds_noise = signals[1] > 3.0 * errors[1]
    falls = exceeds_noise & (signals[0] > signals[1])
    lower, upper = (xp.where(falls, signal, 1.0) for signal in signals)
    middle = sum(UPPER) / 2
    fall = xp.log(lower / upper) / np.log(middle * 2 / sum(LOWER))
    level = xp.where(exceeds_noise, signals[1], 0.0)
    # Padded harmonics lie above half the sample rate; they have no aliases.
    mirrored = np.log(np.maximum(1 - position, 0.5) / middle)
    power = level[..., None] * xp.exp(-fall[..., None] * mirrored)
    return Aliases(power, fall, COHERENT * samples / periods)


def have_ended(
    coefficients: Sequence[Complex[np.ndarray, "record harmonic"]],
    variances: Sequence[Float[np.ndarray, "record harmonic"]],
    periods: int,
    samples: int,
) -> Bool[np.ndarray, " record"]:
    """Whether both records surely end below half the sample rate, so that they have no aliases.

    From one of the octaves, the spectrum of the cause falls so far that what noise may hide beyond,
    three standard errors, is less than edges would have there. Noise that hides a spectrum proves
    no end. Nothing but noise is beyond in the other record: a record that does not close leaks into
    all harmonics. The estimate of the noise has two standard errors of these, so that eight of them
    are allowed.
    """
    position = np.arange(1.0, variances[0].shape[1] + 1) * (periods / samples)
    beyond = (position >= BEYOND[0]) & (position < BEYOND[1])
    falls = np.zeros(len(variances[0]), bool)
    if not beyond.any():
        return falls
    excess = [np.square(np.abs(c)) - v for c, v in zip(coefficients, variances, strict=True)]
    errors = [v[:, beyond].mean(1) / math.sqrt(np.count_nonzero(beyond)) for v in variances]
    of_cause = np.maximum(excess[0][:, beyond].mean(1), 0.0) + 3 * errors[0]
    for low in OCTAVES:
        inside = (position >= low) & (position < 2 * low)
        if inside.any():
            level = of_cause * (sum(BEYOND) / (3 * low)) ** END
            falls |= excess[0][:, inside].mean(1) > level
    return falls & (excess[1][:, beyond].mean(1) < 8 * errors[1])
