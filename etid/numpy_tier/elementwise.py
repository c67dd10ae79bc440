"""Rules of primitives that act on each element alone; their operands need not be broadcast."""

from typing import Any

import jax
import numpy as np
from jax.lax import RoundingMethod

from etid.numpy_tier.translator import Equation, Translator, UntranslatableError, Value, rule

EXPRESSIONS = {
    "abs": "np.absolute({})",
    "acos": "np.arccos({})",
    "add": "{}+{}",
    "add_any": "{}+{}",
    "and": "{}&{}",
    "asin": "np.arcsin({})",
    "atan": "np.arctan({})",
    "atan2": "np.arctan2({},{})",
    "ceil": "np.ceil({})",
    "clamp": "np.minimum(np.maximum({1},{0}),{2})",
    "conj": "np.conj({})",
    "cos": "np.cos({})",
    "cosh": "np.cosh({})",
    "eq": "{}=={}",
    "exp": "np.exp({})",
    "exp2": "np.exp2({})",
    "expm1": "np.expm1({})",
    "floor": "np.floor({})",
    "ge": "{}>={}",
    "gt": "{}>{}",
    "is_finite": "np.isfinite({})",
    "le": "{}<={}",
    "log": "np.log({})",
    "log1p": "np.log1p({})",
    "lt": "{}<{}",
    "max": "np.maximum({},{})",
    "min": "np.minimum({},{})",
    "mul": "{}*{}",
    "ne": "{}!={}",
    "neg": "-{}",
    "not": "~{}",
    "or": "{}|{}",
    "pow": "np.power({},{})",
    "sign": "np.sign({})",
    "sin": "np.sin({})",
    "sinh": "np.sinh({})",
    "sqrt": "np.sqrt({})",
    "square": "np.square({})",
    "sub": "{}-{}",
    "tan": "np.tan({})",
    "tanh": "np.tanh({})",
    "xor": "{}^{}",
}
SAME = ("copy", "copy_p", "optimization_barrier", "reduce_precision", "stop_gradient")


def emitted(t: Translator, text: str, aval: Any, *operands: Value) -> Value:
    """The value of an expression in which `{}` are the operands."""
    shape = np.broadcast_shapes(*[of.shape for of in operands])
    text = text.format(*[of.name for of in operands])
    (found,) = t.emit(text, operands, jax.ShapeDtypeStruct(shape, aval.dtype))
    return found


@rule(*EXPRESSIONS, broadcast=False)
def _expression(t: Translator, equation: Equation, *operands: Value) -> Value:
    name, aval = equation.primitive.name, equation.outvars[0].aval
    return emitted(t, EXPRESSIONS[name], aval, *operands)


@rule(*SAME, broadcast=False)
def _same(t: Translator, equation: Equation, *operands: Value) -> tuple[Value, ...]:
    return operands


@rule("div", "rem", broadcast=False)
def _quotient(t: Translator, equation: Equation, *operands: Value) -> Value:
    name, aval = equation.primitive.name, equation.outvars[0].aval
    if aval.dtype.kind in "iu":  # NumPy rounds down, XLA to zero
        text = "remainder({},{})" if name == "rem" else "quotient({},{})"
    else:
        text = "np.fmod({},{})" if name == "rem" else "{}/{}"
    return emitted(t, text, aval, *operands)


@rule("integer_pow", broadcast=False)
def _power(t: Translator, equation: Equation, of: Value) -> Value:
    power = equation.params["y"]
    short = {2: "{0}*{0}", -1: "1/{}", -2: "1/({0}*{0})"}
    text = short.get(power, f"integer_power({{}},{power})")
    return emitted(t, text, equation.outvars[0].aval, of)


@rule("round", broadcast=False)
def _round(t: Translator, equation: Equation, of: Value) -> Value:
    even = equation.params["rounding_method"] == RoundingMethod.TO_NEAREST_EVEN
    return emitted(t, "np.rint({})" if even else "rounded({})", equation.outvars[0].aval, of)


@rule("complex", broadcast=False)
def _complex(t: Translator, equation: Equation, real: Value, imag: Value) -> Value:
    aval = equation.outvars[0].aval
    shape = np.broadcast_shapes(real.shape, imag.shape)
    text = f"complex_of({{}},{{}},{shape},'{aval.dtype.str}')" if shape else "complex_number({},{})"
    return emitted(t, text, aval, real, imag)


@rule("real", "imag", broadcast=False)
def _part(t: Translator, equation: Equation, of: Value) -> Value:
    name = equation.primitive.name
    return emitted(t, f"{{}}.{name}", equation.outvars[0].aval, of)


@rule("convert_element_type", broadcast=False)
def _convert(t: Translator, equation: Equation, of: Value) -> Value:
    new = np.dtype(equation.params["new_dtype"])
    if of.dtype == new:
        return of
    if of.dtype.kind == "c" and new.kind in "fiu":
        raise UntranslatableError("a complex number as a real one")
    whole = of.dtype.kind == "f" and new.kind in "iu"
    text = f"whole({{}},'{new.str}')" if whole else f"{{}}.astype('{new.str}')"
    return emitted(t, text, equation.outvars[0].aval, of)


@rule("select_n", broadcast=False)
def _select(t: Translator, equation: Equation, which: Value, *cases: Value) -> Value:
    aval = equation.outvars[0].aval
    if which.dtype != bool:
        return emitted(t, f"np.choose({{}},({'{},' * len(cases)}))", aval, which, *cases)
    false, true = cases
    if which.constant is not None and which.shape == ():
        return true if which.constant else false
    return emitted(t, "np.where({},{},{})", aval, which, true, false)
