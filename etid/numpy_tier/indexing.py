"""Elements at places that a program computes: gather, scatter and dynamic slices of XLA."""

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["places", "scattered", "taken_or", "updated", "window"]


def places(
    at: Any,
    shape: tuple[int, ...],
    sizes: tuple[int, ...],
    window_axes: tuple[int, ...],
    collapsed: tuple[int, ...],
    start_axes: tuple[int, ...],
    batch: tuple[int, ...],
    batch_of_at: tuple[int, ...],
    drop: bool,
) -> Any:
    """Numbers of the elements of an array that lie in windows, counted as in `array.ravel()`.

    The result has an axis for each axis of `at` but the last, and one for each axis of a window
    that is not collapsed.

    Args:
        at: First element of each window; the last axis holds its coordinates.
        shape: Shape of the array.
        sizes: Shape of a window.
        window_axes: Axes of the result that belong to the windows.
        collapsed: Axes of the array that the result lacks; windows have length 1 there.
        start_axes: Axes of the array that the coordinates of `at` belong to.
        batch: Axes of the array over which arrays and windows go together.
        batch_of_at: The axes of `at` that belong to these.
        drop: Whether a window that leaves the array gets -1; else it is moved into the array.
    """
    at = np.asarray(at)
    of_windows = at.shape[:-1]
    axes = len(of_windows) + len(window_axes)
    outer = [axis for axis in range(axes) if axis not in window_axes]
    inner = iter(window_axes)

    def along(values: Any, result_axes: Sequence[int]) -> Any:
        new = [1] * axes
        for axis, length in zip(result_axes, values.shape, strict=True):
            new[axis] = length
        return values.reshape(new)

    found, outside = np.zeros([1] * axes, np.int64), np.zeros([1] * axes, bool)
    for axis, (length, size) in enumerate(zip(shape, sizes, strict=True)):
        found = found * length
        if axis in start_axes:
            start = along(at[..., start_axes.index(axis)].astype(np.int64), outer)
            if drop:
                outside = outside | (start < 0) | (start > length - size)
            found = found + np.clip(start, 0, max(length - size, 0))
        if axis in batch:
            found = found + along(np.arange(length), [outer[batch_of_at[batch.index(axis)]]])
        elif axis not in collapsed:
            found = found + along(np.arange(size), [next(inner)])
    total = [0] * axes
    for axis, length in zip(outer, of_windows, strict=True):
        total[axis] = length
    kept = [n for i, n in enumerate(sizes) if i not in collapsed and i not in batch]
    for axis, length in zip(window_axes, kept, strict=True):
        total[axis] = length
    return np.broadcast_to(np.where(outside, -1, found), total)


def taken_or(of: Any, flat: Any, fill: Any) -> Any:
    """Elements by number, and `fill` where the number is negative."""
    outside = flat < 0
    if not of.size:
        return np.full(flat.shape, fill, of.dtype)
    return np.where(outside, fill, of.take(np.where(outside, 0, flat)))[()]


def scattered(of: Any, flat: Any, new: Any, how: Any) -> Any:
    """An array with new elements at places by number; a negative number is no place.

    Args:
        of: Array.
        flat: Numbers.
        new: New elements.
        how: Function of NumPy that joins old and new elements; None if the new ones replace them.
    """
    found, inside = np.ravel(of).copy(), flat >= 0
    flat, new = flat[inside], np.asarray(new)[inside]
    if how is None:
        found[flat] = new
    else:
        how.at(found, flat, new)
    return found.reshape(np.shape(of))


def window(shape: Sequence[int], starts: Sequence[Any], sizes: Sequence[int]) -> tuple[slice, ...]:
    """The window of an array that begins at some place, moved into the array if it leaves it."""
    firsts = [
        min(max(int(start), 0), length - size)
        for start, size, length in zip(starts, sizes, shape, strict=True)
    ]
    return tuple(slice(first, first + size) for first, size in zip(firsts, sizes, strict=True))


def updated(of: Any, new: Any, at: tuple[slice, ...]) -> Any:
    """An array with new elements in a window."""
    found = of.copy()
    found[at] = new
    return found
