"""From the equations of a jaxpr to statements of NumPy.

The values of a program are arrays of known shape. A broadcast is not carried out until something
needs all its elements: the array of a value may lack leading axes, and may have length 1 where the
value is longer. NumPy's own broadcasting then gives the same elements.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from etid.numpy_tier import functions, indexing
from etid.numpy_tier.source import Append, Assign, Carry, Choice, Leave, Loop, Statement


class UntranslatableError(Exception):
    """A program has a primitive, or a use of it, that has no rule."""


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """A variable of the program.

    Attributes:
        name: Its name in the text.
        shape: Shape of its array, which broadcasts to the shape of the value.
        dtype: Type of its elements.
        depth: Number of loops around its statement; -1 for a constant.
        constant: The array of a constant.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    depth: int
    constant: Any = None


class Block:
    """Statements at one place within `depth` loops, and what they have computed, by text."""

    def __init__(self, depth: int) -> None:
        self.depth = depth
        self.body: list[Statement] = []
        self.known: dict[str, list[Value]] = {}


Equation = Any  # a `JaxprEqn`, whose values are arrays
Rule = Callable[..., Value | Sequence[Value]]
RULES: dict[str, tuple[Rule, bool]] = {}


def rule(*names: str, broadcast: bool = True) -> Callable[[Rule], Rule]:
    """Register the rule of primitives.

    Its arguments are the translator, the equation and one value for each operand, and it returns
    the results.

    Args:
        *names: Names of the primitives.
        broadcast: Whether the rule needs arrays with all elements.
    """

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, (function, broadcast)))
        return function

    return register


