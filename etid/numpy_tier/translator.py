"""From the equations of a jaxpr to statements of NumPy.

Each equation becomes one call of a function, which `primitives` gives. Programs inside of programs
are inlined, constants folded, equal statements merged, and what does not change is moved out of
loops. Loops and branches are calls too: of a Python loop that calls functions of the text.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import ShapeDtypeStruct
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from etid.numpy_tier.algebra import one_thread
from etid.numpy_tier.primitives import ELEMENTWISE, RULES, filled
from etid.numpy_tier.source import (
    Body,
    Statement,
    UntranslatableError,
    Value,
    branch,
    repeat,
    repeat_lanes,
    scan,
)

Equation = Any  # a `JaxprEqn`, whose values are arrays
broadcast_shapes = functools.cache(np.broadcast_shapes)


class Aval(NamedTuple):
    """Shape and type of an array."""

    shape: tuple[int, ...]
    dtype: Any


def translated(program: ClosedJaxpr) -> Callable[[Sequence[Any]], list[Any]]:
    """The function that a jaxpr computes, from its operands to its results.

    The results have the shapes and the types that the jaxpr states, and equal those of XLA but for
    rounding. Ctrl-C ends the function at once.

    Raises:
        UntranslatableError: The program has a primitive without a rule.
    """
    text, names = written(program)
    exec(compile(text, "<a jaxpr in NumPy>", "exec"), names)

    def run(operands: Sequence[Any]) -> list[Any]:
        # A scalar of NumPy takes a third of the time of an array without axes.
        own = [of if of.ndim else of[()] for of in map(np.asarray, operands)]
        with np.errstate(all="ignore"), one_thread():
            return names["program"](*own)

    return run


def written(program: ClosedJaxpr) -> tuple[str, dict[str, Any]]:
    """Text of a function `program`, and what its names mean; errors as in `translated`."""
    translator = Translator()
    lines, used = translator.nested(program, [], program.in_avals).lines()
    return "\n".join(lines), {name: translator.names[name] for name in used}


class Translator:
    """Statements of one program."""

    def __init__(self) -> None:
        self.bodies: list[Body] = []  # functions of the text around the present place
        self.names: dict[str, Any] = {}  # meaning of the names that are no variables
        self._count = itertools.count(1)
        self._constants: dict[Any, Value] = {}  # equal ones are one
        self._implementations: dict[Any, ClosedJaxpr] = {}
        self._inside: set[Any] = set()  # primitives whose implementation is being translated

    # --- Values -----------------------------------------------------------------------------------

    def variable(self, aval: Any, depth: int) -> Value:
        """A new variable of some shape and type."""
        if not isinstance(aval.dtype, np.dtype):
            raise UntranslatableError(f"type {aval.dtype}")
        return Value(f"v{next(self._count)}", tuple(aval.shape), aval.dtype, depth)

    def constant(self, of: Any) -> Value:
        """The value of a constant array."""
        array = np.asarray(of)
        key = array.dtype, array.shape, array.tobytes()
        if key not in self._constants:
            name = f"c{next(self._count)}"
            self.names[name] = array if array.ndim else array[()]
            self._constants[key] = Value(name, array.shape, array.dtype, -1, self.names[name])
        return self._constants[key]

    def call(
        self,
        key: tuple[Any, ...],
        function: Callable[..., Any],
        operands: Sequence[Value],
        avals: Iterable[Any],
        several: bool = False,
        bodies: Sequence[Body] = (),
    ) -> Sequence[Value]:
        """Results of a function of bodies and operands: a sequence of `several`, or a single one.

        They are computed at once if all is constant, or else by a statement, which stands outside
        of the loops that do not change its operands. Equal keys mean equal functions.
        """
        key = (*key, *(of.name for of in [*bodies, *operands]))
        for body in self.bodies:
            if key in body.known:
                return body.known[key]
        # Bodies may use anything that is here.
        depth = self.bodies[-1].depth if bodies else max((of.depth for of in operands), default=-1)
        place = [body for body in self.bodies if body.depth <= max(depth, 0)][-1]
        if depth < 0:
            with np.errstate(all="ignore"):
                found = function(*[of.constant for of in operands])
            results = [self.constant(one) for one in (found if several else [found])]
        else:
            name = f"{key[0]}{next(self._count)}"
            self.names[name] = function
            results = [self.variable(aval, depth) for aval in avals]
            place.statements.append(Statement(results, name, operands, several, bodies))
        place.known[key] = results
        return results

    def reshaped(self, of: Value, shape: Sequence[int]) -> Value:
        """The same elements with another shape."""
        shape = tuple(shape)
        if of.shape == shape:
            return of
        only = operator.itemgetter((0,) * len(of.shape))  # a scalar, not an array without axes
        act = operator.methodcaller("reshape", shape) if shape else only
        return self.call(("reshape", shape), act, [of], [Aval(shape, of.dtype)])[0]

    def full(self, of: Value, shape: Sequence[int]) -> Value:
        """The value as an array with all its elements."""
        shape = tuple(shape)
        if math.prod(of.shape) == math.prod(shape):
            return self.reshaped(of, shape)
        act = partial(filled, shape=shape, dtype=of.dtype)
        return self.call(("full", shape), act, [of], [Aval(shape, of.dtype)])[0]

    def all_full(self, values: Iterable[Value], avals: Iterable[Any]) -> list[Value]:
        """`full` for several values."""
        return [self.full(of, aval.shape) for of, aval in zip(values, avals, strict=True)]

    # --- Equations --------------------------------------------------------------------------------

    def inline(self, of: ClosedJaxpr, operands: Sequence[Value]) -> list[Value]:
        """Results of a program that is part of this one."""
        jaxpr: Jaxpr = of.jaxpr
        values: dict[Any, Value] = dict(zip(jaxpr.invars, operands, strict=True))
        values |= zip(jaxpr.constvars, map(self.constant, of.consts), strict=True)

        def read(var: Any) -> Value:
            if isinstance(var, Literal):
                aval: Any = var.aval
                return self.constant(np.asarray(var.val, aval.dtype))
            return values[var]

        for equation in jaxpr.eqns:
            try:
                found = self.equation(equation, [read(var) for var in equation.invars])
            except KeyError as error:  # a version of JAX that names a parameter in another way
                raise UntranslatableError(f"{equation.primitive}, without {error}") from error
            values |= zip(equation.outvars, found, strict=True)
        return [read(var) for var in jaxpr.outvars]

    def equation(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of an equation, or an error if it has no rule."""
        name, params = equation.primitive.name.replace("-", "_"), equation.params
        if name in SPECIAL:
            return SPECIAL[name](self, equation, operands)
        if name not in RULES:
            return self.implementation(equation, operands)
        avals = [var.aval for var in equation.outvars]
        if name in ELEMENTWISE:
            shape = broadcast_shapes(*[of.shape for of in operands])
            avals = [Aval(shape, aval.dtype) for aval in avals]
        else:
            operands = self.all_full(operands, (var.aval for var in equation.invars))
        function = RULES[name](params, operands, avals)
        if isinstance(function, int):  # the result is an operand
            return [operands[function]]
        several = equation.primitive.multiple_results
        return self.call((name, *params.items()), function, operands, avals, several)

    def implementation(self, equation: Equation, operands: Sequence[Value]) -> list[Value]:
        """Results of a primitive of another package: its implementation is made of JAX's own."""
        primitive, params = equation.primitive, equation.params
        avals: list[Any] = [var.aval for var in (*equation.invars, *equation.outvars)]
        own_type = not all(isinstance(aval.dtype, np.dtype) for aval in avals)
        if own_type or primitive in self._inside:  # a key, or a primitive that is made of itself
            raise UntranslatableError(primitive.name)
        shapes = [ShapeDtypeStruct(of.shape, of.dtype) for of in avals[: len(operands)]]
        key = primitive, str(params), str(shapes)
        if key not in self._implementations:
            try:
                traced = jax.make_jaxpr(partial(primitive.impl, **params))(*shapes)
            except (NotImplementedError, TypeError) as error:
                raise UntranslatableError(primitive.name) from error
            self._implementations[key] = traced
        self._inside.add(primitive)
        found = self.inline(self._implementations[key], operands)
        self._inside.remove(primitive)
        return found

    def broadcast(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """An array whose elements NumPy repeats when they meet others."""
        (of, *_), shape = operands, [1] * len(equation.params["shape"])
        axes = equation.params["broadcast_dimensions"]
        for axis, length in zip(axes[len(axes) - len(of.shape) :], of.shape, strict=True):
            shape[axis] = length
        while shape and shape[0] == 1:  # NumPy adds such axes by itself
            shape.pop(0)
        return [self.reshaped(of, shape)]

    def reshape(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """All elements with another shape."""
        of, old, new = operands[0], equation.invars[0].aval, equation.outvars[0].aval
        if equation.primitive.name == "reshape" and equation.params["dimensions"] is not None:
            raise UntranslatableError("reshape of a transpose")
        return [of if of.shape == () else self.reshaped(self.full(of, old.shape), new.shape)]

    # --- Programs in programs ---------------------------------------------------------------------

    def inlined(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of another program."""
        names = ("jaxpr", "call_jaxpr", "fun_jaxpr")
        inner = next(equation.params[name] for name in names if name in equation.params)
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return self.inline(closed, operands)

    def solve(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of the program that solves linear equations."""
        lengths, programs = equation.params["const_lengths"], equation.params["jaxprs"]
        first = lengths.matvec + lengths.vecmat
        own = operands[first : first + lengths.solve]
        return self.inline(programs.solve, [*own, *operands[sum(lengths) :]])

    def nested(
        self, of: ClosedJaxpr, operands: Sequence[Value], avals: Sequence[Any], loops: int = 0
    ) -> Body:
        """A function of the text, within more loops: a program of operands and arguments."""
        name = f"step{next(self._count)}" if self.bodies else "program"
        depth = self.bodies[-1].depth + loops if self.bodies else 0
        body = Body(name, depth, [self.variable(aval, depth) for aval in avals])
        self.bodies.append(body)
        results = self.inline(of, [*operands, *body.arguments])
        body.results.extend(self.all_full(results, of.out_avals))
        self.bodies.pop()
        return body

    def cond(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of one of several programs."""
        branches, (which, *own) = equation.params["branches"], operands
        if which.constant is not None:
            return self.inline(branches[np.clip(which.constant, 0, len(branches) - 1)], own)
        bodies = [self.nested(of, own, []) for of in branches]
        avals = branches[0].out_avals
        return self.call(("cond",), branch, [which], avals, True, bodies)

    def loop(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of a loop of unknown length."""
        params, avals = equation.params, [var.aval for var in equation.outvars]
        first, goes_on = params["cond_nconsts"], params["cond_jaxpr"]
        second = first + params["body_nconsts"]
        bodies = [
            self.nested(goes_on, operands[:first], avals, 1),
            self.nested(params["body_jaxpr"], operands[first:second], avals, 1),
        ]
        run = repeat_lanes if goes_on.out_avals[0].shape else repeat
        state = self.all_full(operands[second:], avals)
        return self.call(("repeat",), run, state, avals, True, bodies)

    def scan(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of a loop over rows."""
        params, avals = equation.params, [var.aval for var in equation.outvars]
        program = params["jaxpr"]
        if "ft_in" in params:  # from JAX 0.11 on
            first, count, _ = (len(list(of)) for of in params["ft_in"].update(operands).unpack())
        else:
            first, count = params["num_consts"], params["num_carry"]
        body = self.nested(program, operands[:first], program.in_avals[first:], 1)
        steps = range(params["length"])[:: -1 if params["reverse"] else 1]
        run = partial(scan, steps=steps, length=count, avals=avals[count:])
        state = self.all_full(operands[first:], (var.aval for var in equation.invars[first:]))
        return self.call(("scan",), run, state, avals, True, [body])


CALLS = ("jit", "pjit", "closed_call", "remat", "checkpoint")
CUSTOM = ("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr")
# The results of a program are put on the device, not what it makes in between.
SAME = ("copy", "device_put", "optimization_barrier", "stop_gradient")
SPECIAL: dict[str, Callable[[Translator, Equation, Sequence[Value]], Sequence[Value]]] = {
    **dict.fromkeys((*CALLS, *CUSTOM), Translator.inlined),
    **dict.fromkeys(SAME, lambda _, __, operands: operands),
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), Translator.reshape),
    "broadcast_in_dim": Translator.broadcast,
    "cond": Translator.cond,
    "custom_linear_solve": Translator.solve,
    "scan": Translator.scan,
    "while": Translator.loop,
}
