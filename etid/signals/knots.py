"""Knots: a few harmonics between which smooth functions of frequency are straight lines.

The gain of a circuit, and its derivatives, are smooth over neighbouring harmonics. A recording is
not: its pulses have zeros. A sum of products of both needs the smooth function at the knots only,

    Σ_k v_k g(f_k) ≈ Σ_b g(f_b) Σ_k φ_b(k) v_k,

where φ_b is 1 at knot b and falls to 0 at the knots beside it. A function of log f that bends by
1 is wrong by 5e-4 between two knots.

Fits that need not be exact take the harmonics summed over bands. A band is a few neighbouring
harmonics: at most 16, and at most a sixteenth of their frequency wide. The gain G hardly changes
over a band. The harmonics of a band therefore act like one harmonic,

    X = √P,    Y = Σ X̄_k Y_k / √P,    P = Σ (|X_k|² − σ_x²)    at    f = Σ |X_k|² f_k / Σ |X_k|².

This is a tenth of the numbers. A minimum found with them is within a standard error or so of the
minimum of all harmonics.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Inexact, Int

from etid.precision import array_function, namespace
from etid.signals.harmonics import ABSENT, Spectrum
from etid.signals.transfer import AnyArray, as_complex, from_parts, power

DENSITY = 16  # smallest number of a harmonic over the distance of the knots around it


@dataclasses.dataclass(frozen=True)
class _Group:
    """Knots at equal distances: index of the first harmonic, distance, and number of intervals."""

    first: int
    width: int
    count: int

    @property
    def end(self) -> int:
        return self.first + self.width * self.count

    @functools.cached_property
    def shares(self) -> Float[np.ndarray, "width 2"]:
        """Shares of the left and of the right knot in each harmonic of an interval."""
        share = np.arange(self.width) / self.width
        return np.stack([1 - share, share], axis=1)


@dataclasses.dataclass(frozen=True)
class Knots:
    """The knots of a number of harmonics.

    Attributes:
        groups: Intervals between the knots.
        index: Index of the harmonic of each knot; the first and the last harmonic are knots.
    """

    groups: tuple[_Group, ...]
    index: Int[np.ndarray, " knot"]

    def at(self, values: Inexact[AnyArray, "*row harmonic"]) -> Inexact[AnyArray, "*row knot"]:
        """Values at the knots."""
        if isinstance(values, np.ndarray):
            return values[..., self.index]
        return jnp.take(values, self.index, axis=-1, mode="clip")

    def summed(self, values: Inexact[AnyArray, "*row harmonic"]) -> Inexact[AnyArray, "*row knot"]:
        """Σ_k φ_b(k) v_k for each knot b."""
        xp, rows = namespace(values), values.shape[:-1]
        pairs = [xp.zeros((*rows, 0, 2), values.dtype)]  # a single harmonic has no interval
        for group in self.groups:
            part = values[..., group.first : group.end]
            part = part.reshape(*rows, group.count, group.width)
            pairs.append(_product(part, group.shares.astype(values.dtype)))
        pairs = xp.concatenate(pairs, axis=-2)
        last, none = values[..., -1:], xp.zeros((*rows, 1), values.dtype)
        left, right = pairs[..., 0], pairs[..., 1]
        return xp.concatenate([left, last], -1) + xp.concatenate([none, right], -1)

    def between(self, values: Inexact[AnyArray, "*row knot"]) -> Inexact[AnyArray, "*row harmonic"]:
        """Values at all harmonics, on straight lines between the knots."""
        xp, rows, parts, knot = namespace(values), values.shape[:-1], [], 0
        pairs = xp.stack([values[..., :-1], values[..., 1:]], axis=-1)
        for group in self.groups:
            ends = pairs[..., knot : knot + group.count, :]
            line = _product(ends, group.shares.T.astype(values.dtype))
            parts.append(line.reshape(*rows, group.count * group.width))
            knot += group.count
        return xp.concatenate([*parts, values[..., -1:]], -1)


def _product(
    values: Inexact[AnyArray, "*row interval n"], matrix: Inexact[np.ndarray, "n m"]
) -> Inexact[AnyArray, "*row interval m"]:
    """The product with a matrix; an operation of `lax` is traced in a fifth of the time."""
    if isinstance(
        values, np.ndarray
    ):  # one product of two matrices takes a third of many small ones
        flat = values.reshape(-1, values.shape[-1])
        if np.iscomplexobj(values):
            whole = np.real(flat) @ np.real(matrix) + 1j * (np.imag(flat) @ np.real(matrix))
        else:
            whole = flat @ matrix
        return whole.reshape(*values.shape[:-1], -1)
    return jax.lax.dot_general(values, matrix, (((values.ndim - 1,), (0,)), ((), ())))


@functools.lru_cache(maxsize=16)
def knots(harmonics: int, relative: int = DENSITY) -> Knots:
    """Knots of so many harmonics, the first of which is the pulse rate.

    Args:
        harmonics: Number of harmonics.
        relative: Smallest number of a harmonic over the distance of the knots around it.
    """
    groups: list[_Group] = []
    first, width, last = 0, 1, harmonics - 1
    while first + width <= last:
        # The distance doubles at the harmonic whose number is 2 · `relative` distances.
        count = (min(2 * relative * width - 1, last) - first) // width
        if count:
            groups.append(_Group(first, width, count))
            first = groups[-1].end
        width *= 2
    if first < last:
        groups.append(_Group(first, last - first, 1))
    index = [np.arange(group.first, group.end, group.width) for group in groups]
    return Knots(tuple(groups), np.concatenate([*index, [last]]).astype(int))


# --- Bands ----------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=64)
def _bands(harmonics: int) -> Int[np.ndarray, " harmonic"]:
    """Number of the band of each harmonic."""
    band: list[int] = []
    while (first := len(band)) < harmonics:
        width = min(max((first + 1) // 16, 1), 16)
        band += [band[-1] + 1 if band else 0] * width
    return np.asarray(band[:harmonics])


@array_function
def banded(spectrum: Spectrum) -> Spectrum:
    """The harmonics of each recording, summed over bands; selected where X exceeds its noise."""
    xp, band = namespace(spectrum.x), _bands(spectrum.frequency.shape[-1])
    first = np.flatnonzero(np.diff(band, prepend=-1))

    def summed(values: Float[AnyArray, "*lane harmonic"]) -> Float[AnyArray, "*lane band"]:
        return xp.add.reduceat(xp.where(spectrum.selected, values, 0.0), first, axis=-1)

    count, size = summed(xp.ones_like(spectrum.variance_x)), summed(power(spectrum.x))
    signal = size - summed(spectrum.variance_x)
    present = signal > size / 2  # half of |X|² is signal; False where no harmonic is selected
    signal, size = (xp.where(present, sums, 1.0) for sums in (signal, size))
    level, product = xp.sqrt(signal), xp.conj(spectrum.x) * spectrum.y

    def filled(
        values: Float[AnyArray, "*lane band"], absent: AnyArray | float
    ) -> Float[AnyArray, "*lane band"]:
        return xp.where(present, values, absent)

    def variance(values: Float[AnyArray, "*lane harmonic"]) -> Float[AnyArray, "*lane band"]:
        return filled(summed(values) / xp.maximum(count, 1.0) * size / signal, ABSENT)

    # Every band needs a frequency, and these grow.
    anyhow = spectrum.frequency[..., first]
    y = summed(product.real) / level, summed(product.imag) / level
    return Spectrum(
        frequency=filled(summed(power(spectrum.x) * spectrum.frequency) / size, anyhow),
        x=as_complex(filled(level, ABSENT)),
        y=from_parts(filled(y[0], ABSENT), filled(y[1], 0.0)),
        variance_x=variance(spectrum.variance_x),
        variance_y=variance(spectrum.variance_y),
        selected=present,
        held=spectrum.held,
    )


def above_noise(spectrum: Spectrum, bands: Spectrum) -> Spectrum:
    """The harmonics of each recording, selected in the bands in which X exceeds its noise.

    The others say little of Y/X. But a driver has ten parameters, and some Z_th agrees with their
    noise so well that a fit leaves the minimum which the other harmonics have, for one that is
    silently wrong: of 200 calibrations at 30 dB in two. At 20 dB, where half of the harmonics are
    left out, C_p of dry skin scatters by a sixth more.

    Args:
        spectrum: The harmonics.
        bands: The same, as `banded` sums them.
    """
    present = bands.selected[..., _bands(spectrum.frequency.shape[-1])]
    return dataclasses.replace(spectrum, selected=spectrum.selected & present)
