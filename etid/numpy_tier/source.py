"""The text of a translated program: functions, of which each statement is a call."""

import dataclasses
from collections.abc import Sequence
from typing import Any


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
        variable is deleted after its last use, so that its array can go.
        """
        own = _names(self.arguments).union(*(_names(one.results) for one in self.statements))
        needed = _names(self.results)
        backwards = [f" return [{_listed(self.results)}]"]
        for statement in reversed(self.statements):
            if needed.isdisjoint(_names(statement.results)):
                continue
            inner = [body.lines() for body in statement.bodies]
            uses = {statement.function} | _names(statement.operands)
            uses = uses.union(*(outside for _, outside in inner))
            last = sorted((uses - needed) & own)
            backwards += [f" del {','.join(last)}"] if last else []
            operands = _listed([*statement.bodies, *statement.operands])
            results = _listed(statement.results) + "," * statement.several
            backwards.append(f" {results}={statement.function}({operands})")
            backwards += [f" {line}" for text, _ in inner for line in reversed(text)]
            needed -= _names(statement.results)
            needed |= uses
        backwards.append(f"def {self.name}({_listed(self.arguments)}):")
        return backwards[::-1], needed - own


def _names(values: Sequence[Value]) -> set[str]:
    return {of.name for of in values}


def _listed(values: Sequence[Value | Body]) -> str:
    return ",".join(of.name for of in values)
