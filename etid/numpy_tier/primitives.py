"""For each primitive of JAX the function of NumPy that does the same.

`RULES` has one rule for each. It makes the function of the operands from the parameters of an
equation, the operands, and the shapes and types of the results. If the result is an operand, the
rule returns the number of this operand instead. Most rules are functions of arrays, which take the
parameters as keywords.
"""

import inspect
import itertools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy
from jax.lax import GatherScatterMode, RoundingMethod

from etid.numpy_tier import algebra
from etid.numpy_tier.source import UntranslatableError, Value

Rule = Callable[[Any, Sequence[Value], Sequence[Any]], Callable[..., Any] | int]


def always(function: Callable[..., Any]) -> Rule:
    """The rule of a primitive without parameters."""
    return lambda _, __, ___: function


def by_keywords(function: Callable[..., Any]) -> Rule:
    """The rule of a primitive whose parameters are keywords of a function.

    Other versions of JAX may have further parameters, whose meaning nobody here knows.
    """
    known = inspect.signature(function).parameters

    def rule(p: Any, _: Any, __: Any) -> Callable[..., Any]:
        if not (p.keys() <= known.keys() or "_" in known):
            raise UntranslatableError(f"parameters {sorted(p.keys() - known.keys())}")
        return partial(function, **p)

    return rule


# --- Elements -------------------------------------------------------------------------------------


def complex_of(shape: tuple[int, ...], dtype: Any, real: Any, imag: Any) -> Any:
    """Complex numbers; `real + 1j * imag` would turn infinities into NaN."""
    if not shape:
        return dtype.type(complex(real, imag))
    found = np.empty(shape, dtype)
    found.real, found.imag = real, imag
    return found


