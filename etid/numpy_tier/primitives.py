"""The primitives of JAX, as text of NumPy.

A text has `{}` for each operand, or `{all}` for all of them. It is a function of the parameters and
of the types of operands and results where it depends on them. What NumPy cannot do as XLA does is
in `functions`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode, RoundingMethod


class UntranslatableError(Exception):
    """A program has a primitive, or a use of it, that has no rule."""


Text = str | Callable[[Any, Sequence[Any], Sequence[Any]], str]

TEXTS: dict[str, Text] = {
    "abs": "np.absolute({})",
    "acos": "np.arccos({})",
    "add": "{}+{}",
    "add_any": "{}+{}",
    "and": "{}&{}",
    "asin": "np.arcsin({})",
    "atan": "np.arctan({})",
    "atan2": "np.arctan2({},{})",
    "ceil": "np.ceil({})",
    "cholesky": "cholesky({})",
    "clamp": "np.minimum(np.maximum({1},{0}),{2})",
    "complex": "complex_of({},{})",
    "conj": "np.conj({})",
    "copy": "{}",
    "copy_p": "{}",
    "cos": "np.cos({})",
    "cosh": "np.cosh({})",
    "eq": "{}=={}",
    "exp": "np.exp({})",
    "exp2": "np.exp2({})",
    "expm1": "np.expm1({})",
    "floor": "np.floor({})",
    "ge": "{}>={}",
    "gt": "{}>{}",
    "imag": "{}.imag",
    "is_finite": "np.isfinite({})",
    "le": "{}<={}",
    "log": "np.log({})",
    "log1p": "np.log1p({})",
    "lt": "{}<{}",
    "lu": "lu({})",
    "max": "np.maximum({},{})",
    "min": "np.minimum({},{})",
    "mul": "{}*{}",
    "ne": "{}!={}",
    "neg": "-{}",
    "not": "~{}",
    "or": "{}|{}",
    "pow": "np.power({},{})",
    "real": "{}.real",
    "sign": "np.sign({})",
    "sin": "np.sin({})",
    "sinh": "np.sinh({})",
    "sqrt": "np.sqrt({})",
    "square": "np.square({})",
    "stop_gradient": "{}",
    "sub": "{}-{}",
    "tan": "np.tan({})",
    "tanh": "np.tanh({})",
    "xor": "{}^{}",
}


def text(function: Callable[..., str]) -> Callable[..., str]:
    """Register the text of the primitive that the function is called after."""
    TEXTS[function.__name__.strip("_")] = function
    return function


def numbers(of: Any) -> tuple[int, ...]:
    """Integers of Python, which write themselves without their type."""
    return tuple(int(one) for one in of)


# --- Elements -------------------------------------------------------------------------------------


def _is_whole(of: Any) -> bool:
    return of.dtype.kind in "iu"


@text
def div(_: Any, operands: Any, __: Any) -> str:  # NumPy rounds integers down, XLA to zero
    return "quotient({},{})" if _is_whole(operands[0]) else "{}/{}"


@text
def rem(_: Any, operands: Any, __: Any) -> str:
    return "remainder({},{})" if _is_whole(operands[0]) else "np.fmod({},{})"


@text
def integer_pow(p: Any, _: Any, __: Any) -> str:
    short = {2: "{0}*{0}", -1: "1/{}", -2: "1/({0}*{0})"}
    return short.get(p["y"], f"integer_power({{}},{p['y']})")


@text
def round_(p: Any, _: Any, __: Any) -> str:
    even = p["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN
    return "np.rint({})" if even else "rounded({})"


@text
def convert_element_type(p: Any, operands: Any, _: Any) -> str:
    old, new = operands[0].dtype, np.dtype(p["new_dtype"])
    if old == new:
        return "{}"
    if old.kind == "c" and new.kind in "fiu":
        raise UntranslatableError("a complex number as a real one")
    whole = old.kind == "f" and new.kind in "iu"
    return f"whole({{}},'{new.str}')" if whole else f"{{}}.astype('{new.str}')"


@text
def select_n(_: Any, operands: Any, __: Any) -> str:
    if operands[0].dtype != bool:
        raise UntranslatableError("a choice of more than two")
    return "np.where({0},{2},{1})"


# --- Shapes ---------------------------------------------------------------------------------------


@text
def broadcast_in_dim(p: Any, operands: Any, results: Any) -> str:
    old, new = operands[0].shape, results[0].shape
    if math.prod(old) == math.prod(new):
        return reshape({}, operands, results)
    if old == ():
        return f"np.full({new},{{0}})"
    shape = [1] * len(new)
    for place, length in zip(p["broadcast_dimensions"], old, strict=True):
        shape[place] = length
    return f"np.broadcast_to({{0}}.reshape({shape}),{new})"


@text
def reshape(p: Any, operands: Any, results: Any) -> str:
    old, new = operands[0].shape, results[0].shape
    if p.get("dimensions") is not None:
        raise UntranslatableError("reshape of a transpose")
    if old == new:
        return "{}"
    # A scalar of NumPy takes a third of the time of an array without axes.
    return f"{{0}}.reshape({new})" if new else f"{{0}}[{','.join('0' * len(old))}]"


TEXTS["squeeze"] = TEXTS["expand_dims"] = lambda _, operands, results: reshape(
    {}, operands, results
)


@text
def transpose(p: Any, _: Any, __: Any) -> str:
    return f"{{}}.transpose({numbers(p['permutation'])})"


@text
def rev(p: Any, operands: Any, _: Any) -> str:
    axes = range(len(operands[0].shape))
    return f"{{}}[{','.join('::-1' if axis in p['dimensions'] else ':' for axis in axes)}]"


@text
def slice_(p: Any, _: Any, __: Any) -> str:
    starts, stops = p["start_indices"], p["limit_indices"]
    limits = zip(starts, stops, p["strides"] or [1] * len(starts), strict=True)
    return f"{{}}[{','.join(f'{start}:{stop}:{step}' for start, stop, step in limits)}]"


@text
def split(p: Any, _: Any, __: Any) -> str:
    stops = numbers(np.cumsum(p["sizes"]))
    starts = (0, *stops[:-1])
    axes = ":," * int(p["axis"])
    return ",".join(f"{{0}}[{axes}{a}:{b}]" for a, b in zip(starts, stops, strict=True)) + ","


@text
def unstack(p: Any, _: Any, results: Any) -> str:
    return "".join(f"{{0}}[{':,' * int(p['axis'])}{i}]," for i in range(len(results)))


@text
def concatenate(p: Any, _: Any, __: Any) -> str:
    return f"np.concatenate(({{all}},),{p['dimension']})"


@text
def stack(p: Any, _: Any, __: Any) -> str:
    return f"np.stack(({{all}},),{p['axis']})"


@text
def tile(p: Any, _: Any, __: Any) -> str:
    return f"np.tile({{}},{numbers(p['reps'])})"


@text
def pad(p: Any, _: Any, __: Any) -> str:
    return f"padded({{}},{{}},{tuple(map(numbers, p['padding_config']))})"


@text
def iota(p: Any, _: Any, results: Any) -> str:
    shape, axis = results[0].shape, p["dimension"]
    own = [-1 if place == axis else 1 for place in range(len(shape))]
    row = f"np.arange({shape[axis]}).astype('{results[0].dtype.str}')"
    return f"np.broadcast_to({row}.reshape({own}),{shape})"


@text
def empty(_: Any, __: Any, results: Any) -> str:
    return f"np.zeros({results[0].shape},'{results[0].dtype.str}')"


TEXTS["empty2"] = empty


@text
def platform_index(p: Any, _: Any, __: Any) -> str:
    own = [i for i, names in enumerate(p["platforms"]) if names is None or "cpu" in names]
    return f"np.int32({own[0]})"


# --- Reductions -----------------------------------------------------------------------------------

for _name, _function in {
    "reduce_and": "logical_and",
    "reduce_max": "maximum",
    "reduce_min": "minimum",
    "reduce_or": "logical_or",
    "reduce_prod": "multiply",
    "reduce_sum": "add",
}.items():

    def _reduced(p: Any, operands: Any, _: Any, function: str = _function) -> str:
        (of,), axes = operands, numbers(p["axes"])
        logical, extreme = "logical" in function, function in ("maximum", "minimum")
        if logical != (of.dtype == bool) or (extreme and math.prod(of.shape) == 0):
            raise UntranslatableError(f"{function} of {of.dtype}{of.shape}")
        dtype = f",dtype='{of.dtype.str}'" if _is_whole(of) else ""  # NumPy would sum in 64 bits
        return f"np.{function}.reduce({{}},axis={axes}{dtype})" if axes else "{}"

    TEXTS[_name] = _reduced

for _name in ("argmin", "argmax"):
    TEXTS[_name] = lambda p, _, results, name=_name: (
        f"np.{name}({{}},{int(p['axes'][0])}).astype('{results[0].dtype.str}')"
    )


@text
def cumsum(p: Any, operands: Any, _: Any) -> str:
    back = f"[{':,' * p['axis']}::-1]" if p["reverse"] else ""
    dtype = operands[0].dtype.str
    return f"np.add.accumulate({{}}{back},axis={p['axis']},dtype='{dtype}'){back}"


@text
def reduce_window_sum(p: Any, _: Any, __: Any) -> str:
    if any(step != 1 for name in p if "dilation" in name for step in p[name]):
        raise UntranslatableError("reduce_window_sum with a dilation")
    limits = tuple((*numbers(limit), 0) for limit in p["padding"])
    size, steps = numbers(p["window_dimensions"]), numbers(p["window_strides"])
    return f"window_sum({{}},{size},{steps},{limits})"


@text
def sort(p: Any, _: Any, __: Any) -> str:
    return f"sorted_by(({{all}},),{p['dimension']},{p['num_keys']})"


# --- Look-ups -------------------------------------------------------------------------------------


def _drops(p: Any) -> bool:
    """Whether windows outside of the array count for nothing, and are not moved into it."""
    return p["mode"] == GatherScatterMode.FILL_OR_DROP


def gathered_places(p: Any, operands: Any) -> str:
    """Text of the numbers of the elements that a `gather` takes, from its second operand."""
    of = p["dimension_numbers"]
    layout = (
        operands[0].shape,
        numbers(p["slice_sizes"]),
        numbers(of.offset_dims),
        numbers(of.collapsed_slice_dims),
        numbers(of.start_index_map),
        numbers(of.operand_batching_dims),
        numbers(of.start_indices_batching_dims),
        _drops(p),
    )
    return f"places({{}},{','.join(map(str, layout))})"


def scattered_places(p: Any, operands: Any) -> str:
    """Text of the numbers of the elements that a `scatter` sets, from its second operand."""
    of, (array, _, new) = p["dimension_numbers"], operands
    windows = iter(numbers(new.shape[axis] for axis in of.update_window_dims))
    gone = {*of.inserted_window_dims, *of.operand_batching_dims}
    layout = (
        array.shape,
        tuple(1 if axis in gone else next(windows) for axis in range(len(array.shape))),
        numbers(of.update_window_dims),
        numbers(of.inserted_window_dims),
        numbers(of.scatter_dims_to_operand_dims),
        numbers(of.operand_batching_dims),
        numbers(of.scatter_indices_batching_dims),
        _drops(p),
    )
    return f"places({{}},{','.join(map(str, layout))})"


PLACES = {
    "gather": gathered_places,
    "scatter": scattered_places,
    "scatter-add": scattered_places,
}


@text
def gather(p: Any, operands: Any, _: Any) -> str:  # its second operand is `places`
    fill, kind = p["fill_value"], operands[0].dtype.kind
    if not _drops(p):
        return "{}.take({})"
    if fill is None and kind not in "fc":
        raise UntranslatableError(f"gather that fills {operands[0].dtype}")
    return f"taken_or({{}},{{}},{'np.nan' if fill is None else fill})"


TEXTS["scatter"] = "scattered({},{},{},None)"
TEXTS["scatter-add"] = "scattered({},{},{},np.add)"


@text
def dynamic_slice(p: Any, operands: Any, _: Any) -> str:
    return f"window({operands[0].shape},{numbers(p['slice_sizes'])},{{all}})"


# --- Linear algebra -------------------------------------------------------------------------------


@text
def dot_general(p: Any, operands: Any, results: Any) -> str:
    (of_a, of_b), (batch_a, batch_b) = p["dimension_numbers"]
    (a, b), (out,) = operands, results
    if a.dtype != out.dtype or b.dtype != out.dtype:
        raise UntranslatableError("product of different types")
    if not batch_a and len(a.shape) <= 2 and len(b.shape) <= 2 and len(of_a) == 1:
        left = ".T" if len(a.shape) == 2 and of_a[0] == 0 else ""
        right = ".T" if len(b.shape) == 2 and of_b[0] == 1 else ""
        return f"{{}}{left}.dot({{}}{right})"
    rest_a = [axis for axis in range(len(a.shape)) if axis not in (*of_a, *batch_a)]
    rest_b = [axis for axis in range(len(b.shape)) if axis not in (*of_b, *batch_b)]
    batch = tuple(a.shape[axis] for axis in batch_a)
    inner = math.prod(a.shape[axis] for axis in of_a)
    rows = math.prod(a.shape[axis] for axis in rest_a)
    columns = math.prod(b.shape[axis] for axis in rest_b)
    left = f"{{}}.transpose({numbers((*batch_a, *rest_a, *of_a))})"
    right = f"{{}}.transpose({numbers((*batch_b, *of_b, *rest_b))})"
    matrices = (
        f"{left}.reshape({(*batch, rows, inner)}),{right}.reshape({(*batch, inner, columns)})"
    )
    return f"np.matmul({matrices}).reshape({out.shape})"


@text
def triangular_solve(p: Any, _: Any, __: Any) -> str:
    trans = 0 if not p["transpose_a"] else 2 if p["conjugate_a"] else 1
    sides = int(not p["left_side"]), int(p["lower"]), trans, int(p["unit_diagonal"])
    return f"triangular_solve({{}},{{}},{','.join(map(str, sides))})"


@text
def qr(p: Any, operands: Any, _: Any) -> str:
    if p.get("pivoting") or not math.prod(operands[0].shape):
        raise UntranslatableError("qr with pivots, or of an empty matrix")
    return f"np.linalg.qr({{}},'{'complete' if p['full_matrices'] else 'reduced'}')"


@text
def eigh(p: Any, operands: Any, _: Any) -> str:
    if p.get("subset_by_index") not in (None, (0, operands[0].shape[-1])):
        raise UntranslatableError("some eigenvalues")
    return f"eigh({{}},{bool(p['lower'])})"


@text
def eig(_: Any, __: Any, results: Any) -> str:
    if len(results) > 1:
        raise UntranslatableError("eigenvectors of a matrix without symmetry")
    return "eigenvalues({}),"


@text
def svd(p: Any, operands: Any, _: Any) -> str:
    if p.get("subset_by_index") is not None or not math.prod(operands[0].shape):
        raise UntranslatableError("some singular values, or those of an empty matrix")
    return f"svd({{}},{bool(p['compute_uv'])},{bool(p['full_matrices'])})"


@text
def fft(p: Any, _: Any, __: Any) -> str:
    if len(p["fft_lengths"]) != 1:
        raise UntranslatableError("fft over several axes")
    name = ("fft", "ifft", "rfft", "irfft")[int(p["fft_type"])]
    return f"np.fft.{name}({{}},{p['fft_lengths'][0]})"