class Translator:
    """Statements of one program.

    Attributes:
        blocks: The blocks around the present place, outermost first.
        names: Meaning of the names in the text: functions and constants.
    """

    def __init__(self) -> None:
        self.blocks = [Block(0)]
        self.names: dict[str, Any] = {
            "np": np,
            **{name: getattr(functions, name) for name in functions.__all__},
            **{name: getattr(indexing, name) for name in indexing.__all__},
        }
        self._count = 0
        self._constants: dict[Any, Value] = {}  # equal ones are one
        self._implementations: dict[Any, ClosedJaxpr] = {}
        self._inside: set[Any] = set()  # primitives whose implementation is being translated

    # --- Values -----------------------------------------------------------------------------------

    def name(self, letter: str = "v") -> str:
        """A new name."""
        self._count += 1
        return f"{letter}{self._count}"

    def variable(self, aval: Any, depth: int, letter: str = "v") -> Value:
        """A new variable of some shape and type.

        Raises:
            UntranslatableError: NumPy does not have this type.
        """
        if not isinstance(aval.dtype, np.dtype):
            raise UntranslatableError(f"type {aval.dtype}")
        return Value(self.name(letter), tuple(aval.shape), np.dtype(aval.dtype), depth)

    def constant(self, of: Any) -> Value:
        """The value of a constant array."""
        array = np.asarray(of)
        key = (array.dtype, array.shape, array.tobytes())
        if key not in self._constants:
            name = self.name("c")
            self.names[name] = array if array.ndim else array[()]
            self._constants[key] = Value(name, array.shape, array.dtype, -1, self.names[name])
        return self._constants[key]

    def emit(self, text: str, operands: Sequence[Value], *avals: Any) -> list[Value]:
        """Values that an expression makes of operands: computed at once, or by a statement.

        The statement stands outside of the loops that do not change its operands. An expression
        that is already there is not computed again.
        """
        depth = max((of.depth for of in operands), default=-1)
        if depth < 0:
            with np.errstate(all="ignore"):
                found = eval(text, self.names)
            return [self.constant(one) for one in (found if len(avals) > 1 else [found])]
        places = [block for block in self.blocks if block.depth <= depth]
        for place in places:
            if text in place.known:
                return place.known[text]
        values = [self.variable(aval, depth) for aval in avals]
        names, uses = [of.name for of in values], [of.name for of in operands]
        places[-1].body.append(Assign(names, text, uses))
        places[-1].known[text] = values
        return values

    def full(self, of: Value, shape: Sequence[int]) -> Value:
        """The value as an array with all its elements."""
        shape = tuple(shape)
        if of.shape == shape:
            return of
        if of.shape == ():
            text = f"np.full({shape},{of.name})"
        elif math.prod(of.shape) == math.prod(shape):
            text = f"{of.name}.reshape({shape})"
        else:
            text = f"np.broadcast_to({of.name},{shape})"
        return self.emit(text, [of], jax.ShapeDtypeStruct(shape, of.dtype))[0]

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
            found = self.equation(equation, [read(var) for var in equation.invars])
            values |= zip(equation.outvars, found, strict=True)
        return [read(var) for var in jaxpr.outvars]

    def equation(self, equation: Equation, operands: Sequence[Value]) -> Sequence[Value]:
        """Results of an equation.

        Raises:
            UntranslatableError: There is no rule for it.
        """
        name = equation.primitive.name
        if name not in RULES:
            return self.implementation(equation, operands)
        function, broadcast = RULES[name]
        if broadcast:
            operands = self.all_full(operands, (var.aval for var in equation.invars))
        found = function(self, equation, *operands)
        return [found] if isinstance(found, Value) else found

    def implementation(self, equation: Equation, operands: Sequence[Value]) -> list[Value]:
        """Results of a primitive of another package: its implementation is made of JAX's own.

        Raises:
            UntranslatableError: It has no such implementation.
        """
        primitive, params = equation.primitive, equation.params
        avals: list[Any] = [var.aval for var in (*equation.invars, *equation.outvars)]
        own_type = not all(isinstance(aval.dtype, np.dtype) for aval in avals)
        if own_type or primitive in self._inside:  # a key, or a primitive that is made of itself
            raise UntranslatableError(primitive.name)
        shapes = [jax.ShapeDtypeStruct(of.shape, of.dtype) for of in avals[: len(operands)]]
        key = primitive, str(params), str(shapes)
        if key not in self._implementations:
            try:
                traced = jax.make_jaxpr(lambda *of: primitive.impl(*of, **params))(*shapes)
            except (NotImplementedError, TypeError) as error:
                raise UntranslatableError(primitive.name) from error
            self._implementations[key] = traced
        self._inside.add(primitive)
        found = self.inline(self._implementations[key], operands)
        self._inside.remove(primitive)
        return found

    def all_full(self, values: Iterable[Value], avals: Iterable[Any]) -> list[Value]:
        """`full` for several values."""
        return [self.full(of, aval.shape) for of, aval in zip(values, avals, strict=True)]

    # --- Control flow -----------------------------------------------------------------------------

    def choice(
        self,
        condition: Value,
        true: ClosedJaxpr,
        false: ClosedJaxpr,
        operands: Sequence[Value],
    ) -> list[Value]:
        """Results of one of two programs."""
        avals, here = true.out_avals, self.blocks[-1]
        bodies, results = [], []
        for branch in (true, false):
            self.blocks.append(Block(here.depth))
            results.append(self.all_full(self.inline(branch, operands), avals))
            bodies.append(self.blocks.pop().body)
        values = []
        for one, other, aval in zip(*results, avals, strict=True):
            if one is other:
                values.append(one)
                continue
            values.append(self.variable(aval, here.depth))
            for body, of in zip(bodies, (one, other), strict=True):
                body.append(Assign([values[-1].name], of.name, [of.name]))
        here.body.append(Choice(condition.name, bodies[0], bodies[1], [of.name for of in values]))
        return values

    def repeated(
        self,
        head: str,
        start: Sequence[Value],
        avals: Sequence[Any],
        step: Callable[[list[Value], int], tuple[Sequence[Value], Sequence[Value]]],
    ) -> tuple[list[Value], list[str]]:
        """The carried values after a loop, and the names of lists of what each step has made.

        Args:
            head: The text of the loop's first line.
            start: Carried values before the first step.
            avals: Their shapes and types.
            step: Carried values after a step, and its other results, from the carried values
                before it and the number of loops around it.
        """
        here = self.blocks[-1]
        carried = [self.variable(aval, here.depth + 1, "w") for aval in avals]
        names = [of.name for of in carried]
        start = self.all_full(start, avals)
        self.blocks.append(Block(here.depth + 1))
        body = self.blocks[-1].body
        after, made = step(carried, here.depth + 1)
        after = self.all_full(after, avals)
        lists = [self.name("l") for _ in made]
        body += [Append(to, of.name) for to, of in zip(lists, made, strict=True)]
        body.append(Carry(names, [of.name for of in after]))
        self.blocks.pop()
        here.body.append(Carry(names, [of.name for of in start]))
        here.body += [Assign([to], "[]", []) for to in lists]
        here.body.append(Loop(head, body, names + lists))
        return [dataclasses.replace(of, depth=here.depth) for of in carried], lists


