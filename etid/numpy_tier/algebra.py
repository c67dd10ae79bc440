"""Linear algebra and Fourier transforms by NumPy and LAPACK, with the results of XLA.

OpenBLAS shares a product of a few thousand multiplications among threads. Those then wait for the
next product in a busy loop, which takes three quarters of the CPU time of a driver. So BLAS has
`one_thread` while a small program runs.
"""

import contextlib
import functools
import math
import operator
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from etid.numpy_tier.source import UntranslatableError, Value


def product(p: Any, operands: Sequence[Value], results: Sequence[Any]) -> Callable[[Any, Any], Any]:
    """The function that multiplies two arrays and sums over axes."""
    ((of_a, of_b), (batch_a, batch_b)), (a, b) = p["dimension_numbers"], operands
    if a.dtype != b.dtype or a.dtype != results[0].dtype:
        raise UntranslatableError("product of different types")
    if not batch_a and len(a.shape) <= 2 and len(b.shape) <= 2 and len(of_a) == 1:
        left = len(a.shape) == 2 and of_a[0] == 0
        right = len(b.shape) == 2 and of_b[0] == 1
        return lambda a, b: np.dot(a.T if left else a, b.T if right else b)
    rest_a = [axis for axis in range(len(a.shape)) if axis not in (*of_a, *batch_a)]
    rest_b = [axis for axis in range(len(b.shape)) if axis not in (*of_b, *batch_b)]
    axes_a, axes_b = (*batch_a, *rest_a, *of_a), (*batch_b, *of_b, *rest_b)
    batch = [a.shape[axis] for axis in batch_a]
    inner = math.prod(a.shape[axis] for axis in of_a)
    rows = math.prod(a.shape[axis] for axis in rest_a)
    columns = math.prod(b.shape[axis] for axis in rest_b)

    def multiply(a: Any, b: Any) -> Any:
        a = a.transpose(axes_a).reshape(*batch, rows, inner)
        b = b.transpose(axes_b).reshape(*batch, inner, columns)
        return np.matmul(a, b).reshape(results[0].shape)[()]

    return multiply


def each(function: Callable[..., Sequence[Any]], *arrays: Any) -> list[Any]:
    """Results of a function of matrices, for each of several."""
    batch = arrays[0].shape[:-2]
    rows = [of.reshape(-1, *of.shape[-2:]) for of in arrays]
    found = [function(*of) for of in zip(*rows, strict=True)]
    return [np.array(of).reshape(*batch, *of[0].shape) for of in zip(*found, strict=True)]


def cholesky(of: Any) -> Any:
    """Lower factor; NaN for a matrix that is not positive definite."""
    return or_nan(np.linalg.cholesky, of)


def triangular_solve(
    a: Any,
    b: Any,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    conjugate_a: bool,
    unit_diagonal: bool,
) -> Any:
    """X of op(A) X = B, or of X op(A) = B; a singular A gives infinities."""
    if conjugate_a:
        a = a.conj()
    if unit_diagonal:
        a = np.where(np.eye(a.shape[-1], dtype=bool), 1, a)
    if transpose_a == left_side:  # the transposed equations if X is on the left of A
        a, lower = a.swapaxes(-1, -2), not lower
    if not left_side:
        b = b.swapaxes(-1, -2)
    # Gauss has nothing to eliminate from an upper matrix, and exchanges no rows.
    if lower:
        a, b = a[..., ::-1, ::-1], b[..., ::-1, :]
    a = np.triu(a)
    good = np.isfinite(a).all((-2, -1)) & (a.diagonal(axis1=-2, axis2=-1) != 0).all(-1)
    if good.all():
        found = np.linalg.solve(a, b)
    else:  # Gauss would refuse a singular matrix, and spread what is not finite
        found = substituted(a, b)
        found[good] = np.linalg.solve(a[good], b[good])
    found = found[..., ::-1, :] if lower else found
    return found if left_side else found.swapaxes(-1, -2)


