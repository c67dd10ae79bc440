"""Knots: a few harmonics between which smooth functions of frequency are straight lines.

The gain of a circuit, and its derivatives, are smooth over neighbouring harmonics. A recording is
not: its pulses have zeros. A sum of products of both needs the smooth function at the knots only,

    Σ_k v_k g(f_k) ≈ Σ_b g(f_b) Σ_k φ_b(k) v_k,

where φ_b is 1 at knot b and falls to 0 at the knots beside it. A function of log f that bends by
1 is wrong by 5e-4 between two knots.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact, Int


@dataclasses.dataclass(frozen=True)
class _Group:
    """Knots at equal distances: index of the first harmonic, distance, and number of intervals."""

    first: int
    width: int
    count: int

    @property
    def end(self) -> int:
        return self.first + self.width * self.count


@dataclasses.dataclass(frozen=True)
class Knots:
    """The knots of a number of harmonics.

    Attributes:
        groups: Intervals between the knots.
        index: Index of the harmonic of each knot; the first and the last harmonic are knots.
    """

    groups: tuple[_Group, ...]
    index: Int[np.ndarray, " knot"]

    def at(self, values: Inexact[Array, "*row harmonic"]) -> Inexact[Array, "*row knot"]:
        """Values at the knots."""
        return jnp.take(values, self.index, axis=-1, mode="clip")

    def summed(self, values: Inexact[Array, "*row harmonic"]) -> Inexact[Array, "*row knot"]:
        """Σ_k φ_b(k) v_k for each knot b."""
        before, after = [], []
        for group in self.groups:
            part = values[..., group.first : group.end]
            part = part.reshape(*part.shape[:-1], group.count, group.width)
            share = _shares(group, part)
            after.append((part * share).sum(-1))
            before.append((part * (1 - share)).sum(-1))
        last, none = values[..., -1:], jnp.zeros_like(values[..., :1])
        return jnp.concatenate([*before, last], -1) + jnp.concatenate([none, *after], -1)

    def between(self, values: Inexact[Array, "*row knot"]) -> Inexact[Array, "*row harmonic"]:
        """Values at all harmonics, on straight lines between the knots."""
        parts, knot = [], 0
        for group in self.groups:
            ends = values[..., knot : knot + group.count + 1, None]
            left, right = ends[..., :-1, :], ends[..., 1:, :]
            line = left + (right - left) * _shares(group, left)
            parts.append(line.reshape(*line.shape[:-2], -1))
            knot += group.count
        return jnp.concatenate([*parts, values[..., -1:]], -1)


def _shares(group: _Group, values: Inexact[Array, "*row interval _"]) -> Inexact[np.ndarray, "..."]:
    """Share of the right knot in each harmonic of the intervals, with the axes of `values`."""
    share = np.arange(group.width, dtype=values.dtype) / group.width
    return share.reshape((1,) * (values.ndim - 1) + share.shape)


@functools.lru_cache(maxsize=16)
def knots(harmonics: int, relative: int = 16) -> Knots:
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