@rule("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", broadcast=False)
@rule("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", broadcast=False)
def _call(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    names = ("jaxpr", "call_jaxpr", "fun_jaxpr")
    inner = next(params[name] for name in names if name in params)
    closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
    return t.inline(closed, operands)


@rule("device_put", broadcast=False)
def _put(_: Translator, __: Equation, *operands: Value) -> Sequence[Value]:
    return operands  # the results of a program are put on the device, not what it makes between


@rule("custom_linear_solve", broadcast=False)
def _solve(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    lengths, programs = equation.params["const_lengths"], equation.params["jaxprs"]
    first = lengths.matvec + lengths.vecmat
    own = operands[first : first + lengths.solve]
    return t.inline(programs.solve, [*own, *operands[sum(lengths) :]])


@rule("cond", broadcast=False)
def _cond(t: Translator, equation: Equation, index: Value, *operands: Value) -> list[Value]:
    branches = equation.params["branches"]
    if index.constant is not None:
        return t.inline(branches[min(max(int(index.constant), 0), len(branches) - 1)], operands)
    if len(branches) > 2:
        raise UntranslatableError("cond with more than two branches")
    return t.choice(index, branches[1], branches[0], operands)


@rule("while", broadcast=False)
def _while(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def step(carried: list[Value], _: int) -> tuple[list[Value], list[Value]]:
        (goes_on,) = t.inline(params["cond_jaxpr"], [*operands[:first], *carried])
        one = t.emit(f"{goes_on.name}.any()", [goes_on], scalar)[0] if lanes.shape else goes_on
        t.blocks[-1].body.append(Leave(one.name))
        after = t.inline(params["body_jaxpr"], [*operands[first:second], *carried])
        if lanes.shape:  # those that have ended keep their values
            after = [_lanes(t, goes_on, *of) for of in zip(after, carried, strict=True)]
        return after, []

    avals = [var.aval for var in equation.outvars]
    (lanes,) = params["cond_jaxpr"].out_avals
    scalar = jax.ShapeDtypeStruct((), bool)
    return t.repeated("while True", operands[second:], avals, step)[0]


def _lanes(t: Translator, which: Value, new: Value, old: Value) -> Value:
    """The new values of the lanes for which `which` holds, and the old ones of the others."""
    axes = f"({which.name}.shape+(1,)*{len(old.shape) - len(which.shape)})"
    text = f"np.where({which.name}.reshape{axes},{new.name},{old.name})"
    return t.emit(text, [which, new, old], jax.ShapeDtypeStruct(old.shape, old.dtype))[0]


@rule("scan", broadcast=False)
def _scan(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    first = params["num_consts"]
    second = first + params["num_carry"]
    avals = [var.aval for var in equation.outvars]
    of_steps = avals[params["num_carry"] :]
    rows = t.all_full(operands[second:], (var.aval for var in equation.invars[second:]))
    number, length = t.name("i"), params["length"]
    steps = f"range({length - 1},-1,-1)" if params["reverse"] else f"range({length})"

    def step(carried: list[Value], depth: int) -> tuple[list[Value], list[Value]]:
        own = []
        for of in rows:
            aval = jax.ShapeDtypeStruct(of.shape[1:], of.dtype)
            own.append(t.variable(aval, depth))
            text = Assign([own[-1].name], f"{of.name}[{number}]", [of.name])
            t.blocks[-1].body.append(text)
        found = t.inline(params["jaxpr"], [*operands[:first], *carried, *own])
        made, inner = found[params["num_carry"] :], params["jaxpr"].out_avals[params["num_carry"] :]
        return found[: params["num_carry"]], t.all_full(made, inner)

    head = f"for {number} in {steps}"
    carried, lists = t.repeated(head, operands[first:second], avals[: params["num_carry"]], step)
    order = "[::-1]" if params["reverse"] else ""
    stacked = []
    for name, aval in zip(lists, of_steps, strict=True):
        stacked.append(t.variable(aval, t.blocks[-1].depth))
        text = f"np.array({name}{order},'{aval.dtype}').reshape({aval.shape})"
        t.blocks[-1].body.append(Assign([stacked[-1].name], text, [name]))
    return [*carried, *stacked]
