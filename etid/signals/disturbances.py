"""Disturbed pulse periods of a record: periods with a spike or a burst.

A movement of the hand can spoil one of several periods, and with it the average of all periods.
Each period is compared with the median of all periods, after averaging over `MERGED` samples. A
period is *disturbed* if it differs by more than `PART` of the largest value and by more than
`SHARE` of the value at the same place. A load that changes by less than a factor of two does not
exceed these limits. Edges between samples and noise do not exceed them either. If a disturbance
lasts to the end of its period or from its start, the period beside it is disturbed too.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.signals.quick_looks import MERGED, NOISE, PART, SHARE, highest_beside, period_means

STEEP = 0.3  # of the steepest rise of a pulse
BESIDE = 10  # times the samples over which edges rise, in which there is one edge


def disturbed(
    records: Float[np.ndarray, "recording 2 time"],
    sigma: Float[np.ndarray, "recording 2"],
    step: Float[np.ndarray, "recording 2"],
    spacing: float,
    periods: int,
) -> Bool[np.ndarray, "recording period"]:
    """Whether each period is disturbed in one of the two records of a recording, but not in both.

    What both records show, a second pulse for instance, comes from the source. The ratio of the
    records stays right. A period beside one that differs up to their joint counts as well if enough
    periods remain.

    Args:
        records: Both voltages of each recording [V], which `uneven` suspects.
        sigma: Standard deviation of the noise of a sample of each record [V].
        step: Step of the converter of each record if it is coarse, else 0 [V].
        spacing: Length of a period [samples].
        periods: Number of whole periods in each record.
    """
    means, noise = period_means(records, spacing, periods), NOISE / MERGED**0.5 * sigma
    usual = np.median(means, axis=2)
    floor = np.maximum(PART * np.abs(usual).max(2), noise) + step
    # The first and the last mean lie between pulses.
    high, low = highest_beside(usual), -highest_beside(-usual)
    allowed = SHARE * np.maximum(high, -low) + (high - low) + floor[..., None]
    off = np.abs(means - usual[:, :, None])[..., 1:-1]
    unlike = np.any(off > allowed[:, :, None], axis=3)
    bad = unlike.any(axis=1) & ~unlike.all(axis=1)
    at_joints = np.abs(means - usual[:, :, None])[..., [0, -1]] > (noise + step)[..., None, None]
    first, last = np.moveaxis(at_joints.any(axis=1) & bad[..., None], -1, 0)
    longer = bad.copy()
    longer[:, :-1] |= first[:, 1:]
    longer[:, 1:] |= last[:, :-1]
    return np.where(enough(longer)[:, None], longer, bad)


def enough(bad: Bool[np.ndarray, "*recording period"]) -> Bool[np.ndarray, "*recording"]:
    """Whether more than half of the periods, and at least two, are not disturbed."""
    return np.asarray(np.sum(~bad, axis=-1) >= max(2, bad.shape[-1] // 2 + 1))


def of_source(
    v: Float[np.ndarray, " time"], bad: Bool[np.ndarray, " period"], spacing: float, rise: int
) -> bool:
    """Whether a disturbed period lacks a pulse or has a second one, by the number of its edges.

    The period that follows is disturbed too, by what a transformer keeps of its history.

    Args:
        v: A record [V].
        bad: The disturbed periods.
        spacing: Length of a period [samples].
        rise: Samples over which edges rise.
    """
    slope = np.abs(v[rise:] - v[:-rise])
    ends = np.rint(np.arange(bad.size + 1) * spacing).astype(int)
    parts = [slope[first:end] for first, end in itertools.pairwise(ends)]
    largest = np.array([part.max() for part in parts])
    steep = STEEP * np.median(largest[~bad])
    # Steep samples next to each other are one edge.
    count = np.array(
        [
            np.count_nonzero(np.diff(np.flatnonzero(part > steep), prepend=-np.inf) > BESIDE * rise)
            for part in parts
        ]
    )
    ratio = count[bad] / max(1.0, float(np.median(count[~bad])))
    return bool(((ratio < 0.5) | ((ratio > 1.5) & (ratio < 2.5))).any())


class Joint(NamedTuple):
    """A plan to join the periods that are kept to one record.

    The joined record is as long as a record of these periods alone. Each period begins at a whole
    sample, so the spacing of pulses may change by one sample at a joint. If two voltages are joined
    in the same way, their ratio at each frequency stays the same, because both are at rest at the
    joints.

    Attributes:
        first: First sample of each period in the whole record.
        lengths: Number of samples of each period.
        begins: Start of each period in the joined record [samples].
    """

    first: Int[np.ndarray, " kept"]
    lengths: Int[np.ndarray, " kept"]
    begins: Float[np.ndarray, " kept"]

    def __call__(self, v: Float[np.ndarray, " time"]) -> Float[np.ndarray, " kept"]:
        """The joined record of a voltage."""
        parts = zip(self.first, self.lengths, strict=True)
        return np.concatenate([v[first : first + length] for first, length in parts])


def joint(kept: Bool[np.ndarray, " period"], spacing: float, size: int) -> Joint:
    """The plan to join the periods that are kept.

    Args:
        kept: Whether each period is kept.
        spacing: Length of a period [samples].
        size: Number of samples of the record.
    """
    number = np.flatnonzero(kept)
    ends = np.rint(np.arange(number.size + 1) * spacing).astype(int)
    before = (number - np.arange(number.size)) * spacing  # samples that are left out
    skipped = np.minimum(np.rint(before), size - ends[-1]).astype(int)
    return Joint(ends[:-1] + skipped, np.diff(ends), number * spacing - skipped)
