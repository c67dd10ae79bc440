"""From answers to rates, with intervals that know which trials share a driver.

Trials behind one driver share its error: ten of them are not ten draws. The interval is that of
Clopper and Pearson for an effective number n* of trials (Korn and Graubard, Survey Methodology 24,
1998, 193-201), n* = p (1 − p) / V, V = m / (m − 1) Σ_d (events_d − p trials_d)² / trials², p the
rate, and V its variance between m drivers d; but not more than there are trials. Where all drivers
have the same rate, V says nothing, and n* = m: as if the trials behind a driver were one.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

LEVEL = 0.95
FEWEST = 6  # values whose median has an interval: 1 − 2 · 2⁻⁶ is 97 %, 1 − 2 · 2⁻⁵ is 94 %
OF_RUNS = 0.99
NORMAL_95 = 1.959964  # half-width of a 95 % interval in standard errors
COVERED = (0.93, 0.97)  # part of the 95 % intervals that is to contain the truth


class Rate(NamedTuple):
    """A rate with its interval, and the number of trials."""

    rate: float
    low: float
    high: float
    trials: int = 0

    def __str__(self) -> str:
        low, high = 100 * self.low, 100 * self.high
        return f"{100 * self.rate:.2f} % ({low:.2f} to {high:.2f}) of {self.trials}"


def clopper_pearson(events: float, trials: float) -> tuple[float, float]:
    """Interval of a binomial rate; the numbers need not be whole ones."""
    tail = (1 - LEVEL) / 2
    low = scipy.stats.beta.ppf(tail, events, trials - events + 1) if events > 0 else 0.0
    high = scipy.stats.beta.isf(tail, events + 1, trials - events) if events < trials else 1.0
    return float(low), float(high)


def median_interval(values: np.ndarray) -> tuple[float, float]:
    """The order statistics between which the median of the population lies, by the signs alone.

    NaN of fewer than `FEWEST` values: from the least to the largest is less than 95 % then.
    """
    if values.size < FEWEST:
        return np.nan, np.nan
    below, above = scipy.stats.binom.interval(LEVEL, values.size, 0.5)  # values below the median
    low, high = np.sort(values)[[int(below) - 1, int(above)]]
    return float(low), float(high)


def rate(events: Sequence[bool] | np.ndarray, drivers: Iterable[int]) -> Rate:
    """Rate of events in trials, given the driver of each; NaN without trials."""
    happened = np.asarray(events, float)
    if not happened.size:
        return Rate(np.nan, np.nan, np.nan)
    _, of = np.unique(np.asarray(list(drivers)), return_inverse=True)
    p, trials, clusters = float(happened.mean()), happened.size, int(of.max()) + 1
    rest = np.bincount(of, happened - p)
    variance = np.sum(rest**2) / trials**2 * clusters / max(clusters - 1, 1)
    effective = min(trials, p * (1 - p) / variance) if variance > 0 else clusters
    return Rate(p, *clopper_pearson(p * effective, effective), trials)


def covered(z: np.ndarray, drivers: Sequence[int] | np.ndarray) -> Rate:
    """Part of the 95 % intervals that contain the truth."""
    inside = np.abs(z) < NORMAL_95
    return rate(inside.ravel(), np.repeat(drivers, inside[0].size if inside.size else 1))


def expected_rms(fits: int) -> tuple[float, float]:
    """Range of the root mean square of z in `OF_RUNS` of the runs, if z is normal."""
    low, high = scipy.stats.chi2.interval(OF_RUNS, fits)
    return float(np.sqrt(low / fits)), float(np.sqrt(high / fits))


def expected_covered(fits: int) -> tuple[float, float]:
    """Range of the part of 95 % intervals that hold the truth in `OF_RUNS` of the runs."""
    low, high = scipy.stats.binom.interval(OF_RUNS, fits, 0.95)
    return float(low / fits), float(high / fits)
