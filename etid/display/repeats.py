"""Whether the noise of a window has come before. Such a window is an old one, and no measurement.

A converter whose ring buffer is not filled any more returns its last windows again and again, bit
for bit. All of them fit. If the ring is no whole number of periods, its windows come back some
samples later or earlier. A window that comes back by more than `SHIFT` samples, or the one before,
has left the delays that a good pulse may have (`etid.display.pulse_fit.DELAYS`).

**A fingerprint** of the quiet end of a window is F_s = Σ w_k h(v_{k+s}, v_{k+s+1}). h makes 24 bits
of those of two neighbours, and the weights w_k have 20: the sum is exact in any order. If F_s of a
window, for a shift s of at most `SHIFT` samples, is F_0 of an earlier one of the same electrode,
both have the same samples.

**Noise is the proof.** Windows may well be equal where noise does not reach a step of the
converter. A sample above both of its neighbours, or below both, shows noise. If each sample takes
one of two codes, one of them with probability p, Σ p (1 − p) samples do so on the average, and two
windows are equal with a probability below e^(−2 Σ p (1 − p)). A window is called old only if
`NOISY` samples show noise. This needs noise of about a sixth of a step.

**Memory** is bounded: 65 536 windows, 0.8 MB for each electrode. A window is forgotten when `WAYS`
newer ones have come into its bucket: of the last 8192 windows one of 100 000, of the last 16 384
one of 1000.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32, UInt64

from etid.display.projection import TOGETHER
from etid.display.pulse_fit import DELAYS

SAMPLES = 512  # at the end of a window, whose noise is compared
SHIFT = math.ceil(DELAYS[-1] - DELAYS[0])  # [samples]
NOISY = 24  # samples that must show noise
BUCKETS, WAYS = 8192, 8  # of the fingerprints of one electrode
ODD = np.uint32(0x9E3779B1), np.uint32(0x85EBCA6B), np.uint32(0xC2B2AE35)  # mix bits
MIXED = np.uint64(0x9E3779B97F4A7C15)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Windows:
    """The windows of a stream that have come so far.

    All states of a stream share them. A state does not change nevertheless: for the pulse after it,
    only windows of pulses up to it count.

    Attributes:
        part: Samples that are compared.
        prints: Fingerprints. The buckets of the electrodes follow each other.
        numbers: Numbers of their pulses; 0 for none.
    """

    part: slice
    prints: UInt64[np.ndarray, "bucket way"]
    numbers: UInt32[np.ndarray, "bucket way"]

    @classmethod
    def of(cls, runs: Sequence[tuple[int, int]], block: int, electrodes: int) -> "Windows":
        """No windows yet.

        Args:
            runs: Where a window is quiet: (first sample, number of blocks).
            block: Length of a block [samples].
            electrodes: Number of electrodes.
        """
        first, blocks = max(runs, key=lambda run: run[1])
        last = first + blocks * block
        size = min(last - first, SAMPLES + 2 * SHIFT + 1)
        shape = (electrodes * BUCKETS, WAYS)
        return cls(slice(last - size, last), np.zeros(shape, np.uint64), np.zeros(shape, "u4"))

    def repeated(
        self, v_out: Float[np.ndarray, "lane sample"], number: int
    ) -> Bool[np.ndarray, " lane"]:
        """Whether the noise of each window is that of an earlier one; it is kept in mind.

        Args:
            v_out: One window per electrode [V].
            number: Number of the pulse, from 1 on.
        """
        part = v_out[:, self.part]
        prints = _fingerprints(part)
        lane = BUCKETS * np.arange(len(v_out))
        buckets = (prints % np.uint64(BUCKETS)).astype(int) + lane[:, None]
        alike = self.prints.take(buckets, axis=0) == prints[..., None]
        old = alike.any(axis=(1, 2))
        if old.any():  # at few electrodes
            numbers = self.numbers[buckets[old]]
            earlier = alike[old] & (numbers > 0) & (numbers < number)
            old[old] = earlier.any(axis=(1, 2)) & (_noisy(part[old]) >= NOISY)
        own = buckets[:, SHIFT]  # without a shift
        way = self.numbers.take(own, axis=0).argmin(axis=1)
        self.prints[own, way], self.numbers[own, way] = prints[:, SHIFT], number
        return old


@functools.cache
def _weights(pairs: int) -> Float[np.ndarray, "pair shift"]:
    """w_k beside each shift."""
    size, shifts = pairs - 2 * SHIFT, range(2 * SHIFT + 1)
    w, found = np.random.default_rng(0).integers(1, 1 << 20, size), np.zeros((pairs, len(shifts)))
    for shift in shifts:
        found[shift : shift + size, shift] = w
    return found


def _fingerprints(part: Float[np.ndarray, "lane sample"]) -> UInt64[np.ndarray, "lane shift"]:
    """F_s of each window, mixed."""
    with np.errstate(over="ignore", invalid="ignore"):  # samples that are no numbers
        bits = part.astype(np.float32).view(np.uint32) * ODD[0]
    bits ^= bits >> np.uint32(15)
    # If each sample took one of two codes, sums over samples would have 2²⁴ values, not 2⁴⁷.
    hashed = (bits[:, :-1] * ODD[1] + bits[:, 1:] * ODD[2]) >> np.uint32(8)
    weights = _weights(hashed.shape[1])
    sums = [
        hashed[first : first + TOGETHER].astype(float) @ weights  # no threads, as `_product`
        for first in range(0, len(part), TOGETHER)
    ]
    found = np.concatenate(sums).astype(np.uint64) * MIXED
    return found ^ (found >> np.uint64(32))


def _noisy(part: Float[np.ndarray, "lane sample"]) -> Int[np.ndarray, " lane"]:
    """Number of samples that lie above both of their neighbours, or below both."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(part, axis=1)
        return np.sum(steps[:, 1:] * steps[:, :-1] < 0, axis=1)
