"""Which pulse periods of a record are unlike the others: a spike, a burst, a missing pulse.

A hand that moves spoils one of several periods, and with it the average over all. Each period is
compared with the median of all, in means over `MERGED` samples. A period is *disturbed* where it
differs by more than `PART` of the largest value and by more than `SHARE` of what is there. A load
that changes by less than a factor of two does not do that, nor do edges that fall between samples,
nor noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

MERGED = 16  # samples of a mean
FEWEST = 3  # periods, to tell one from the others
PART = 0.02  # of the largest value: 0.05 V at the converter in records of 2.5 V
SHARE = 0.5  # of what is there
NOISE = 8.0  # standard deviations of a mean


def disturbed(
    records: Sequence[Float[np.ndarray, " time"]],
    sigma: Sequence[float],
    step: Sequence[float],
    spacing: float,
    periods: int,
) -> Bool[np.ndarray, " period"]:
    """Whether each period is unlike the others in one of several records of equal lengths.

    None is if there are fewer than three.

    Args:
        records: Voltages [V].
        sigma: Noise of a sample of each [V].
        step: Step of the converter of each [V] if it is coarse, else 0.
        spacing: Length of a period [samples].
        periods: How many whole ones each record holds.
    """
    length = int(spacing) // MERGED * MERGED
    if periods < FEWEST or length < 3 * MERGED:
        return np.zeros(periods, bool)
    at = np.minimum(np.rint(np.arange(periods) * spacing), records[0].size - length).astype(int)
    parts = np.arange(0, length, MERGED)
    cut = [[np.add.reduceat(v[one : one + length], parts) for one in at] for v in records]
    means = np.array(cut) / MERGED
    half = parts.size // 2
    means -= np.partition(means, half, axis=2)[:, :, half, None]  # of each: the mean may drift
    low, high = means.min(1), means.max(1)
    noise = NOISE / MERGED**0.5 * np.asarray(sigma)
    floor = np.maximum(PART * high.max(1), noise) + step
    if not (high - low > SHARE * np.maximum(low, -high) + floor[:, None]).any():
        return np.zeros(periods, bool)  # as of most records, for half of the time
    usual = np.median(means, axis=1)
    floor = np.maximum(PART * np.abs(usual).max(1), noise) + step
    # The first and the last mean lie between pulses.
    left, middle, right = usual[:, :-2], usual[:, 1:-1], usual[:, 2:]
    high = np.maximum(np.maximum(left, middle), right)
    low = np.minimum(np.minimum(left, middle), right)
    allowed = SHARE * np.maximum(high, -low) + (high - low) + floor[:, None]
    off = np.abs(means - usual[:, None])[:, :, 1:-1]
    return np.any(off > allowed[:, None], axis=2).any(axis=0)


class Joint(NamedTuple):
    """How a record of the periods that are kept is put together.

    It is as long as if it had been recorded without the others. Each period begins at a sample, by
    which pulses may be a sample nearer or farther. Of two voltages that are cut alike, the ratio at
    each frequency stays the same, as both are at rest at the joints.

    Attributes:
        first: First samples of the periods in the whole record.
        lengths: Their samples.
        begins: Where they begin in the record that is put together [samples].
    """

    first: Int[np.ndarray, " kept"]
    lengths: Int[np.ndarray, " kept"]
    begins: Float[np.ndarray, " kept"]

    def __call__(self, v: Float[np.ndarray, " time"]) -> Float[np.ndarray, " kept"]:
        """A voltage of these periods only."""
        parts = zip(self.first, self.lengths, strict=True)
        return np.concatenate([v[first : first + length] for first, length in parts])


def joint(kept: Bool[np.ndarray, " period"], spacing: float, size: int) -> Joint:
    """The periods to keep.

    Args:
        kept: Whether each is kept.
        spacing: Length of a period [samples].
        size: Samples of the record.
    """
    number = np.flatnonzero(kept)
    ends = np.rint(np.arange(number.size + 1) * spacing).astype(int)
    before = (number - np.arange(number.size)) * spacing  # samples that are left out
    skipped = np.minimum(np.rint(before), size - ends[-1]).astype(int)
    return Joint(ends[:-1] + skipped, np.diff(ends), number * spacing - skipped)
