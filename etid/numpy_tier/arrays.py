"""Rules of primitives that arrange, reduce, sort or look up elements."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax.lax import GatherScatterMode

from etid.numpy_tier.translator import Equation, Translator, UntranslatableError, Value, rule

REDUCTIONS = {
    "reduce_and": "logical_and",
    "reduce_max": "maximum",
    "reduce_min": "minimum",
    "reduce_or": "logical_or",
    "reduce_prod": "multiply",
    "reduce_sum": "add",
}
RUNNING = {"cummax": "maximum", "cummin": "minimum", "cumprod": "multiply", "cumsum": "add"}


def _numbers(of: Iterable[Any]) -> tuple[int, ...]:
    return tuple(int(one) for one in of)


def _one(t: Translator, text: str, equation: Equation, *operands: Value) -> Value:
    """The value of an expression of the first result's shape."""
    (found,) = t.emit(text, operands, equation.outvars[0].aval)
    return found


# --- Shapes ---------------------------------------------------------------------------------------


@rule("broadcast_in_dim", broadcast=False)
def _broadcast(t: Translator, equation: Equation, of: Value, *_: Value) -> Value:
    places = equation.params["broadcast_dimensions"]
    own = (1,) * (len(places) - len(of.shape)) + of.shape
    shape = [1] * len(equation.params["shape"])
    for place, length in zip(places, own, strict=True):
        shape[place] = length
    return _reshaped(t, of, shape)


def _reshaped(t: Translator, of: Value, shape: Sequence[int]) -> Value:
    """The same elements with another shape; leading axes of length 1 need not be there."""
    shape = list(shape)
    while shape and shape[0] == 1:
        shape.pop(0)
    if of.shape == tuple(shape) or of.shape == ():
        return of
    if not shape:
        text = f"{of.name}[{','.join('0' * len(of.shape))}]"
        return t.emit(text, [of], jax.ShapeDtypeStruct((), of.dtype))[0]
    text = f"{of.name}.reshape({tuple(shape)})"
    return t.emit(text, [of], jax.ShapeDtypeStruct(shape, of.dtype))[0]


@rule("reshape", "squeeze", "expand_dims", broadcast=False)
def _reshape(t: Translator, equation: Equation, of: Value, *_: Value) -> Value:
    if equation.params.get("dimensions") is not None and equation.primitive.name == "reshape":
        raise UntranslatableError("reshape of a transpose")
    shape = equation.outvars[0].aval.shape
    if of.shape and math.prod(of.shape) != math.prod(shape):
        of = t.full(of, equation.invars[0].aval.shape)
    return _reshaped(t, of, shape)


@rule("transpose")
def _transpose(t: Translator, equation: Equation, of: Value) -> Value:
    return _one(t, f"{of.name}.transpose({_numbers(equation.params['permutation'])})", equation, of)


@rule("rev")
def _reverse(t: Translator, equation: Equation, of: Value) -> Value:
    axes = equation.params["dimensions"]
    places = ",".join("::-1" if axis in axes else ":" for axis in range(len(of.shape)))
    return _one(t, f"{of.name}[{places}]", equation, of)


@rule("slice")
def _slice(t: Translator, equation: Equation, of: Value) -> Value:
    params = equation.params
    starts, stops = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or [1] * len(of.shape)
    limits = zip(starts, stops, strides, strict=True)
    places = ",".join(f"{start}:{stop}:{step}" for start, stop, step in limits)
    return _one(t, f"{of.name}[{places}]", equation, of)


@rule("split")
def _split(t: Translator, equation: Equation, of: Value) -> list[Value]:
    before, parts = ":," * equation.params["axis"], []
    stops = np.cumsum(equation.params["sizes"])
    for var, size, stop in zip(equation.outvars, equation.params["sizes"], stops, strict=True):
        parts += t.emit(f"{of.name}[{before}{stop - size}:{stop}]", [of], var.aval)
    return parts


