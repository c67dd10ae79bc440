"""Quick looks at records: which may have mains hum, few codes, disturbed or shifted periods.

Most records have none of these. A look is a few products or means of all samples; what it suspects
is examined by `etid.signals.mains`, `etid.signals.rounding` and `etid.signals.disturbances`.
Records of equal length and rates are looked at together.
"""

import functools
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.signals.mains import between, multiples

PROBED = 200_000  # [samples] longer records are not looked at: the probes would fill the memory
MERGED = 16  # samples that are averaged to compare periods


def humming(
    records: Float[np.ndarray, "*record time"],
    sigma: Float[np.ndarray, "*record"],
    sample_rate: float,
    pulse_rate: float,
    periods: int,
    samples: int,
) -> Bool[np.ndarray, "*record"]:
    """Whether records may have mains hum between the harmonics of the pulse rate.

    Args:
        records: Voltages [V].
        sigma: Standard deviation of the noise of a sample of each record [V].
        sample_rate: Samples per second [Hz].
        pulse_rate: Pulses per second [Hz].
        periods: Number of periods from `etid.signals.harmonics.whole_periods`.
        samples: Number of samples from `etid.signals.harmonics.whole_periods`.
    """
    if periods < 2:
        return np.zeros(sigma.shape, bool)
    if samples > PROBED:
        return sigma > 0
    probes, response = _hum_probes(sample_rate, periods, samples)
    size, limit = np.abs(_products(records, probes)).max(-1), 6 * sigma
    # A record that is not finite is refused later.
    suspect = (sigma > 0) & (size >= limit) & (size < np.inf)
    rest = min(abs(periods * sample_rate / pulse_rate - samples), 0.5)
    if rest > 0 and suspect.any():
        leaked = rest * response * np.abs(records[suspect, :samples]).mean(-1)
        suspect[suspect] = size[suspect] >= limit[suspect] + leaked
    return suspect


def uneven(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    step: Float[np.ndarray, "recording 2"],
    spacing: float,
    periods: int,
) -> Bool[np.ndarray, " recording"]:
    """Whether recordings may have disturbed or shifted periods; arguments as in `disturbed`.

    The median of the periods, to which `disturbed` compares them, lies between the lowest and the
    highest of them. Of two periods, nobody knows which one is disturbed.
    """
    if periods < 2 or spacing < 3 * MERGED:
        return np.zeros(len(records), bool)
    means = period_means(records, spacing, periods)
    shifted = _moved(records, means, sigma, spacing)
    if periods == 2:
        return shifted
    low, high = means.min(2), means.max(2)
    least, most = highest_beside(low), -highest_beside(-high)
    allowed = allowed_deviation(most, least, high.max(2), sigma, step)
    return ((high - low)[..., 1:-1] > allowed).any((1, 2)) | shifted


def shows_few(v: Float[np.ndarray, "*record time"]) -> Bool[np.ndarray, "*record"]:
    """Whether 256 samples at one end have few values, as those of a converter without noise.

    Where a load charges slowly, a pulse at the other end has many.
    """
    ends = np.sort(np.stack([v[..., :256], v[..., -256:]]), axis=-1)
    changes = np.count_nonzero(ends[..., 1:] != ends[..., :-1], axis=-1)
    return np.asarray((changes < 128).any(0))


def noise_limit(sigma: Float[np.ndarray, "recording 2"]) -> Float[np.ndarray, "recording 2"]:
    """Largest deviation of a mean of `MERGED` samples by noise: eight standard deviations [V]."""
    return 8.0 / MERGED**0.5 * sigma


def allowed_deviation(
    low: Float[np.ndarray, "recording 2 part"],
    high: Float[np.ndarray, "recording 2 part"],
    largest: Float[np.ndarray, "recording 2"],
    sigma: Float[np.ndarray, "recording 2"],
    step: Float[np.ndarray, "recording 2"],
) -> Float[np.ndarray, "recording 2 part"]:
    """By how much the means of a period may differ from the usual means [V].

    The limit is a part of the largest value, plus half of the value at the same place, plus the
    range of the means beside it.
    """
    # 0.0125 and 0.05 V at the converter in records of 2.5 V. A load cannot change the unloaded
    # voltage, so its limit is lower.
    part = np.array([0.005, 0.02]) * largest
    floor = np.maximum(part, noise_limit(sigma)) + step
    return 0.5 * np.maximum(high, -low) + np.maximum(high - low, 0) + floor[..., None]


