"""From a jaxpr to a function of NumPy arrays."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from etid.numpy_tier import functions, indexing
from etid.numpy_tier.primitives import PLACES, TEXTS, UntranslatableError
from etid.numpy_tier.source import Statement, lines, living

Program = Callable[[Sequence[Any]], list[Any]]


def translated(program: ClosedJaxpr) -> Program:
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
        with np.errstate(all="ignore"):
            return names["program"](*own)

    return run


def written(program: ClosedJaxpr) -> tuple[str, dict[str, Any]]:
    """Text of a function `program`, and the names that it needs; errors as in `translated`."""
    t = Translator()
    operands = [t.variable(aval, 0, "a") for aval in program.in_avals]
    names = [of.name for of in t.inline(program, operands)]
    body, _ = living(t.blocks[0].body, set(names))
    head = f"def program({','.join(of.name for of in operands)}):"
    return "\n".join([head, *lines(body, 1), f" return [{','.join(names)}]"]), t.names


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """A variable of the program.

    Attributes:
        name: Its name in the text.
        shape: Its shape.
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
AVAL = jax.ShapeDtypeStruct((), np.int64)  # of `places`, whose shape no text needs


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
        places[-1].body.append(Statement(f"{','.join(names)}={text}", names, uses))
        places[-1].known[text] = values
        return values

    # --- Equations --------------------------------------------------------------------------------

    def inline(self, of: ClosedJaxpr, operands: Sequence[Value]) -> list[Value]:
        """Results of a program that is part of this one."""
        jaxpr: Any = of.jaxpr
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
        if name in RULES:
            return RULES[name](self, equation, *operands)
        if name not in TEXTS:
            return self.implementation(equation, operands)
        params, avals = equation.params, [var.aval for var in equation.outvars]
        if name in PLACES:  # numbers of elements, once for all loops
            at = PLACES[name](params, operands).format(operands[1].name)
            operands = [operands[0], *self.emit(at, operands[1:2], AVAL), *operands[2:]]
        text = TEXTS[name]
        if not isinstance(text, str):
            text = text(params, operands, avals)
        if text == "{}":
            return operands
        names = [of.name for of in operands]
        text = text.format(*names, all=",".join(names))
        if len(avals) == 1 and equation.primitive.multiple_results:
            text = f"({text})[0]"
        return self.emit(text, operands, *avals)

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

    # --- Control flow -----------------------------------------------------------------------------

    def choice(
        self,
        condition: Value,
        true: ClosedJaxpr,
        false: ClosedJaxpr,
        operands: Sequence[Value],
    ) -> list[Value]:
        """Results of one of two programs."""
        here = self.blocks[-1]
        bodies, results = [], []
        for branch in (true, false):
            self.blocks.append(Block(here.depth))
            results.append(self.inline(branch, operands))
            bodies.append(self.blocks.pop().body)
        values = [self.variable(aval, here.depth) for aval in true.out_avals]
        for body, found in zip(bodies, results, strict=True):
            body += [_assigned(new, old) for new, old in zip(values, found, strict=True)]
        names = [of.name for of in values]
        here.body.append(Statement(f"if {condition.name}:", names, [condition.name], bodies))
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
        self.blocks.append(Block(here.depth + 1))
        body = self.blocks[-1].body
        after, made = step(carried, here.depth + 1)
        lists = [self.name("l") for _ in made]
        for to, of in zip(lists, made, strict=True):
            body.append(Statement(f"{to}.append({of.name})", [to], [to, of.name]))
        # A carried value that becomes another one is kept until all are assigned.
        after = [
            self.emit(of.name, [of], jax.ShapeDtypeStruct(of.shape, of.dtype))[0]
            if of in carried and of is not own
            else of
            for own, of in zip(carried, after, strict=True)
        ]
        pairs = zip(carried, after, strict=True)
        body += [_assigned(own, of) for own, of in pairs if of is not own]
        self.blocks.pop()
        here.body += [_assigned(own, of) for own, of in zip(carried, start, strict=True)]
        here.body += [Statement(f"{to}=[]", [to], []) for to in lists]
        names = [of.name for of in carried] + lists
        here.body.append(Statement(head, names, [], [body]))
        return [dataclasses.replace(of, depth=here.depth) for of in carried], lists


