"""Sums over the samples of one pulse: its bands of frequency, its means and its noise.

**No transform.** Σ X̄_k Y_k is a scalar product of the samples and a row of weights (Parseval).
`Projection` has these rows, so that a pulse takes one matrix product. Between the edges of two
pulses the voltage is smooth, and blocks of samples are replaced by their means there. The row of a
band is multiplied by the smooth curve through these means; this is exact to 10⁻³ standard errors of
a pulse. Neighbouring bands share a little noise because of it. Their weights are divided by the sum
of the correlations.

**Noise** is what the blocks contain besides a parabola, at six frequencies of the bands. This needs
no model of the load.
"""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.signals.harmonics import ALIASED

TOGETHER = 50  # electrodes whose samples fit in the cache of a core and are read only once


class BandSums(NamedTuple):
    """What one pulse shows at all electrodes, before its amplitude is considered.

    Few arrays reach the compiled program faster than many.

    Attributes:
        values: Real and imaginary part of Ĝ in each band for the samples as they are, and the means
            of `Means`. Ĝ includes the phase of the delay.
        variance: E|noise|² of a Fourier coefficient of V_out [V²].
        clipped: Whether a sample reached the end of the converter's range.
        repeated: Whether the window is an old one (`etid.display.repeats`), which it does not show
            by itself.
    """

    values: Float[Array | np.ndarray, "lane sum"]
    variance: Float[Array | np.ndarray, " lane"]
    clipped: Bool[Array | np.ndarray, " lane"]
    repeated: Bool[Array | np.ndarray, " lane"]

    def gain(self) -> Complex[Array, "lane band"]:
        """Ĝ."""
        parts = jnp.asarray(self.values[:, : -len(Means._fields)], float)
        return jax.lax.complex(*jnp.split(parts, 2, axis=1))

    def means(self) -> "Means":
        """The means."""
        return Means(*jnp.asarray(self.values[:, -len(Means._fields) :], float).T)


class Means(NamedTuple):
    """Means of one window at each electrode [V].

    Attributes:
        whole: Mean of the window.
        middle: Mean of the samples after its middle, as many as for `late`.
        late: Mean of the last samples of the window.
    """

    whole: Float[Array, " lane"]
    middle: Float[Array, " lane"]
    late: Float[Array, " lane"]