def _moved(
    records: Float[np.ndarray, "recording 2 time"],
    means: Float[np.ndarray, "recording 2 period part"],
    sigma: Float[np.ndarray, "recording 2"],
    spacing: float,
) -> Bool[np.ndarray, " recording"]:
    """Whether periods of `v_out` may be shifted against those of `v_th`."""
    # Least-squares lag of each period. A shift by one sample changes a mean by a difference.
    at, length = _cuts(records.shape[2], spacing, means.shape[2])
    ends = sum(records[:, :, first : first + length : MERGED] for first in at) / len(at)
    change = np.diff(ends) / MERGED
    power = np.vecdot(change, change)
    power = np.where(power > 0, power, np.inf)
    lag = np.einsum("rvps,rvs->rvp", means[..., :-1], change) / power[..., None]
    spread = np.ptp(lag[:, 1] - lag[:, 0], axis=1)
    # [samples] In these means, cuts between samples seem to move periods by up to 0.09. A sample
    # that is lost between pulses moves them by 0.67 or more, one in the last pulse by 0.27.
    return spread > 0.18 + 3 * np.sqrt((sigma**2 / power).sum(1) / MERGED)


def _cuts(size: int, spacing: float, periods: int) -> tuple[Int[np.ndarray, " period"], int]:
    """First sample of each period, and the number of samples that are averaged."""
    length = int(spacing) // MERGED * MERGED
    return np.minimum(np.rint(np.arange(periods) * spacing), size - length).astype(int), length


def period_means(
    records: Float[np.ndarray, "recording 2 time"], spacing: float, periods: int
) -> Float[np.ndarray, "recording 2 period part"]:
    """Means of `MERGED` samples, less the median of their period, because the mean may drift."""
    at, length = _cuts(records.shape[2], spacing, periods)
    shape = (*records.shape[:2], -1, MERGED)
    cut = [records[:, :, first : first + length].reshape(shape) for first in at]
    means = np.stack([np.einsum("rvps->rvp", period) for period in cut], axis=2) / MERGED
    half = means.shape[3] // 2
    means -= np.partition(means, half, axis=3)[..., half, None]
    return means


def highest_beside(means: Float[np.ndarray, "*record part"]) -> Float[np.ndarray, "*record _"]:
    """The highest of each mean and the means beside it; not for the first and the last mean."""
    return np.maximum(np.maximum(means[..., :-2], means[..., 1:-1]), means[..., 2:])


def _mixtures(
    bins: Int[np.ndarray, " bin"], flipped: Bool[np.ndarray, " bin"], samples: int
) -> Float[np.ndarray, "probe time"]:
    """Four probes for bins of a transform, each with a square sum of 1; 0 without any bin.

    They are real and imaginary parts of two sums of the bins. In the second, those that are
    `flipped` have the other sign. Four products with a record take a tenth of a transform.
    """
    mixed = np.zeros((2, samples), dtype=complex)
    for m, other in zip(bins, flipped, strict=True):
        wave = np.exp(2j * np.pi * (m * np.arange(samples) % samples) / samples)
        mixed[0] += wave
        mixed[1] += -wave if other else wave
    probes = np.concatenate([np.real(mixed), np.imag(mixed)])
    return probes / math.sqrt(max(bins.size, 1) * samples / 2)


def _products(
    records: Float[np.ndarray, "*record time"], probes: Float[np.ndarray, "probe used"]
) -> Float[np.ndarray, "*record probe"]:
    """Products of records with `_mixtures`; samples beyond the probes are not used.

    A matrix product takes a tenth of the time of `einsum`. Its parts are so small that BLAS starts
    no threads.
    """
    flat, length = records.reshape(-1, records.shape[-1]), 1024
    products = np.zeros((len(flat), len(probes)))
    for first in range(0, probes.shape[1], length):
        part = probes[:, first : first + length]
        products += flat[:, first : first + part.shape[1]] @ part.T
    return products.reshape(*records.shape[:-1], -1)


@functools.lru_cache(maxsize=8)
def _hum_probes(
    sample_rate: float, periods: int, samples: int
) -> tuple[Float[np.ndarray, "probe time"], float]:
    """Four probes for hum, and their response to pulses.

    They are `_mixtures` of the bins beside the first three multiples.

    Returns:
        The probes, and the response of a probe to pulses of mean 1 if the record is one sample
        longer than its periods (see `etid.signals.mains`).
    """
    places = multiples(samples / sample_rate)[:, :3].ravel()
    bins = between(np.concatenate([np.floor(places), np.ceil(places)]).astype(int), periods)
    left = 2 * np.pi * bins / (periods * samples * np.abs(np.exp(2j * np.pi * bins / periods) - 1))
    # At 10 Hz all mains frequencies are harmonics: no bin is left, and the probes are 0.
    response = math.sqrt(2 * samples / max(bins.size, 1) * np.sum(left**2))
    return _mixtures(bins, np.arange(bins.size) % 4 >= 2, samples), response
