"""Transforms of the periods of records, each period alone.

The length of a period is usually not a whole number of samples. A cut is at the nearest sample; a
rotation of the phase corrects the remaining fraction. Periods of records with equal rates are
transformed once, for averages without aliases (`etid.signals.averaging`) and for the differences
between the periods (`etid.recordings.repeats`).
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from etid.signals.pulse_train import RATE

TOGETHER = 8  # records that are transformed together; more leave the cache


class Periods(NamedTuple):
    """The periods of several records with equal rates.

    Attributes:
        each: Transform of each period as it was cut, of all its samples.
        starts: Samples at which the periods are cut.
        size: Number of samples of a transform, zeros included.
    """

    each: Complex[np.ndarray, "record period place"]
    starts: Int[np.ndarray, "record period"]
    size: int

    @classmethod
    def of(
        cls,
        v: Float[np.ndarray, "record time"],
        at: Float[np.ndarray, "record period"],
        period: float,
    ) -> "Periods":
        """The periods that begin nearest to `at` [samples], of a nominal length [samples].

        A line from the first sample of a period to its last is removed, that of the mean over the
        periods. A phase cannot rotate the ends of a period that are not 0: in a pulse or on its
        tail, cuts beside their place would look like a change.
        """
        length = length_of(period)
        starts, size = np.minimum(np.rint(at), v.shape[1] - length).astype(int), fast_length(length)
        each = np.empty((*starts.shape, size // 2 + 1), complex)
        line = np.linspace(0, 1, length)
        for first in range(0, len(v), TOGETHER):
            rows = slice(first, first + TOGETHER)
            cut = _cut(v[rows], starts[rows], length)
            begin, end = cut[..., [0, -1]].mean(1).T[..., None]
            cut -= (begin + (end - begin) * line)[:, None]
            np.fft.rfft(cut, size, out=each[rows])
        return cls(each, starts, size)

    def take(self, rows: Int[np.ndarray, " row"] | Bool[np.ndarray, " record"]) -> "Periods":
        """Those of some of the records; no copy of all."""
        if rows.size == len(self.starts) and (rows.dtype != bool or rows.all()):
            return self
        return Periods(self.each[rows], self.starts[rows], self.size)

    def late(self, spacing: Float[np.ndarray, " record"]) -> Float[np.ndarray, "record period"]:
        """By how much each cut is late if periods are `spacing` long [samples]."""
        return self.starts - spacing[:, None] * np.arange(self.starts.shape[1])

    def turned(
        self, spacing: Float[np.ndarray, " record"], low: float, high: float
    ) -> tuple[Complex[np.ndarray, "record period place"], Float[np.ndarray, " place"]]:
        """Each period in a part of the band, as if it began at its place, and the frequencies.

        Args:
            spacing: Length of a period [samples].
            low: First frequency, relative to the sample rate.
            high: End of the frequencies.
        """
        place = np.arange(self.each.shape[2]) / self.size
        first, end = np.searchsorted(place, [low, high]).tolist()
        late = self.late(spacing)
        late = late[:1] if (late == late[0]).all() else late  # most recordings are cut alike
        turn = turns(late * (2 * np.pi / self.size), first, end)
        return self.each[..., first:end] * turn, place[first:end]


def _cut(
    v: Float[np.ndarray, "record time"], starts: Int[np.ndarray, "record period"], length: int
) -> Float[np.ndarray, "record period part"]:
    """The parts of records that begin at these samples."""
    cut, alike = np.empty((*starts.shape, length)), (starts == starts[0]).all()
    for row in [slice(None)] if alike else range(len(v)):
        for number, start in enumerate(starts[0 if alike else row].tolist()):
            cut[row, number] = v[row, start : start + length]
    return cut


def turns(
    angle: Float[np.ndarray, "*cut"], first: int, end: int
) -> Complex[np.ndarray, "*cut place"]:
    """e^(−j k angle) for k from `first` to before `end`, as products of a few exponentials."""
    count = end - first
    step = 1 << ((count - 1).bit_length() + 1) // 2
    fine = np.exp(-1j * angle[..., None] * np.arange(first, first + step))
    coarse = np.exp(-1j * angle[..., None] * np.arange(0, count, step))
    product = coarse[..., :, None] * fine[..., None, :]
    return product.reshape(*angle.shape, -1)[..., :count]


@functools.cache
def length_of(period: float) -> int:
    """Samples of a period that are used: its measured length may differ from the nominal one."""
    return int((1 - RATE) * period)


@functools.cache
def fast_length(least: int) -> int:
    """The smallest length 2^i 3^j 5^k that is not below `least`: its Fourier transform is fast."""
    odd = (3**j * 5**k for j in range(30) for k in range(20))
    return min(of << (-(-least // of) - 1).bit_length() for of in odd)