@dataclasses.dataclass(frozen=True, eq=False)
class Projection:
    """The matrix product that makes bands of samples; NumPy, without a copy to the device.

    Attributes:
        samples: Length of a window [samples].
        pieces: Intervals that are kept as samples: (first sample, sample after the last).
        runs: Intervals that are replaced by blocks: (first sample, number of blocks).
        block: Length of a block [samples].
        within: Columns that make of a block its mean, and its noise at each frequency.
        rows: Columns that make of samples and means: the real and imaginary parts of Ĝ, and the
            means of `Means`. Single precision takes half the time, here and in `within`. Its error
            is 2e-8 of the peak, a five-hundredth of the smallest noise that etid accepts for a
            record.
        floor: Smallest variance that is accepted for a coefficient of V_out [V²].
    """

    samples: int
    pieces: tuple[tuple[int, int], ...]
    runs: tuple[tuple[int, int], ...]
    block: int
    within: Float[np.ndarray, "sample column"]
    rows: Float[np.ndarray, "kept row"]
    floor: float

    @classmethod
    def of(
        cls,
        x: Float[np.ndarray, " sample"],
        sigma: float,
        rows: Float[np.ndarray, "row sample"],
        floor: float,
    ) -> "Projection":
        """The projection.

        Args:
            x: The unloaded pulse [V].
            sigma: Standard deviation of its noise [V].
            rows: Weights of the samples of a whole window.
            floor: Smallest variance that is accepted for a coefficient of V_out [V²].

        Raises:
            ValueError: The quiet between two pulses is too short.
        """
        block = max(x.size // 208, 8)  # 208 blocks in a period, if there were no pulse
        pieces, runs = _partition(x, sigma, block)
        columns = [rows[:, begin:end] for begin, end in pieces]
        for begin, count in runs:
            columns.append(rows[:, begin : begin + block * count] @ _smooth(count, block))
        within = _within(block)
        kept = np.ascontiguousarray(np.concatenate(columns, axis=1).T)
        found = cls(x.size, tuple(pieces), tuple(runs), block, within, kept, floor)
        if found.freedom() < 40:
            raise ValueError("the quiet between two pulses is too short for its noise to be known")
        return found

    def shares(self) -> Float[np.ndarray, " kept"]:
        """Variance of each sample and mean, relative to that of a sample."""
        samples = sum(end - begin for begin, end in self.pieces)
        means = sum(count for _, count in self.runs)
        return np.concatenate([np.ones(samples), np.full(means, 1 / self.block)])

    def freedom(self) -> int:
        """Degrees of freedom of the variance of the noise."""
        return sum(count for _, count in self.runs) * (self.within.shape[1] - 1)

    def single(self) -> "Projection":
        """The projection in single precision."""
        within, rows = self.within.astype(np.float32), self.rows.astype(np.float32)
        return dataclasses.replace(self, within=within, rows=rows)

    def band_sums(
        self, v_out: Float[np.ndarray, "lane sample"], adc_range: Float[np.ndarray, " 2"]
    ) -> BandSums:
        """Bands and noise of one pulse.

        Args:
            v_out: One window per electrode [V].
            adc_range: Voltages at which the converter saturates [V].
        """
        found, squares, clipped = [], [], []
        low, high = adc_range
        # More than single precision resolves.
        margin = 1e-6 * np.abs(adc_range[np.isfinite(adc_range)]).max(initial=0.0)
        with np.errstate(invalid="ignore", over="ignore"):  # samples that are not numbers
            for first in range(0, len(v_out), TOGETHER):
                samples = v_out[first : first + TOGETHER].astype(self.rows.dtype)
                kept, of_noise = self._condensed(samples)
                found.append(_product(kept, self.rows))
                squares.append(of_noise)
                near = np.zeros(len(samples), bool)
                if np.isfinite(low):
                    near |= samples.min(axis=1) <= low + margin
                if np.isfinite(high):
                    near |= samples.max(axis=1) >= high - margin
                clipped.append(near)
            at = np.concatenate(clipped)
            if at.any():
                near = v_out[at]
                at[at] = (near.min(axis=1) <= low) | (near.max(axis=1) >= high)
        variance = self.samples * np.concatenate(squares) / self.freedom()
        return BandSums(
            np.concatenate(found), np.maximum(variance, self.floor), at, np.zeros_like(at)
        )

    def _condensed(
        self, samples: Float[np.ndarray, "lane sample"]
    ) -> tuple[Float[np.ndarray, "lane kept"], Float[np.ndarray, " lane"]]:
        """Samples and means of blocks [V], and the sum of squares of the noise [V²]."""
        parts = [samples[:, begin:end] for begin, end in self.pieces]
        squares = np.zeros(len(samples))
        for begin, count in self.runs:
            blocks = samples[:, begin : begin + count * self.block]
            of = blocks.reshape(len(samples), count, self.block) @ self.within
            parts.append(of[..., 0].copy())
            of[..., 0] = 0.0
            noise = of.reshape(len(samples), -1)
            squares += np.vecdot(noise, noise)
        return np.concatenate(parts, axis=1), squares


def _product(
    kept: Float[np.ndarray, "lane kept"], rows: Float[np.ndarray, "kept row"]
) -> Float[np.ndarray, "lane row"]:
    """`kept @ rows`, in parts for which BLAS starts no threads.

    OpenBLAS starts them from 2¹⁸ multiplications on. If other programs keep the cores busy, these
    threads wait for each other for tens of milliseconds.
    """
    step = max(2**18 // (len(kept) * rows.shape[1]), 1)
    found = kept[:, :step] @ rows[:step]
    for first in range(step, len(rows), step):
        of = slice(first, first + step)
        found += kept[:, of] @ rows[of]
    return found


def _partition(
    x: Float[np.ndarray, " sample"], sigma: float, block: int
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Intervals of a window that are kept as samples, and those that are replaced by blocks.

    Args:
        x: The unloaded pulse [V].
        sigma: Standard deviation of its noise [V].
        block: Length of a block [samples].

    Returns:
        (first sample, sample after the last) of each piece, (first sample, blocks) of each run.
    """
    half = block // 2
    bend = np.abs(np.roll(x, half) - 2 * x + np.roll(x, -half))
    sharp = np.flatnonzero(bend > max(1e-2 * bend.max(), 12 * sigma))
    near = np.arange(-4 * block, 8 * block + 1)  # samples around an edge are kept
    kept = np.zeros(x.size, bool)
    kept[(sharp[:, None] + near) % x.size] = True
    pieces, runs = [], []
    for piece, samples in itertools.groupby(range(x.size), lambda at: bool(kept[at])):
        of = list(samples)
        count = 0 if piece else len(of) // block
        if count:
            runs.append((of[0], count))
        if len(of) > count * block:
            pieces.append((of[0] + count * block, of[-1] + 1))
    return pieces, runs


def _smooth(count: int, block: int) -> Float[np.ndarray, "sample block"]:
    """The smooth curve through means of blocks: the derivative of a cubic spline of their sums."""
    import scipy.interpolate  # takes a quarter of a second, which only trackers need

    ends = block * np.arange(count + 1)
    sums = np.concatenate([np.zeros((1, count)), np.cumsum(block * np.eye(count), axis=0)])
    spline = scipy.interpolate.CubicSpline(ends, sums)
    return np.diff(spline(np.arange(block * count + 1)), axis=0)


def _within(block: int) -> Float[np.ndarray, "sample column"]:
    """The mean of a block, and unit vectors at right angles to a parabola at some frequencies."""
    at = (np.arange(block) + 0.5) / block
    highest = round(2 * ALIASED * block)  # half periods in a block
    waves = np.unique(np.linspace(4, highest, 6).round())
    smooth = np.stack([at**0, at, at**2], axis=1)
    basis, _ = np.linalg.qr(np.concatenate([smooth, np.cos(np.pi * np.outer(at, waves))], axis=1))
    return np.concatenate([np.full((block, 1), 1 / block), basis[:, 3:]], axis=1)
