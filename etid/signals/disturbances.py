"""Disturbed pulse periods, with a spike or a burst, and shifted ones, after a lost sample.

A movement of the hand can spoil one of several periods, and with it the average of all periods.
Each period is compared with the median of all periods, after averaging over `MERGED` samples. A
period is *disturbed* if it differs by more than `allowed_deviation`. A load that changes by less
than a factor of two does not exceed it. Edges between samples and noise do not exceed it either. If
a disturbance lasts to the end of its period or from its start, the period beside it is disturbed
too.

A converter that loses a sample, or writes one twice, moves all later samples of its record by one.
The edges of each period are compared with those of the first period. Where the lag of V_out changes
by whole samples from one period to the next, the periods are *shifted*; they are aligned. A period
whose first and last edge are shifted differently is disturbed: the sample was lost in its pulse.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from etid.signals.pulse_train import highest, rise_time, rises
from etid.signals.quick_looks import allowed_deviation, highest_beside, noise_limit, period_means

STEEP = 0.3  # an edge rises by more than this part of the steepest rise of a pulse
EDGE = 10  # times the samples over which edges rise, in which there is one edge


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
    means, noise = period_means(records, spacing, periods), noise_limit(sigma)
    usual = np.median(means, axis=2)
    # The first and the last mean lie between pulses.
    high, low = highest_beside(usual), -highest_beside(-usual)
    allowed = allowed_deviation(low, high, np.abs(usual).max(2), sigma, step)
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
    """
    slope = np.abs(v[rise:] - v[:-rise])
    ends = np.rint(np.arange(bad.size + 1) * spacing).astype(int)
    parts = [slope[first:end] for first, end in itertools.pairwise(ends)]
    largest = np.array([part.max() for part in parts])
    steep = STEEP * np.median(largest[~bad])
    # Steep samples next to each other are one edge.
    count = np.array(
        [
            np.count_nonzero(np.diff(np.flatnonzero(part > steep), prepend=-np.inf) > EDGE * rise)
            for part in parts
        ]
    )
    ratio = count[bad] / max(1.0, float(np.median(count[~bad])))
    return bool(((ratio < 0.5) | ((ratio > 1.5) & (ratio < 2.5))).any())


class Shifts(NamedTuple):
    """By how much the periods of a recording are shifted.

    Attributes:
        late: Lag of `v_out` in each period relative to the lag in most periods [whole samples].
        bad: Periods in which it changes during the pulse.
    """

    late: Int[np.ndarray, " period"]
    bad: Bool[np.ndarray, " period"]


def shifts(
    records: Float[np.ndarray, "2 time"],
    sigma: Float[np.ndarray, "2"],
    spacing: float,
    periods: int,
    rise: int,
) -> Shifts | None:
    """The shifts of `v_out` against `v_th` from period to period; None if there are none.

    What shifts both records alike, as the pulses do when their clock jitters, does no harm.
    """
    lags = [
        _lags_of_edges(v, float(noise), spacing, periods, rise)
        for v, noise in zip(records, sigma, strict=True)
    ]
    if lags[0] is None or lags[1] is None:
        return None
    lag = lags[1] - lags[0]
    # The first period, too, may be the one in which a sample is lost.
    usual = np.angle(np.exp(2j * np.pi * lag).mean(0)) / (2 * np.pi)
    whole = np.rint(lag - usual).astype(int)
    within = whole[:, 1] - whole[:, 0]
    between = (np.abs(lag - usual - whole) > 0.3).any(1)
    if np.count_nonzero(between) > 1:  # no lost sample, but pulses at any time
        return None
    bad = (within != _most(within)) | between
    late = whole[:, 0] - _most(whole[~bad, 0]) if not bad.all() else whole[:, 0]
    if (within == within[0]).all() and (late[~bad] == 0).all():
        return None
    return Shifts(late, bad)


def _most(numbers: Int[np.ndarray, " number"]) -> int:
    """The most frequent number."""
    values, counts = np.unique(numbers, return_counts=True)
    return int(values[np.argmax(counts)])


