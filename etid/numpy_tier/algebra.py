"""Rules of linear algebra and of Fourier transforms."""

import math

import numpy as np

from etid.numpy_tier import functions
from etid.numpy_tier.translator import Equation, Translator, UntranslatableError, Value, rule

TRANSFORMS = ("fft", "ifft", "rfft", "irfft")  # in the order of `jax.lax.FftType`


def _all(t: Translator, text: str, equation: Equation, *operands: Value) -> list[Value]:
    return t.emit(text, operands, *[var.aval for var in equation.outvars])


@rule("dot_general")
def _product(t: Translator, equation: Equation, a: Value, b: Value) -> list[Value]:
    (of_a, of_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    aval = equation.outvars[0].aval
    if a.dtype != aval.dtype or b.dtype != aval.dtype:
        raise UntranslatableError("product of different types")
    size = math.prod(aval.shape) * math.prod(a.shape[axis] for axis in of_a)
    simple = not batch_a and len(a.shape) <= 2 and len(b.shape) <= 2 and len(of_a) == 1
    if simple and size <= functions.SMALL[0]:
        left = f"{a.name}.T" if len(a.shape) == 2 and of_a[0] == 0 else a.name
        right = f"{b.name}.T" if len(b.shape) == 2 and of_b[0] == 1 else b.name
        return _all(t, f"{left}.dot({right})", equation, a, b)
    rest_a = [axis for axis in range(len(a.shape)) if axis not in (*of_a, *batch_a)]
    rest_b = [axis for axis in range(len(b.shape)) if axis not in (*of_b, *batch_b)]
    batch = tuple(a.shape[axis] for axis in batch_a)
    inner = math.prod(a.shape[axis] for axis in of_a)
    rows = math.prod(a.shape[axis] for axis in rest_a)
    columns = math.prod(b.shape[axis] for axis in rest_b)
    left = f"{_moved(a, (*batch_a, *rest_a, *of_a))}.reshape({(*batch, rows, inner)})"
    right = f"{_moved(b, (*batch_b, *of_b, *rest_b))}.reshape({(*batch, inner, columns)})"
    return _all(t, f"product({left},{right}).reshape({tuple(aval.shape)})", equation, a, b)


def _moved(of: Value, axes: tuple[int, ...]) -> str:
    axes = tuple(int(axis) for axis in axes)
    return of.name if axes == tuple(range(len(axes))) else f"{of.name}.transpose({axes})"


@rule("cholesky")
def _cholesky(t: Translator, equation: Equation, of: Value) -> list[Value]:
    return _all(t, f"cholesky({of.name})", equation, of)


@rule("triangular_solve")
def _triangular_solve(t: Translator, equation: Equation, a: Value, b: Value) -> list[Value]:
    params = equation.params
    trans = 0 if not params["transpose_a"] else 2 if params["conjugate_a"] else 1
    sides = int(not params["left_side"]), int(params["lower"]), trans, int(params["unit_diagonal"])
    text = f"triangular_solve({a.name},{b.name},{','.join(map(str, sides))})"
    return _all(t, text, equation, a, b)


@rule("lu")
def _lu(t: Translator, equation: Equation, of: Value) -> list[Value]:
    return _all(t, f"lu({of.name})", equation, of)


@rule("qr")
def _qr(t: Translator, equation: Equation, of: Value) -> list[Value]:
    params = equation.params
    if params.get("pivoting") or not np.prod(of.shape):
        raise UntranslatableError("qr with pivots, or of an empty matrix")
    return _all(t, f"qr({of.name},{bool(params['full_matrices'])})", equation, of)


@rule("eigh")
def _eigh(t: Translator, equation: Equation, of: Value) -> list[Value]:
    if equation.params.get("subset_by_index") not in (None, (0, of.shape[-1])):
        raise UntranslatableError("some eigenvalues")
    return _all(t, f"eigh({of.name},{bool(equation.params['lower'])})", equation, of)


@rule("eig")
def _eig(t: Translator, equation: Equation, of: Value) -> list[Value]:
    if len(equation.outvars) > 1:
        raise UntranslatableError("eigenvectors of a matrix without symmetry")
    return _all(t, f"eigenvalues({of.name})", equation, of)


@rule("svd")
def _svd(t: Translator, equation: Equation, of: Value) -> list[Value]:
    params = equation.params
    if params.get("subset_by_index") is not None or not np.prod(of.shape):
        raise UntranslatableError("some singular values, or those of an empty matrix")
    vectors, full = bool(params["compute_uv"]), bool(params["full_matrices"])
    only = "" if vectors else "[0]"
    return _all(t, f"svd({of.name},{vectors},{full}){only}", equation, of)


@rule("fft")
def _fft(t: Translator, equation: Equation, of: Value) -> list[Value]:
    lengths = equation.params["fft_lengths"]
    if len(lengths) != 1:
        raise UntranslatableError("fft over several axes")
    name = TRANSFORMS[int(equation.params["fft_type"])]
    return _all(t, f"np.fft.{name}({of.name},{lengths[0]})", equation, of)
