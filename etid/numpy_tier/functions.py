"""Functions that the text of a program calls, where NumPy has none that does as XLA does."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import blas, lapack

__all__ = [
    "cholesky",
    "complex_number",
    "complex_of",
    "eigenvalues",
    "eigh",
    "integer_power",
    "lu",
    "padded",
    "product",
    "qr",
    "quotient",
    "remainder",
    "rounded",
    "sorted_by",
    "svd",
    "triangular_solve",
    "whole",
    "window_sum",
]

# By the letter of the type; `get_lapack_funcs` would take longer than the work itself.
CHOLESKY = {of: getattr(lapack, f"{name}potrf") for of, name in zip("fdFD", "sdcz", strict=True)}
LU = {of: getattr(lapack, f"{name}getrf") for of, name in zip("fdFD", "sdcz", strict=True)}
SOLVE = {of: getattr(blas, f"{name}trsm") for of, name in zip("fdFD", "sdcz", strict=True)}

# --- Elements -------------------------------------------------------------------------------------


def complex_of(real: Any, imag: Any, shape: tuple[int, ...], dtype: str) -> Any:
    """Complex numbers; `real + 1j * imag` would turn infinities into NaN."""
    found = np.empty(shape, dtype)
    found.real, found.imag = real, imag
    return found


def complex_number(real: Any, imag: Any) -> Any:
    """One complex number."""
    return np.result_type(real, np.complex64).type(complex(real, imag))


def whole(of: Any, dtype: str) -> Any:
    """Integers of numbers: 0 for NaN, and the nearest integer of the type for the others."""
    limits, of = np.iinfo(dtype), np.asarray(of)
    kept = np.where(np.isnan(of), 0, np.trunc(of))
    low, high = kept <= limits.min, kept >= float(limits.max)
    found = np.where(low | high, 0, kept).astype(dtype)
    return np.where(low, limits.min, np.where(high, limits.max, found)).astype(dtype)[()]


def rounded(of: Any) -> Any:
    """The nearest whole numbers; of two, the one further from 0."""
    below = np.trunc(of)
    return below + np.copysign(np.absolute(of - below) >= 0.5, of)


def quotient(a: Any, b: Any) -> Any:
    """Quotient of integers, rounded to zero; -1 if the divisor is 0."""
    size = np.floor_divide(np.abs(a), np.abs(b))
    return np.where(b == 0, -1, np.sign(a) * np.sign(b) * size).astype(size.dtype)[()]


def remainder(a: Any, b: Any) -> Any:
    """Remainder of integers, with the sign of the dividend; the dividend if the divisor is 0."""
    rest = np.fmod(a, b)
    return np.where(b == 0, a, rest).astype(rest.dtype)[()]


def integer_power(of: Any, power: int) -> Any:
    """Power by repeated squaring, as XLA does it."""
    left, square, found = abs(power), of, None
    while left:
        if left & 1:
            found = square if found is None else found * square
        left >>= 1
        square = square * square if left else square
    if found is None:
        return np.ones_like(of)
    return found if power > 0 else np.reciprocal(found)


# --- Arrays ---------------------------------------------------------------------------------------


def padded(of: Any, fill: Any, limits: Sequence[tuple[int, int, int]]) -> Any:
    """An array with elements around it and between its elements.

    Args:
        of: Array.
        fill: The new elements.
        limits: For each axis, how many come before (fewer than 0: cut off), after, and between.
    """
    wide = [max(n + (n - 1) * step, 0) for n, (_, _, step) in zip(of.shape, limits, strict=True)]
    shape = [n + low + high for n, (low, high, _) in zip(wide, limits, strict=True)]
    found, inner, outer = np.full(shape, fill, of.dtype), [], []
    for n, total, size, (low, _, step) in zip(wide, shape, of.shape, limits, strict=True):
        step += 1
        first = max(-(low // step), 0) if low < 0 else 0  # element that is not cut off
        start = low + first * step
        count = max(min(size - first, -(-(total - start) // step)), 0) if n else 0
        inner.append(slice(first, first + count))
        outer.append(slice(start, start + (count - 1) * step + 1 if count else start, step))
    found[tuple(outer)] = of[tuple(inner)]
    return found


def window_sum(of: Any, size: tuple, steps: tuple, limits: Sequence[tuple]) -> Any:
    """Sums over windows that move over an array with zeros around it."""
    wide = padded(of, 0, limits)
    windows = np.lib.stride_tricks.sliding_window_view(wide, size)
    windows = windows[tuple(slice(None, None, step) for step in steps)]
    return windows.sum(tuple(range(of.ndim, 2 * of.ndim)), of.dtype)


def sorted_by(arrays: Sequence[Any], axis: int, keys: int) -> list[Any]:
    """Arrays in the order of the first `keys` of them; NaN come last."""
    if keys == 1:
        order = np.argsort(arrays[0], axis, kind="stable")
    else:
        order = np.lexsort(arrays[keys - 1 :: -1], axis)
    return [np.take_along_axis(of, order, axis) for of in arrays]


# --- Linear algebra -------------------------------------------------------------------------------

# OpenBLAS computes products of fewer multiplications than these in one thread: of a vector (also a
# complex one), and of matrices. Its other threads wait for the next product in a busy loop, which
# took three quarters of the CPU time of a driver.
SMALL = 2**12, 2**17


def product(a: Any, b: Any) -> Any:
    """Product of matrices; of large ones in parts, which BLAS computes without threads."""
    sizes = a.shape[-2], a.shape[-1], b.shape[-1]
    rows, inner, columns = sizes
    if rows * inner * columns <= SMALL[min(rows, columns) > 1]:
        return np.matmul(a, b)
    half = max(sizes) // 2
    if rows == max(sizes):
        parts = product(a[..., :half, :], b), product(a[..., half:, :], b)
        return np.concatenate(parts, -2)
    if columns == max(sizes):
        parts = product(a, b[..., :half]), product(a, b[..., half:])
        return np.concatenate(parts, -1)
    return product(a[..., :half], b[..., :half, :]) + product(a[..., half:], b[..., half:, :])


def _each(function: Any, *arrays: Any) -> list[Any]:
    """Results of a function of matrices, for each of several."""
    batch = arrays[0].shape[:-2]
    rows = [of.reshape(-1, *of.shape[-2:]) for of in arrays]
    found = [function(*of) for of in zip(*rows, strict=True)]
    return [np.array(of).reshape(*batch, *of[0].shape) for of in zip(*found, strict=True)]


def qr(of: Any, full: bool) -> Any:
    """Orthogonal and triangular factor; of a long matrix from those of its parts, as `product`."""
    rows, columns = of.shape[-2:]
    if full or rows * columns <= 2 * SMALL[0] or rows < 4 * columns:
        return np.linalg.qr(of, "complete" if full else "reduced")
    half = rows // 2
    first, upper = qr(of[..., :half, :], False)
    second, lower = qr(of[..., half:, :], False)
    of_both, found = np.linalg.qr(np.concatenate((upper, lower), -2))
    parts = product(first, of_both[..., :columns, :]), product(second, of_both[..., columns:, :])
    return np.concatenate(parts, -2), found


def cholesky(of: Any) -> Any:
    """Lower factor; NaN for a matrix that is not positive definite."""
    if of.ndim > 2:
        return _each(lambda one: (cholesky(one),), of)[0] if of.size else of.copy()
    if not of.size:
        return of.copy()
    found, failed = CHOLESKY[of.dtype.char](of, lower=1, clean=1)
    return np.full_like(of, np.nan) if failed else found


def triangular_solve(a: Any, b: Any, side: int, lower: int, trans: int, unit: int) -> Any:
    """X of op(A) X = B, or of X op(A) = B; a singular A gives infinities.

    Args:
        a: Triangular matrix.
        b: Right-hand sides.
        side: 0 if A stands on the left, else 1.
        lower: Whether A is lower triangular.
        trans: 0: A itself, 1: its transpose, 2: its conjugate transpose.
        unit: Whether the diagonal of A is 1.
    """
    if not b.size:
        return b.copy()
    if b.ndim > 2:
        return _each(lambda a, b: (triangular_solve(a, b, side, lower, trans, unit),), a, b)[0]
    return SOLVE[a.dtype.char](1.0, a, b, side=side, lower=lower, trans_a=trans, diag=unit)


def lu(of: Any) -> list[Any]:
    """Both factors in one matrix, the exchanged rows, and their order."""
    if of.ndim > 2:
        return _each(lu, of)
    found, pivots, _ = LU[of.dtype.char](of)
    order = np.arange(of.shape[0], dtype=np.int32)
    for row, other in enumerate(pivots):
        order[[row, other]] = order[[other, row]]
    return [found, pivots.astype(np.int32), order]


def eigh(of: Any, lower: bool) -> Any:
    """Eigenvectors and eigenvalues of a symmetric matrix; NaN if they are not found."""
    try:
        values, vectors = np.linalg.eigh(of, "L" if lower else "U")
    except np.linalg.LinAlgError:
        if of.ndim > 2:  # one of several fails
            return _each(lambda one: eigh(one, lower), of)
        return np.full_like(of, np.nan), np.full(of.shape[:-1], np.nan, of.real.dtype)
    return vectors, values


def eigenvalues(of: Any) -> Any:
    """Eigenvalues of a matrix; NaN if they are not found."""
    dtype = np.result_type(of, np.complex64)
    try:
        return np.linalg.eigvals(of).astype(dtype)
    except np.linalg.LinAlgError:
        if of.ndim > 2:
            return _each(lambda one: (eigenvalues(one),), of)[0]
        return np.full(of.shape[:-1], complex(np.nan, np.nan), dtype)


def svd(of: Any, vectors: bool, full: bool) -> list[Any]:
    """Singular values, and the vectors on their left and right; NaN if they are not found."""
    try:
        found: Any = np.linalg.svd(of, full, vectors)
    except np.linalg.LinAlgError:
        if of.ndim > 2:
            return _each(lambda one: svd(one, vectors, full), of)
        found = np.linalg.svd(np.zeros_like(of), full, vectors)
        found = [one * np.nan for one in found] if vectors else found * np.nan
    return [found[1], found[0], found[2]] if vectors else [found]