def _lags_of_edges(
    v: Float[np.ndarray, " time"], sigma: float, spacing: float, periods: int, rise: int
) -> Float[np.ndarray, "period 2"] | None:
    """Lags of the first and last edge of each period behind those of the first period [samples].

    None if an edge does not look alike in all periods, or if noise hides its place.
    """
    at = np.rint(np.arange(periods) * spacing).astype(int)
    slope, width = rises(v, rise), EDGE * rise
    farthest = 8  # [samples] largest lag that is searched
    room = min(int(spacing), slope.size - at[-1]) - width - farthest
    mean = np.abs(sum(slope[first : first + max(room, 0)] for first in at))
    steep = np.flatnonzero(mean > STEEP * mean.max(initial=0.0))
    if not steep.size:
        return None
    lags = np.zeros((periods, 2))
    for number, edge in enumerate(steep[[0, -1]]):
        first = max(edge - width, 0)
        template = slope[first : edge + width]
        begin = at[1:, None] + first + np.arange(-farthest, farthest + 1)
        parts = np.lib.stride_tricks.sliding_window_view(slope, template.size)[begin]
        rest = np.square(parts - template).sum(-1)
        # Noise has 2 σ² in the differences of a template and 6 σ² in theirs.
        bend = np.square(np.diff(template)).sum() - 6 * sigma**2 * template.size
        unsure = 4 * sigma**2 > 0.1**2 * bend  # standard error of a lag: 0.1 samples
        if unsure or (rest.min(1) > (template @ template) / 2).any():
            return None
        lags[1:, number] = highest(-rest) - farthest
    return lags


class Joint(NamedTuple):
    """A plan to join the periods that are kept to one record.

    The joined record is as long as a record of these periods alone. Each period begins at a whole
    sample, so the spacing of pulses may change by one sample at a joint. If two voltages are joined
    in the same way, their ratio at each frequency stays the same, because both are at rest at the
    joints.

    Attributes:
        first: First sample of each period of `v_th` in the whole record.
        late: By how much the period of `v_out` begins later [samples].
        lengths: Number of samples of each period.
        begins: Start of each period in the joined record [samples].
    """

    first: Int[np.ndarray, " kept"]
    late: Int[np.ndarray, " kept"]
    lengths: Int[np.ndarray, " kept"]
    begins: Float[np.ndarray, " kept"]

    def __call__(self, records: Float[np.ndarray, "2 time"]) -> Float[np.ndarray, "2 kept"]:
        """The joined records of both voltages.

        A shifted period may begin before the record or end after it. The sample at that end stands
        for those that are missing; the voltage is at rest there.
        """
        inside = np.concatenate([np.arange(length) for length in self.lengths])
        v_th = np.repeat(self.first, self.lengths) + inside
        both = np.stack([v_th, v_th + np.repeat(self.late, self.lengths)])
        return np.take_along_axis(records, np.clip(both, 0, records.shape[1] - 1), axis=1)


def joint(
    kept: Bool[np.ndarray, " period"],
    late: Int[np.ndarray, " period"],
    spacing: float,
    size: int,
) -> Joint:
    """The plan to join the periods that are kept."""
    number, late = np.flatnonzero(kept), late[kept]
    ends = np.rint(np.arange(number.size + 1) * spacing).astype(int)
    before = (number - np.arange(number.size)) * spacing  # samples that are left out
    skipped = np.minimum(np.rint(before), size - ends[-1]).astype(int)
    return Joint(ends[:-1] + skipped, late, np.diff(ends), number * spacing - skipped)


def kept(
    records: Float[np.ndarray, "2 time"],
    sigma: Float[np.ndarray, "2"],
    bad: Bool[np.ndarray, " period"],
    spacing: float,
    sample_rate: float,
) -> tuple[Joint | None, Shifts | None]:
    """The plan to leave disturbed periods out and to align shifted ones, and their shifts.

    Fewer than half of the periods may be left out: the others must show the shape of an undisturbed
    period.
    """
    rise = rise_time(sample_rate)
    if not enough(bad) or (bad.any() and any(of_source(v, bad, spacing, rise) for v in records)):
        bad = np.zeros_like(bad)
    found = shifts(records, sigma, spacing, bad.size, rise)
    late = np.zeros(bad.size, int) if found is None else found.late
    bad = bad if found is None else bad | found.bad
    if not (bad.any() or late.any()) or not enough(bad):
        return None, found
    return joint(~bad, late, spacing, records.shape[1]), found
