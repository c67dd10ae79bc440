"""Mains hum, of 50 or 60 Hz and multiples.

Hum that does not fall on a harmonic of the pulse rate, as 50 Hz with pulses of 60 Hz, is seen in
the bins between the harmonics of a whole record, where pulses leave next to nothing. `separated`
fits sinusoids

    Σ_h Re z_h e^(j 2π h f n/fs),      h = 1 … 7,

to these bins, f being 50 or 60 Hz within 0.2 %, together with a slow drift, and subtracts them from
the samples.

Where hum falls on a harmonic, as 60 Hz does on the first of 60 Hz pulses, nothing but a model tells
one from the other: the harmonics on which hum may fall are `lines`, and
`etid.estimators.maximum_likelihood.terms` sees in the residual of a fit whether there is any.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.signals.harmonics import namespace

MAINS = (50.0, 60.0)  # [Hz]
MULTIPLES = 7  # of them; what comes above is a thousandth of the first in most laboratories
NEAR = 0.02  # of the mains frequency, by which a harmonic may be off its multiple
OFF = 2e-3  # by which mains may be off
BESIDE = 20  # bins on both sides of a multiple in which sinusoids must explain what is there
DRIFT = 3  # degree of the polynomial that drifts besides
SEEN = 6.0  # standard deviations of a probe
SURE = 80.0  # by which χ² must fall; noise and 15 parameters are above it once in 10⁹
PROBED = 200_000  # samples up to which probes are kept in memory
MISSED = 0.05  # of what a record that is not quite whole periods long leaves, by `_pulses`
LEFT = 0.1  # of what the bins have more than noise, that sinusoids may leave


class Hum(NamedTuple):
    """Sinusoids that were found in a record.

    Attributes:
        frequency: Of the mains [Hz].
        amplitude: z of each multiple [V].
    """

    frequency: float
    amplitude: Complex[np.ndarray, " multiple"]

    def __call__(self, samples: int, sample_rate: float) -> Float[np.ndarray, " time"]:
        """Its voltage [V]."""
        turn = np.exp(2j * np.pi * self.frequency / sample_rate * np.arange(samples))
        total, power = np.zeros(samples), np.ones(samples, complex)
        for z in self.amplitude:
            power = power * turn
            total += np.real(z * power)
        return total

    def covers(
        self, frequency: Float[np.ndarray, " harmonic"], periods: int
    ) -> Bool[np.ndarray, " harmonic"]:
        """Harmonics of a record of so many periods that are less than a bin from a multiple.

        What is subtracted there is not known better than what hum would do.
        """
        bin_width = frequency[0] / periods
        multiple = np.clip(np.round(frequency / self.frequency), 1, MULTIPLES)
        return np.abs(frequency - multiple * self.frequency) < bin_width


def lines(
    frequency: Float[Array | np.ndarray, "*lane harmonic"],
) -> Bool[Array | np.ndarray, "*lane harmonic"]:
    """Whether mains hum may fall on each harmonic.

    Args:
        frequency: The harmonics [Hz].
    """
    of = namespace(frequency)
    found = of.zeros(frequency.shape, bool)
    for mains in MAINS:
        multiple = of.round(frequency / mains)
        near = of.abs(frequency - multiple * mains) < NEAR * mains
        found = found | (near & (multiple > 0) & (multiple <= MULTIPLES))
    return found


def separated(
    v: Float[np.ndarray, " time"],
    sigma: Float[np.ndarray, ""],
    sample_rate: float,
    pulse_rate: float,
    periods: int,
    samples: int,
) -> Hum | None:
    """Hum that the bins between the harmonics show, if there is any.

    A drift, or pulses that change, fill these bins as well, but not as sinusoids do.

    Args:
        v: A record [V].
        sigma: Noise of a sample [V].
        sample_rate: Sampling rate [Hz].
        pulse_rate: Nominal pulses per second [Hz].
        periods: From `etid.signals.harmonics.whole_periods`.
        samples: From `etid.signals.harmonics.whole_periods`.
    """
    if periods < 2 or not sigma > 0 or not np.isfinite(v[:samples]).all():
        return None
    if samples <= PROBED:
        probes, left = _probes(sample_rate, periods, samples)
        found = np.abs(np.einsum("pn,n->p", probes, v[:samples])).max()
        rest = min(abs(periods * sample_rate / pulse_rate - samples), 0.5)
        if found < SEEN * sigma + rest * left * np.abs(v[:samples]).mean():
            return None
    return _found(v[:samples], float(sigma), sample_rate, periods)


def _between(bins: Int[np.ndarray, " bin"], periods: int) -> Int[np.ndarray, " between"]:
    """Those that are no harmonics."""
    bins = np.unique(bins)
    return bins[(bins % periods != 0) & (bins > 0)]


def _multiples(seconds: float) -> Float[np.ndarray, "mains multiple"]:
    """In bins of a record of this length."""
    return np.outer(MAINS, np.arange(1, MULTIPLES + 1)) * seconds


@functools.lru_cache(maxsize=8)
def _probes(
    sample_rate: float, periods: int, samples: int
) -> tuple[Float[np.ndarray, "probe time"], float]:
    """Four mixtures of the bins beside the first three multiples, each with a square sum of 1.

    Four products of each record in place of a transform, at a tenth of its cost. And what pulses
    of a mean of 1 leave in one, if the record is a sample longer than its periods (`_pulses`).
    """
    places = _multiples(samples / sample_rate)[:, :3].ravel()
    bins = _between(np.concatenate([np.floor(places), np.ceil(places)]).astype(int), periods)
    left = 2 * np.pi * bins / (periods * samples * np.abs(np.exp(2j * np.pi * bins / periods) - 1))
    mixtures = np.zeros((2, samples), dtype=complex)
    for number, m in enumerate(bins):
        wave = np.exp(2j * np.pi * (m * np.arange(samples) % samples) / samples)
        mixtures[0] += wave
        mixtures[1] += wave if number % 4 < 2 else -wave
    probes = np.concatenate([np.real(mixtures), np.imag(mixtures)])
    norm = math.sqrt(bins.size * samples / 2)
    return probes / norm, samples / norm * math.sqrt(np.sum(left**2))


@functools.lru_cache(maxsize=8)
def _near(
    sample_rate: float, periods: int, samples: int
) -> tuple[Int[np.ndarray, " bin"], Complex[np.ndarray, "bin degree"]]:
    """Bins near multiples of the mains that are no harmonics, and the powers of time there."""
    around = np.round(_multiples(samples / sample_rate)).astype(int).ravel()
    near = around[:, None] + np.arange(-BESIDE, BESIDE + 1)[None, :]
    bins = _between(near[near < samples // 2 - periods], periods)
    powers = np.linspace(-1, 1, samples)[:, None] ** np.arange(1, DRIFT + 1)[None, :]
    return bins, np.fft.rfft(powers, axis=0)[bins]


def _found(
    v: Float[np.ndarray, " time"], sigma: float, sample_rate: float, periods: int
) -> Hum | None:
    seconds = v.size / sample_rate
    bins, drifts = _near(sample_rate, periods, v.size)
    unit = sigma / math.sqrt(2 * v.size)  # of the real and of the imaginary part of a bin
    transform: Complex[np.ndarray, " all"] = np.fft.rfft(v) / v.size / unit
    others = np.concatenate([drifts, _pulses(v, transform, bins, periods)], axis=1)
    others = np.concatenate([np.real(others), np.imag(others)])
    others /= np.sqrt(np.sum(others**2, axis=0, keepdims=True))
    seen = np.concatenate([np.real(transform[bins]), np.imag(transform[bins])])
    drifting, before = (_rest(others[:, :count], seen) for count in (DRIFT, DRIFT + 2))
    if before - seen.size < max(SURE, MISSED * (drifting - before)):
        return None
    weak = np.ptp(v) / unit  # width of a prior, as hum on a harmonic leaves its amplitude open
    seen = np.concatenate([seen, np.zeros(2 * MULTIPLES)])
    prior = np.eye(2 * MULTIPLES, 2 * MULTIPLES + others.shape[1])

    def fitted(frequency: float) -> tuple[float, Complex[np.ndarray, " multiple"]]:
        places = frequency * seconds * np.arange(1, MULTIPLES + 1)[None, :]
        of, back = (_wave(at - bins[:, None], v.size) for at in (places, -places))
        waves = np.concatenate([of + back, 1j * (of - back)], axis=1) * (weak / 2)
        design = np.concatenate([np.real(waves), np.imag(waves)])
        design = np.concatenate([np.concatenate([design, others], axis=1), prior])
        q = np.linalg.lstsq(design, seen)[0]
        z = q[:MULTIPLES] + 1j * q[MULTIPLES : 2 * MULTIPLES]
        return float(np.sum((seen - design @ q) ** 2)), z * (weak * unit)

    def best(mains: float) -> tuple[float, float]:
        reach = OFF * mains
        count = 2 * math.ceil(4 * MULTIPLES * seconds * reach) + 3  # quarters of a bin, the highest
        grid = mains + np.linspace(-reach, reach, count)
        at = int(np.clip(np.argmin([fitted(f)[0] for f in grid]), 1, count - 2))
        found = scipy.optimize.minimize_scalar(
            lambda f: fitted(f)[0],
            bounds=(grid[at - 1], grid[at + 1]),
            method="bounded",
            options={"xatol": 1e-9 * mains},
        )
        return float(found.fun), float(found.x)

    after, frequency = min(map(best, MAINS))
    noise = seen.size + 4 * math.sqrt(2 * seen.size)
    if before - after < SURE or after - noise > LEFT * (before - seen.size):
        return None
    return Hum(frequency, fitted(frequency)[1])


def _rest(columns: Float[np.ndarray, "row column"], seen: Float[np.ndarray, " row"]) -> float:
    """Sum of squares that the columns leave."""
    return float(np.sum((seen - columns @ np.linalg.lstsq(columns, seen)[0]) ** 2))


def _pulses(
    v: Float[np.ndarray, " time"],
    transform: Complex[np.ndarray, " all"],
    bins: Int[np.ndarray, " bin"],
    periods: int,
) -> Complex[np.ndarray, "bin 2"]:
    """What pulses leave between their harmonics if the record is not quite P periods long.

    If it is ρ samples too short, Σ_p e^(−j 2π m p (1 + ρ/N)/P), the sum over the pulses, is not 0
    but −j 2π m ρ / (N (w − 1)), w = e^(−j 2π m/P); the transform of one pulse is what the harmonics
    beside say. Another column, with m, is for what their interpolation misses.
    """
    one = v.size // periods
    late = int(np.argmax(np.abs(v[:one])))
    known = np.arange(0, bins.max() + periods + 1, periods)
    turned = transform[known] * np.exp(2j * np.pi * known * late / v.size)
    turned[0] = 0.0  # a transformer passes no mean
    pulse = np.interp(bins, known, turned.real) + 1j * np.interp(bins, known, turned.imag)
    pulse = pulse * np.exp(-2j * np.pi * bins * late / v.size)
    left = -1j * bins * pulse / (np.exp(-2j * np.pi * bins / periods) - 1)
    return np.stack([left, left * bins], axis=1)


def _wave(
    turns: Float[np.ndarray, "bin multiple"], samples: int
) -> Complex[np.ndarray, "bin multiple"]:
    """Mean of e^(j 2π t n/N), n = 0 … N−1."""
    angle = 2 * np.pi * turns
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.expm1(1j * angle) / np.expm1(1j * angle / samples) / samples
    return np.where(angle == 0, 1.0, mean)