def _assigned(new: Value, old: Value) -> Statement:
    return Statement(f"{new.name}={old.name}", [new.name], [old.name])


def _call(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    return t.inline(params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"], operands)


def _solve(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    lengths, programs = equation.params["const_lengths"], equation.params["jaxprs"]
    first = lengths.matvec + lengths.vecmat
    own = operands[first : first + lengths.solve]
    return t.inline(programs.solve, [*own, *operands[sum(lengths) :]])


def _cond(t: Translator, equation: Equation, index: Value, *operands: Value) -> list[Value]:
    branches = equation.params["branches"]
    if index.constant is not None:
        return t.inline(branches[min(max(int(index.constant), 0), len(branches) - 1)], operands)
    if len(branches) > 2:
        raise UntranslatableError("cond with more than two branches")
    return t.choice(index, branches[1], branches[0], operands)


def _while(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]

    def step(carried: list[Value], _: int) -> tuple[list[Value], list[Value]]:
        (goes_on,) = t.inline(params["cond_jaxpr"], [*operands[:first], *carried])
        one = t.emit(f"{goes_on.name}.any()", [goes_on], scalar)[0] if lanes.shape else goes_on
        leave = Statement(f"if not {one.name}: break", (), [one.name])
        t.blocks[-1].body.append(leave)
        after = t.inline(params["body_jaxpr"], [*operands[first:second], *carried])
        if lanes.shape:  # those that have ended keep their values
            after = [_lanes(t, goes_on, *of) for of in zip(after, carried, strict=True)]
        return after, []

    avals = [var.aval for var in equation.outvars]
    (lanes,) = params["cond_jaxpr"].out_avals
    scalar = jax.ShapeDtypeStruct((), bool)
    return t.repeated("while True:", operands[second:], avals, step)[0]


def _lanes(t: Translator, which: Value, new: Value, old: Value) -> Value:
    """The new values of the lanes for which `which` holds, and the old ones of the others."""
    axes = f"({which.name}.shape+(1,)*{len(old.shape) - len(which.shape)})"
    text = f"np.where({which.name}.reshape{axes},{new.name},{old.name})"
    return t.emit(text, [which, new, old], jax.ShapeDtypeStruct(old.shape, old.dtype))[0]


def _scan(t: Translator, equation: Equation, *operands: Value) -> list[Value]:
    params = equation.params
    first = params["num_consts"]
    second = first + params["num_carry"]
    avals = [var.aval for var in equation.outvars]
    of_steps = avals[params["num_carry"] :]
    rows = operands[second:]
    number, length = t.name("i"), params["length"]
    steps = f"range({length - 1},-1,-1)" if params["reverse"] else f"range({length})"

    def step(carried: list[Value], depth: int) -> tuple[list[Value], list[Value]]:
        own = []
        for of in rows:
            aval = jax.ShapeDtypeStruct(of.shape[1:], of.dtype)
            own.append(t.variable(aval, depth))
            row = Statement(f"{own[-1].name}={of.name}[{number}]", [own[-1].name], [of.name])
            t.blocks[-1].body.append(row)
        found = t.inline(params["jaxpr"], [*operands[:first], *carried, *own])
        return found[: params["num_carry"]], found[params["num_carry"] :]

    head = f"for {number} in {steps}:"
    carried, lists = t.repeated(head, operands[first:second], avals[: params["num_carry"]], step)
    order = "[::-1]" if params["reverse"] else ""
    stacked = []
    for name, aval in zip(lists, of_steps, strict=True):
        stacked.append(t.variable(aval, t.blocks[-1].depth))
        text = f"{stacked[-1].name}=np.array({name}{order},'{aval.dtype}').reshape({aval.shape})"
        t.blocks[-1].body.append(Statement(text, [stacked[-1].name], [name]))
    return [*carried, *stacked]


RULES = {
    "cond": _cond,
    "custom_jvp_call": _call,
    "custom_linear_solve": _solve,
    "custom_vjp_call": _call,
    "jit": _call,
    "pjit": _call,
    "scan": _scan,
    "while": _while,
}
