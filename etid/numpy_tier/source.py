"""The text of a translated program, and the loops and branches that it calls.

The text consists of functions, of which each statement is a call.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

Function = Callable[..., Sequence[Any]]  # a `Body`, once it is compiled
LARGE = 1000  # numbers; smaller arrays may stay until the function ends


class UntranslatableError(Exception):
    """A program has a primitive, or a use of it, that has no rule."""


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """A variable or a constant of the program.

    Its array may lack leading axes of the value or have length 1 where the value is longer: NumPy
    repeats the elements when they meet those of another array.
    """

    name: str
    shape: tuple[int, ...]  # of the array
    dtype: Any
    depth: int  # number of loops around its statement; -1 for a constant
    constant: Any = None  # the array of a constant


@dataclasses.dataclass(frozen=True)
class Statement:
    """`results = function(*bodies, *operands)`; `several` if the function returns a sequence."""

    results: Sequence[Value]
    function: str
    operands: Sequence[Value]
    several: bool
    bodies: "Sequence[Body]"


@dataclasses.dataclass(frozen=True)
class Body:
    """A function of the text: the program, a step of a loop, or a branch.

    Its statements may use the variables of the functions around it.
    """

    name: str
    depth: int  # number of loops around its statements
    arguments: list[Value]
    results: list[Value] = dataclasses.field(default_factory=list)
    statements: list[Statement] = dataclasses.field(default_factory=list)
    known: dict[Any, Sequence[Value]] = dataclasses.field(default_factory=dict)  # what they compute

    def lines(self) -> tuple[list[str], set[str]]:
        """The text, and the names that it takes from outside.

        It is written from its end. A statement without a result that is used later is left out. A
        large array is deleted after its last use.
        """
        made = [*self.arguments, *(of for one in self.statements for of in one.results)]
        own, large = _names(made), _names(of for of in made if math.prod(of.shape) >= LARGE)
        needed = _names(self.results)
        backwards = [f" return [{_listed(self.results)}]"]
        for statement in reversed(self.statements):
            if needed.isdisjoint(_names(statement.results)):
                continue
            inner = [body.lines() for body in statement.bodies]
            uses = {statement.function} | _names(statement.operands)
            uses = uses.union(*(outside for _, outside in inner))
            last = sorted((uses - needed) & large)
            backwards += [f" del {','.join(last)}"] if last else []
            operands = _listed([*statement.bodies, *statement.operands])
            results = _listed(statement.results) + "," * statement.several
            backwards.append(f" {results}={statement.function}({operands})")
            backwards += [f" {line}" for text, _ in inner for line in reversed(text)]
            needed -= _names(statement.results)
            needed |= uses
        backwards.append(f"def {self.name}({_listed(self.arguments)}):")
        return backwards[::-1], needed - own


def _names(values: Iterable[Value]) -> set[str]:
    return {of.name for of in values}


def _listed(values: Sequence[Value | Body]) -> str:
    return ",".join(of.name for of in values)


def branch(*bodies_and_number: Any) -> Sequence[Any]:
    """Results of the body of this number, or of the nearest one that there is."""
    *bodies, number = bodies_and_number
    return bodies[min(max(int(number), 0), len(bodies) - 1)]()


def repeat(goes_on: Function, step: Function, *start: Any) -> Sequence[Any]:
    """The state after steps, while `goes_on` of it holds."""
    state: Sequence[Any] = start
    while goes_on(*state)[0]:
        state = step(*state)
    return state


def repeat_lanes(goes_on: Function, step: Function, *state: Any) -> Sequence[Any]:
    """The same for lanes side by side; those that have ended keep their state."""
    while (running := goes_on(*state)[0]).any():
        state = tuple(
            np.where(running.reshape(running.shape + (1,) * (old.ndim - running.ndim)), new, old)
            for new, old in zip(step(*state), state, strict=True)
        )
    return state


def scan(
    step: Function, *operands: Any, steps: range, length: int, avals: Sequence[Any]
) -> list[Any]:
    """The state after steps over rows, and arrays of the rows that the steps have made.

    Args:
        step: The next state and its rows, from a state and a row of each array.
        *operands: The first state, and the arrays.
        steps: Numbers of the rows, in their order.
        length: Length of the state.
        avals: Shapes and types of the arrays to make.
    """
    state, arrays = operands[:length], operands[length:]
    made = [np.empty(aval.shape, aval.dtype) for aval in avals]
    for number in steps:
        found = step(*state, *[array[number] for array in arrays])
        state = found[:length]
        for array, row in zip(made, found[length:], strict=True):
            array[number] = row
    return [*state, *made]