def substituted(a: Any, b: Any) -> Any:
    """X of A X = B for an upper A, which may be singular."""
    found = np.zeros_like(b)
    for row in reversed(range(a.shape[-1])):
        above = a[..., row, None, row + 1 :] @ found[..., row + 1 :, :]
        found[..., row, :] = (b[..., row, :] - above[..., 0, :]) / a[..., row, row, None]
    return found


def lu(of: Any) -> list[Any]:
    """Both factors in one matrix, the exchanged rows, and their order."""
    if not of.size:  # LAPACK would write a complaint to the terminal
        *batch, rows, columns = of.shape
        order = np.broadcast_to(np.arange(rows, dtype=np.int32), (*batch, rows))
        return [of.copy(), np.zeros((*batch, min(rows, columns)), np.int32), order]
    if of.ndim > 2:
        return each(lu, of)
    found, pivots, _ = _factors(of.dtype.char)(of)
    order = np.arange(of.shape[0], dtype=np.int32)
    for row, other in enumerate(pivots):
        order[[row, other]] = order[[other, row]]
    return [found, pivots.astype(np.int32), order]


@functools.cache
def _factors(kind: str) -> Callable[..., Any]:
    """LAPACK's function for the letter of a type."""
    from scipy.linalg import lapack  # takes a fifth of a second, and only a few programs need it

    return getattr(lapack, f"{dict(zip('fdFD', 'sdcz', strict=True))[kind]}getrf")


def or_nan(function: Callable[..., Any], of: Any) -> Any:
    """Results of a function of matrices; NaN if they are not found."""
    try:
        return function(of)
    except np.linalg.LinAlgError:
        if of.ndim > 2:  # one of several
            found = each(lambda one: _as_tuple(or_nan(function, one)), of)
            return tuple(found) if len(found) > 1 else found[0]
        found = function(np.eye(*of.shape, dtype=of.dtype))
        return tuple(one * np.nan for one in found) if isinstance(found, tuple) else found * np.nan


def _as_tuple(found: Any) -> tuple[Any, ...]:
    return found if isinstance(found, tuple) else (found,)


def qr(p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of orthogonal and triangular factors."""
    if p.get("pivoting") or 0 in operands[0].shape:
        raise UntranslatableError("qr with pivots, or of an empty matrix")
    return partial(np.linalg.qr, mode="complete" if p["full_matrices"] else "reduced")


def eigh(p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of eigenvectors and eigenvalues of symmetric matrices."""
    if p.get("subset_by_index") not in (None, (0, operands[0].shape[-1])):
        raise UntranslatableError("some eigenvalues")
    function = partial(np.linalg.eigh, UPLO="L" if p["lower"] else "U")
    return lambda of: or_nan(function, of)[::-1]


def eig(_: Any, __: Any, results: Sequence[Any]) -> Any:
    """The rule of eigenvalues, which are complex numbers also if all are real."""
    if len(results) > 1:
        raise UntranslatableError("eigenvectors of a matrix without symmetry")
    return lambda of: [or_nan(np.linalg.eigvals, of).astype(results[0].dtype)]


def svd(p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of singular values, and of the vectors on their left and right."""
    if p.get("subset_by_index") is not None or 0 in operands[0].shape:
        raise UntranslatableError("some singular values, or those of an empty matrix")
    both = p["compute_uv"]
    function = partial(np.linalg.svd, full_matrices=p["full_matrices"], compute_uv=both)
    order = operator.itemgetter(1, 0, 2) if both else lambda values: [values]
    return lambda of: order(or_nan(function, of))


def fft(p: Any, _: Any, __: Any) -> Any:
    """The rule of Fourier transforms over the last axes."""
    functions = np.fft.fftn, np.fft.ifftn, np.fft.rfftn, np.fft.irfftn
    lengths = p["fft_lengths"]
    return partial(functions[int(p["fft_type"])], s=lengths, axes=range(-len(lengths), 0))


_lock = threading.Lock()
_limits: list[contextlib.AbstractContextManager[object]] = []
_inside = 0  # programs that run at this time, in all threads


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS has one thread within, and after the last of several programs as many as before."""
    global _inside
    with _lock:
        if _inside == 0:
            _limits.append(_blas().limit(limits=1))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _limits.pop().__exit__(None, None, None)


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")