@rule("unstack")
def _unstack(t: Translator, equation: Equation, of: Value) -> list[Value]:
    before, parts = ":," * equation.params["axis"], []
    for number, var in enumerate(equation.outvars):
        parts += t.emit(f"{of.name}[{before}{number}]", [of], var.aval)
    return parts


@rule("concatenate")
def _concatenate(t: Translator, equation: Equation, *parts: Value) -> Value:
    if len(parts) == 1:
        return parts[0]
    names = ",".join(of.name for of in parts)
    return _one(t, f"np.concatenate(({names}),{equation.params['dimension']})", equation, *parts)


@rule("stack")
def _stack(t: Translator, equation: Equation, *parts: Value) -> Value:
    if len(parts) == 1:
        return _reshaped(t, parts[0], equation.outvars[0].aval.shape)
    names = "".join(f"{of.name}," for of in parts)
    return _one(t, f"np.stack(({names}),{equation.params['axis']})", equation, *parts)


@rule("tile")
def _tile(t: Translator, equation: Equation, of: Value) -> Value:
    return _one(t, f"np.tile({of.name},{_numbers(equation.params['reps'])})", equation, of)


@rule("pad")
def _pad(t: Translator, equation: Equation, of: Value, fill: Value) -> Value:
    limits = tuple(_numbers(limit) for limit in equation.params["padding_config"])
    return _one(t, f"padded({of.name},{fill.name},{limits})", equation, of, fill)


@rule("iota")
def _iota(t: Translator, equation: Equation, *_: Value) -> Value:
    aval, axis = equation.outvars[0].aval, equation.params["dimension"]
    numbers = np.arange(aval.shape[axis]).astype(aval.dtype)
    return t.constant(numbers.reshape(-1, *[1] * (len(aval.shape) - axis - 1)))


@rule("empty", "empty2")
def _empty(t: Translator, equation: Equation, *_: Value) -> Value:
    return t.constant(np.zeros((), equation.outvars[0].aval.dtype))


@rule("platform_index")
def _platform(t: Translator, equation: Equation) -> Value:
    platforms = equation.params["platforms"]
    own = [i for i, names in enumerate(platforms) if names is None or "cpu" in names]
    return t.constant(np.int32(own[0]))


# --- Reductions -----------------------------------------------------------------------------------


@rule(*REDUCTIONS)
def _reduce(t: Translator, equation: Equation, of: Value) -> Value:
    name, axes = equation.primitive.name, _numbers(equation.params["axes"])
    if not axes:
        return of
    if name in ("reduce_and", "reduce_or") and of.dtype != bool:
        raise UntranslatableError(f"{name} of {of.dtype}")
    options = "" if axes == tuple(range(len(of.shape))) == (0,) else f",axis={axes}"
    if of.dtype.kind in "iu":  # NumPy would sum in 64 bits
        options += f",dtype='{of.dtype.str}'"
    if name in ("reduce_max", "reduce_min") and math.prod(of.shape) == 0:
        if of.dtype.kind != "f":
            raise UntranslatableError(f"{name} of no {of.dtype}")
        options += f",initial={'-' if name == 'reduce_max' else ''}np.inf"
    return _one(t, f"np.{REDUCTIONS[name]}.reduce({of.name}{options})", equation, of)


@rule("argmin", "argmax")
def _place(t: Translator, equation: Equation, of: Value) -> Value:
    (axis,), aval = equation.params["axes"], equation.outvars[0].aval
    text = f"np.{equation.primitive.name}({of.name},{axis}).astype('{aval.dtype.str}')"
    return _one(t, text, equation, of)


@rule(*RUNNING)
def _running(t: Translator, equation: Equation, of: Value) -> Value:
    axis = equation.params["axis"]
    back = f"[{':,' * axis}::-1]" if equation.params["reverse"] else ""
    name = f"np.{RUNNING[equation.primitive.name]}.accumulate"
    text = f"{name}({of.name}{back},axis={axis},dtype='{of.dtype.str}'){back}"
    return _one(t, text, equation, of)


