"""Samples that are missing: NaN, or under the mask of a masked array of NumPy."""

from typing import Any

import jax
import numpy as np
import numpy.typing as npt


def unmasked(values: Any) -> npt.NDArray | jax.Array:
    """The values as a plain array, in which those under a mask are NaN.

    `numpy.asarray` would drop the mask and give what is under it.

    Args:
        values: An array, or nested sequences of numbers or arrays. Arrays of JAX remain.
    """
    if isinstance(values, jax.Array):
        return values
    if isinstance(values, list | tuple) and any(np.ma.isMaskedArray(one) for one in values):
        values = np.ma.stack([np.ma.asarray(one) for one in values])
    if not np.ma.is_masked(values):
        return np.asarray(values)
    found: np.ndarray = np.ma.getdata(values)
    hidden: np.ndarray = np.ma.getmaskarray(values)  # pyright: ignore  # checked above
    if found.dtype.kind in "biu":  # integers have no NaN
        found = found.astype(float)
    return np.where(hidden, np.array(np.nan, found.dtype), found)