def converted(p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of numbers of another type."""
    old, new = operands[0].dtype, np.dtype(p["new_dtype"])
    if old == new:
        return 0
    if old.kind == "c" and new.kind == "f":
        return lambda of: of.real.astype(new)
    if old.kind == "c" and new.kind in "iu":
        raise UntranslatableError("a complex number as an integer")
    whole_now = old.kind == "f" and new.kind in "iu"
    return partial(whole, new) if whole_now else operator.methodcaller("astype", new)


def whole(dtype: Any, of: Any) -> Any:
    """Integers of numbers: 0 for NaN, and the nearest integer of the type for the others."""
    limits = np.iinfo(dtype)
    low, high = of <= limits.min, of >= float(limits.max)
    inside = np.where(low | high | np.isnan(of), 0, of).astype(dtype)
    return np.where(low, limits.min, np.where(high, limits.max, inside)).astype(dtype)[()]


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


def integer_pow(of: Any, y: int) -> Any:
    """Power by repeated squaring, as XLA does it."""
    if y == 2:  # by far the most frequent
        return of * of
    if y == -1:
        return 1 / of
    if y == 0:
        return np.ones_like(of)
    left, square, found = abs(y), of, 1
    while left:
        found = found * square if left & 1 else found
        left >>= 1
        square = square * square if left else square
    return found if y > 0 else 1 / found


def selected(_: Any, operands: Sequence[Value], __: Any) -> Any:
    """The rule of elements of one of several arrays."""
    which, *cases = operands
    if which.shape == () and which.constant is not None:
        return 1 + int(which.constant)
    if which.shape == () and len({case.shape for case in cases}) == 1:
        return lambda which, *cases: cases[int(which)]
    if which.dtype == bool:
        return lambda which, false, true: np.where(which, true, false)
    return lambda which, *cases: np.choose(which, cases)


OPERATORS = ("add", "eq", "ge", "gt", "le", "lt", "mul", "ne", "neg", "sub", "xor")
UFUNCS = (
    *("cbrt", "ceil", "conj", "cos", "cosh", "exp", "exp2", "expm1", "floor", "log", "log1p"),
    *("sign", "sin", "sinh", "sqrt", "square", "tan", "tanh"),
)
INVERSE = ("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh")
FUNCTIONS: dict[str, Callable[..., Any]] = {
    # With scalars, operators take a fraction of the time of NumPy's functions.
    **{name: getattr(operator, name) for name in OPERATORS},
    **{name: getattr(np, name) for name in UFUNCS},
    **{name: getattr(np, f"arc{name[1:]}") for name in INVERSE},
    "abs": abs,
    "add_any": operator.add,
    "and": operator.and_,
    "clamp": lambda low, of, high: np.minimum(np.maximum(of, low), high),
    # `scipy.special` is loaded when one of them is used.
    "erf": lambda of: scipy.special.erf(of),
    "erfc": lambda of: scipy.special.erfc(of),
    "imag": operator.attrgetter("imag"),
    "is_finite": np.isfinite,
    "logistic": lambda of: scipy.special.expit(of),
    "max": np.maximum,
    "min": np.minimum,
    "not": operator.invert,
    "or": operator.or_,
    "real": operator.attrgetter("real"),
}
# Their operands may be arrays that NumPy broadcasts.
ELEMENTWISE: dict[str, Rule] = {
    **{name: always(function) for name, function in FUNCTIONS.items()},
    "complex": lambda _, __, out: partial(complex_of, out[0].shape, out[0].dtype),
    "convert_element_type": converted,
    "div": lambda _, __, out: quotient if out[0].dtype.kind in "iu" else operator.truediv,
    "integer_pow": by_keywords(integer_pow),
    "pow": lambda _, __, out: partial(np.power, dtype=out[0].dtype),
    "rem": lambda _, __, out: remainder if out[0].dtype.kind in "iu" else np.fmod,
    "round": lambda p, _, __: (
        np.rint if p["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN else rounded
    ),
    "select_n": selected,
}

# --- Shapes ---------------------------------------------------------------------------------------


def filled(of: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    """An array that holds another one again and again."""
    found = np.empty(shape, dtype)
    found[...] = of
    return found


def slices(p: Any, _: Any, __: Any) -> Any:
    """The rule of every n-th element between two places."""
    strides = p["strides"] or [1] * len(p["start_indices"])
    limits = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return operator.itemgetter(tuple(slice(*limit) for limit in limits))


def parts(axis: int, places: Sequence[Any]) -> Any:
    """The function that takes the elements at each of several places of an axis."""
    get = operator.itemgetter(*[(*[slice(None)] * axis, place) for place in places])
    return get if len(places) > 1 else lambda of: [get(of)]


def split(p: Any, _: Any, __: Any) -> Any:
    """The rule of parts of an array along an axis."""
    stops = np.cumsum(p["sizes"]).tolist()
    return parts(p["axis"], [slice(*limits) for limits in itertools.pairwise([0, *stops])])


def stack(*of: Any, axis: int) -> Any:
    """Arrays along a new axis; `np.stack` takes three times as long."""
    found = np.array(of)
    return np.moveaxis(found, 0, axis) if axis else found


def pad(lengths: Sequence[int], limits: Sequence[Sequence[Any]]) -> Callable[[Any, Any], Any]:
    """The function that puts elements before, after and between those of each axis of an array.

    Fewer than none before or after it: some are cut off.
    """
    shape, inside, kept = [], [], []
    for length, (low, high, between) in zip(lengths, limits, strict=True):
        stop = max(low, 0) + max(length + (length - 1) * between, 0)
        shape.append(stop + max(high, 0))
        inside.append(slice(max(low, 0), stop, between + 1))
        kept.append(slice(max(-low, 0), shape[-1] - max(-high, 0)))
    places, cut = tuple(inside), tuple(kept)

    def padded(of: Any, fill: Any) -> Any:
        found = np.empty(shape, of.dtype)
        found.fill(fill)  # `np.full` takes three times as long
        found[places] = of
        return found[cut]

    return padded


# --- Reductions and orders ------------------------------------------------------------------------


def reduction(function: Any, p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of sums and the like."""
    (of,), axes, options = operands, p["axes"], {}
    if of.dtype.kind in "iu":  # NumPy would sum in 64 bits
        options["dtype"] = of.dtype
    if 0 in of.shape and function in (np.maximum, np.minimum):
        if of.dtype.kind != "f":
            raise UntranslatableError(f"a maximum of no {of.dtype}")
        options["initial"] = -np.inf if function is np.maximum else np.inf
    return partial(function.reduce, axis=axes, **options) if axes else 0


def running_sum(of: Any, axis: int, reverse: bool) -> Any:
    """Sums of all elements up to each."""
    order = (*[slice(None)] * axis, slice(None, None, -1 if reverse else 1))
    return np.cumsum(of[order], axis, of.dtype)[order]


def window_sum(p: Any, operands: Sequence[Value], _: Any) -> Any:
    """The rule of sums over windows that move over an array with zeros around it."""
    if any(step != 1 for name in p if "dilation" in name for step in p[name]):
        raise UntranslatableError("windows with gaps")
    (of,) = operands
    around = pad(of.shape, [(low, high, 0) for low, high in p["padding"]])
    steps = tuple(slice(None, None, step) for step in p["window_strides"])
    windows = partial(np.lib.stride_tricks.sliding_window_view, window_shape=p["window_dimensions"])
    axes = tuple(range(len(of.shape), 2 * len(of.shape)))
    return lambda of: windows(around(of, 0))[steps].sum(axes, of.dtype)


def sort(*of: Any, dimension: int, num_keys: int, **_: Any) -> list[Any]:
    """Arrays in the order of the first ones of them; NaN come last."""
    order = np.lexsort(of[num_keys - 1 :: -1], dimension)
    return [np.take_along_axis(one, order, dimension) for one in of]


# --- Elements at computed places ------------------------------------------------------------------


def places(p: Any, of: Value, at: Value, result: tuple[int, ...]) -> Callable[[Any], Any]:
    """The function from coordinates `at`, where windows begin, to the numbers of their elements.

    These count as in `array.ravel()`, and have axes of `at` and axes of the windows. A window that
    leaves the array gets -1, or is moved into it. What is constant is computed here.
    """
    window_axes, gone, start_axes, batch, batch_of_at = p["dimension_numbers"]
    grid, windows, drops = np.indices(result, sparse=True), iter(window_axes), _drops(p)
    outer = [one for axis, one in enumerate(grid) if axis not in window_axes]
    within: list[tuple[int, Any]] = []  # length of the window, and place in it, for each axis
    for axis in range(len(of.shape)):
        if axis in batch:
            within.append((1, outer[batch_of_at[batch.index(axis)]]))
        else:
            own = None if axis in gone else next(windows)
            within.append((1, 0) if own is None else (result[own], grid[own]))

    def find(at: Any) -> Any:
        found, outside = np.zeros(result, np.int64), np.False_
        for axis, (length, (size, place)) in enumerate(zip(of.shape, within, strict=True)):
            found = found * length + place
            if axis in start_axes:
                start = at[(*outer, start_axes.index(axis))].astype(np.int64)
                found = found + np.clip(start, 0, max(length - size, 0))
                outside = outside | (start < 0) | (start > length - size)
        return np.where(outside, -1, found) if drops else found

    if at.constant is None:
        return find
    found = find(at.constant)
    return lambda _: found


def _drops(p: Any) -> bool:
    return p["mode"] == GatherScatterMode.FILL_OR_DROP


def gather(p: Any, operands: Sequence[Value], results: Sequence[Any]) -> Any:
    """The rule of elements in windows."""
    of, at = operands
    find = places(p, of, at, results[0].shape)
    if not _drops(p):
        return lambda of, at: of.take(find(at))
    last = of.dtype.type(p["fill_value"])  # element -1
    return lambda of, at: np.append(of, last).take(find(at))


def scatter(p: Any, operands: Sequence[Value], _: Any, function: Any = None) -> Any:
    """The rule of new elements in windows, which a function joins with the old ones."""
    of, at, new = operands
    find, shape = places(p, of, at, new.shape), of.shape

    def scattered(of: Any, at: Any, new: Any) -> Any:
        found = np.append(of, of.dtype.type(0))  # element -1, which is cut off
        if function is None:
            found[find(at)] = new
        else:
            function.at(found, find(at), new)
        return found[:-1].reshape(shape)

    return scattered


def window(of: Any, sizes: Sequence[int], starts: Sequence[Any]) -> tuple[slice, ...]:
    """The window of an array that begins at some place, moved into the array if it leaves it."""
    limits = zip(starts, sizes, of.shape, strict=True)
    firsts = [(min(max(int(start), 0), length - size), size) for start, size, length in limits]
    return tuple(slice(first, first + size) for first, size in firsts)


def dynamic_update_slice(of: Any, new: Any, *starts: Any) -> Any:
    """An array with new elements in a window."""
    found = of.copy()
    found[window(of, new.shape, starts)] = new
    return found


# --- All of them ----------------------------------------------------------------------------------

RULES: dict[str, Rule] = {
    **ELEMENTWISE,
    "argmax": by_keywords(lambda of, axes, index_dtype: of.argmax(axes[0]).astype(index_dtype)),
    "argmin": by_keywords(lambda of, axes, index_dtype: of.argmin(axes[0]).astype(index_dtype)),
    "cholesky": always(algebra.cholesky),
    "concatenate": by_keywords(lambda *of, dimension: np.concatenate(of, dimension)),
    "cumsum": by_keywords(running_sum),
    "dot_general": algebra.product,
    "dynamic_slice": by_keywords(
        lambda of, *starts, slice_sizes: of[window(of, slice_sizes, starts)]
    ),
    "dynamic_update_slice": always(dynamic_update_slice),
    "eig": algebra.eig,
    "eigh": algebra.eigh,
    "empty2": lambda _, __, out: lambda *_: np.zeros(out[0].shape, out[0].dtype),
    "fft": algebra.fft,
    "gather": gather,
    "iota": lambda p, _, out: lambda *_: np.indices(out[0].shape, out[0].dtype)[p["dimension"]],
    "lu": always(algebra.lu),
    "pad": lambda p, operands, _: pad(operands[0].shape, p["padding_config"]),
    "platform_index": by_keywords(
        lambda platforms: np.int32([not names or "cpu" in names for names in platforms].index(True))
    ),
    "qr": algebra.qr,
    "reduce_and": partial(reduction, np.bitwise_and),
    "reduce_max": partial(reduction, np.maximum),
    "reduce_min": partial(reduction, np.minimum),
    "reduce_or": partial(reduction, np.bitwise_or),
    "reduce_prod": partial(reduction, np.multiply),
    "reduce_sum": partial(reduction, np.add),
    "reduce_window_sum": window_sum,
    "rev": by_keywords(lambda of, dimensions: np.flip(of, dimensions)),
    "scatter": scatter,
    "scatter_add": partial(scatter, function=np.add),
    "slice": slices,
    "sort": by_keywords(sort),
    "split": split,
    "stack": by_keywords(stack),
    "svd": algebra.svd,
    "tile": by_keywords(lambda of, reps: np.tile(of, reps)),
    "transpose": by_keywords(lambda of, permutation: of.transpose(permutation)),
    "triangular_solve": by_keywords(algebra.triangular_solve),
    "unstack": lambda p, _, out: parts(p["axis"], range(len(out))),
}
