"""Mains hum of 50 or 60 Hz and multiples.

**Hum between the harmonics of the pulse rate**, such as 50 Hz with pulses of 60 Hz, appears in the
bins between the harmonics of the whole record. Pulses leave almost nothing in these bins.
`separated` fits sinusoids

    Σ_h Re z_h e^(j 2π h f n/fs),      h = 1 … 7,

and a slow drift to these bins, with f within 0.2 % of 50 or 60 Hz. The sinusoids that it returns
can be subtracted from the samples.

**Hum on a harmonic**, such as 60 Hz with pulses of 60 Hz, can be distinguished from the pulses only
by a model. `lines` marks the harmonics on which hum may fall.
`etid.likelihood.noise` detects it there in the residual of a fit.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.signals.harmonics import DRIFT_DEGREE, namespace

MAINS = (50.0, 60.0)  # [Hz]
OF_PULSES = 2  # columns of `_pulses`
MULTIPLES = 7  # higher multiples are a thousandth of the first in most laboratories


class Hum(NamedTuple):
    """Sinusoids that were found in a record.

    Attributes:
        frequency: Mains frequency f [Hz].
        amplitude: Complex amplitude z_h of each multiple [V].
    """

    frequency: float
    amplitude: Complex[np.ndarray, " multiple"]

    def __call__(self, samples: int, sample_rate: float) -> Float[np.ndarray, " time"]:
        """Voltage of the hum at each sample [V]."""
        turn = np.exp(2j * np.pi * self.frequency / sample_rate * np.arange(samples))
        total, power = np.zeros(samples), np.ones(samples, complex)
        for z in self.amplitude:
            power = power * turn
            total += np.real(z * power)
        return total

    def covers(
        self, frequency: Float[np.ndarray, " harmonic"], periods: int
    ) -> Bool[np.ndarray, " harmonic"]:
        """Whether each harmonic is less than one bin from a multiple of the mains.

        There the fitted sinusoid is as uncertain as the hum itself, so it cannot correct the
        harmonic.
        """
        bin_width = frequency[0] / periods
        multiple = np.clip(np.round(frequency / self.frequency), 1, MULTIPLES)
        return np.abs(frequency - multiple * self.frequency) < bin_width


def lines(
    frequency: Float[Array | np.ndarray, "*lane harmonic"],
) -> Bool[Array | np.ndarray, "*lane harmonic"]:
    """Whether mains hum may fall on each harmonic: within 2 % of the mains frequency."""
    xp = namespace(frequency)
    on_line = xp.zeros(frequency.shape, bool)
    for mains in MAINS:
        multiple = xp.round(frequency / mains)
        near = xp.abs(frequency - multiple * mains) < 0.02 * mains
        on_line = on_line | (near & (multiple > 0) & (multiple <= MULTIPLES))
    return on_line


def separated(
    v: Float[np.ndarray, " time"], sigma: float, sample_rate: float, periods: int, samples: int
) -> Hum | None:
    """Hum in the bins between the harmonics; None if there is none.

    A drift or changing pulses also fill these bins, but not in the pattern of sinusoids.
    """
    v = v[:samples]
    return _fit(v, sigma, sample_rate, periods) if np.isfinite(v).all() else None


def between(bins: Int[np.ndarray, " bin"], periods: int) -> Int[np.ndarray, " between"]:
    """The bins that are not harmonics, sorted."""
    bins = np.unique(bins)
    return bins[(bins % periods != 0) & (bins > 0)]


def multiples(seconds: float) -> Float[np.ndarray, "mains multiple"]:
    """Multiples of the mains in units of a bin, for a record of `seconds`."""
    return np.outer(MAINS, np.arange(1, MULTIPLES + 1)) * seconds


@functools.lru_cache(maxsize=8)
def _near(
    sample_rate: float, periods: int, samples: int
) -> tuple[Int[np.ndarray, " bin"], Complex[np.ndarray, "bin degree"]]:
    """Bins near multiples of the mains, without harmonics, and the powers of time in these bins."""
    around = np.round(multiples(samples / sample_rate)).astype(int).ravel()
    near = around[:, None] + np.arange(-20, 21)[None, :]
    bins = between(near[near < samples // 2 - periods], periods)
    powers = np.linspace(-1, 1, samples)[:, None] ** np.arange(1, DRIFT_DEGREE + 1)[None, :]
    return bins, np.fft.rfft(powers, axis=0)[bins]


def _fit(
    v: Float[np.ndarray, " time"], sigma: float, sample_rate: float, periods: int
) -> Hum | None:
    """Hum by least squares; None if the sinusoids explain too little of the bins.

    Two periods have 32 numbers for 19 parameters, which also fit pulses that the ends cut.
    χ² must fall by 80, which noise and 15 parameters exceed once in 10⁹. `_pulses` may fail to
    describe 5 % of the leakage of pulses. Sinusoids may leave a tenth of the excess over noise.
    """
    seconds = v.size / sample_rate
    bins, drifts = _near(sample_rate, periods, v.size)
    if bins.size < 2 * MULTIPLES + DRIFT_DEGREE + OF_PULSES:
        return None
    unit = sigma / math.sqrt(2 * v.size)  # standard deviation of the real part of a bin
    transform: Complex[np.ndarray, " all"] = np.fft.rfft(v) / v.size / unit
    others = np.concatenate([drifts, _pulses(v, transform, bins, periods)], axis=1)
    others = np.concatenate([np.real(others), np.imag(others)])
    others /= np.sqrt(np.sum(others**2, axis=0, keepdims=True))
    measured = np.concatenate([np.real(transform[bins]), np.imag(transform[bins])])
    drifting, before = _rest(others[:, :DRIFT_DEGREE], measured), _rest(others, measured)
    significant = 80.0
    if before - measured.size < max(significant, 0.05 * (drifting - before)):
        return None
    # Width of a weak prior: bins between the harmonics do not determine hum on a harmonic.
    weak = np.ptp(v) / unit
    measured = np.concatenate([measured, np.zeros(2 * MULTIPLES)])
    prior = np.eye(2 * MULTIPLES, 2 * MULTIPLES + others.shape[1])
    import scipy.optimize  # takes a third of a second, which only recordings with hum need

    def fitted(frequency: float) -> tuple[float, Complex[np.ndarray, " multiple"]]:
        places = frequency * seconds * np.arange(1, MULTIPLES + 1)[None, :]
        forward, back = (_wave(at - bins[:, None], v.size) for at in (places, -places))
        waves = np.concatenate([forward + back, 1j * (forward - back)], axis=1) * (weak / 2)
        design = np.concatenate([np.real(waves), np.imag(waves)])
        design = np.concatenate([np.concatenate([design, others], axis=1), prior])
        q = np.linalg.lstsq(design, measured)[0]
        z = q[:MULTIPLES] + 1j * q[MULTIPLES : 2 * MULTIPLES]
        return float(np.sum((measured - design @ q) ** 2)), z * (weak * unit)

    def best(mains: float) -> tuple[float, float]:
        reach = 2e-3 * mains
        # The grid moves the highest multiple by a quarter of a bin.
        count = 2 * math.ceil(4 * MULTIPLES * seconds * reach) + 3
        grid = mains + np.linspace(-reach, reach, count)
        at = int(np.clip(np.argmin([fitted(f)[0] for f in grid]), 1, count - 2))
        minimum = scipy.optimize.minimize_scalar(
            lambda f: fitted(f)[0],
            bounds=(grid[at - 1], grid[at + 1]),
            method="bounded",
            options={"xatol": 1e-9 * mains},
        )
        return float(minimum.fun), float(minimum.x)

    after, frequency = min(map(best, MAINS))
    noise = measured.size + 4 * math.sqrt(2 * measured.size)
    if before - after < significant or after - noise > 0.1 * (before - measured.size):
        return None
    return Hum(frequency, fitted(frequency)[1])


def _rest(columns: Float[np.ndarray, "row column"], measured: Float[np.ndarray, " row"]) -> float:
    """Sum of squares of `measured` after a least-squares fit of the columns."""
    return float(np.sum((measured - columns @ np.linalg.lstsq(columns, measured)[0]) ** 2))


def _pulses(
    v: Float[np.ndarray, " time"],
    transform: Complex[np.ndarray, " all"],
    bins: Int[np.ndarray, " bin"],
    periods: int,
) -> Complex[np.ndarray, "bin 2"]:
    """Leakage of pulses into the bins between their harmonics, as columns to be fitted.

    Pulses leak if the record is not exactly P periods long. If it is ρ samples too short, the sum
    over the pulses, Σ_p e^(−j 2π m p (1 + ρ/N)/P), is not 0 but −j 2π m ρ / (N (w − 1)) with
    w = e^(−j 2π m/P). The first column multiplies it by the transform of one pulse, interpolated
    between the harmonics. The second column, times m, describes the error of the interpolation.
    """
    late = int(np.argmax(np.abs(v[: v.size // periods])))
    of_pulses = np.arange(0, bins.max() + periods + 1, periods)
    turned = transform[of_pulses] * np.exp(2j * np.pi * of_pulses * late / v.size)
    turned[0] = 0.0  # a transformer passes no direct voltage
    pulse = np.interp(bins, of_pulses, turned.real) + 1j * np.interp(bins, of_pulses, turned.imag)
    pulse = pulse * np.exp(-2j * np.pi * bins * late / v.size)
    leaked = -1j * bins * pulse / (np.exp(-2j * np.pi * bins / periods) - 1)
    return np.stack([leaked, leaked * bins], axis=1)


def _wave(
    turns: Float[np.ndarray, "bin multiple"], samples: int
) -> Complex[np.ndarray, "bin multiple"]:
    """Mean of e^(j 2π t n/N) over n = 0 … N−1."""
    angle = 2 * np.pi * turns
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.expm1(1j * angle) / np.expm1(1j * angle / samples) / samples
    return np.where(angle == 0, 1.0, mean)