@rule("reduce_window_sum")
def _window_sum(t: Translator, equation: Equation, of: Value) -> Value:
    params = equation.params
    if any(step != 1 for name in params if "dilation" in name for step in params[name]):
        raise UntranslatableError("reduce_window_sum with a dilation")
    size, steps = _numbers(params["window_dimensions"]), _numbers(params["window_strides"])
    limits = tuple((*_numbers(limit), 0) for limit in params["padding"])
    return _one(t, f"window_sum({of.name},{size},{steps},{limits})", equation, of)


@rule("sort")
def _sort(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    names = "".join(f"{of.name}," for of in operands)
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    avals = [var.aval for var in equation.outvars]
    only = "[0]" if len(avals) == 1 else ""
    return t.emit(f"sorted_by(({names}),{axis},{keys}){only}", operands, *avals)


# --- Look-ups -------------------------------------------------------------------------------------


def _outside(mode: GatherScatterMode) -> bool:
    """Whether windows outside of the array count for nothing, and are not moved into it."""
    return mode == GatherScatterMode.FILL_OR_DROP


@rule("gather")
def _gather(t: Translator, equation: Equation, of: Value, at: Value) -> Value:
    params, aval = equation.params, equation.outvars[0].aval
    numbers = params["dimension_numbers"]
    drop = _outside(params["mode"])
    layout = (
        of.shape,
        _numbers(params["slice_sizes"]),
        _numbers(numbers.offset_dims),
        _numbers(numbers.collapsed_slice_dims),
        _numbers(numbers.start_index_map),
        _numbers(numbers.operand_batching_dims),
        _numbers(numbers.start_indices_batching_dims),
        drop,
    )
    text = f"places({at.name},{','.join(map(str, layout))})"
    (flat,) = t.emit(text, [at], jax.ShapeDtypeStruct(aval.shape, np.int64))
    if not drop or (flat.constant is not None and np.all(flat.constant >= 0)):
        return _one(t, f"{of.name}.take({flat.name})", equation, of, flat)
    fill = params["fill_value"]
    if fill is None and of.dtype.kind not in "fc":
        raise UntranslatableError(f"gather that fills {of.dtype}")
    other = t.constant(np.asarray(np.nan if fill is None else fill, of.dtype))
    return _one(t, f"taken_or({of.name},{flat.name},{other.name})", equation, of, flat, other)


@rule("scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul")
def _scatter(t: Translator, equation: Equation, of: Value, at: Value, new: Value) -> Value:
    params, numbers = equation.params, equation.params["dimension_numbers"]
    windows = iter(_numbers(new.shape[axis] for axis in numbers.update_window_dims))
    gone = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    layout = (
        of.shape,
        tuple(1 if axis in gone else next(windows) for axis in range(len(of.shape))),
        _numbers(numbers.update_window_dims),
        _numbers(numbers.inserted_window_dims),
        _numbers(numbers.scatter_dims_to_operand_dims),
        _numbers(numbers.operand_batching_dims),
        _numbers(numbers.scatter_indices_batching_dims),
        _outside(params["mode"]),
    )
    text = f"places({at.name},{','.join(map(str, layout))})"
    (flat,) = t.emit(text, [at], jax.ShapeDtypeStruct(new.shape, np.int64))
    name = equation.primitive.name
    how = "np.add" if "add" in name else "np.multiply" if "mul" in name else None
    return _one(t, f"scattered({of.name},{flat.name},{new.name},{how})", equation, of, flat, new)


@rule("dynamic_slice")
def _dynamic_slice(t: Translator, equation: Equation, of: Value, *starts: Value) -> Value:
    names = "".join(f"{start.name}," for start in starts)
    sizes = _numbers(equation.params["slice_sizes"])
    text = f"{of.name}[window({of.shape},({names}),{sizes})]"
    return _one(t, text, equation, of, *starts)


@rule("dynamic_update_slice")
def _update(t: Translator, equation: Equation, of: Value, new: Value, *starts: Value) -> Value:
    names = "".join(f"{start.name}," for start in starts)
    text = f"updated({of.name},{new.name},window({of.shape},({names}),{new.shape}))"
    return _one(t, text, equation, of, new, *starts)
