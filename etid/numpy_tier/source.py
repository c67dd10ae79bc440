"""Statements of a translated program: without dead code, and as text."""

import dataclasses
from collections.abc import Iterator, Sequence


@dataclasses.dataclass(frozen=True)
class Statement:
    """A line of text.

    Attributes:
        text: The line.
        names: Names that it assigns. A statement that assigns none stays.
        uses: Names in the text.
        bodies: One body of a loop, or the two of a choice.
    """

    text: str
    names: Sequence[str]
    uses: Sequence[str]
    bodies: "Sequence[list[Statement]]" = ()


def living(body: list[Statement], needed: set[str]) -> tuple[list[Statement], set[str]]:
    """The statements that determine the names `needed` after them, and the names that these use.

    Variables (names with `v`) are deleted after their last use, so that their arrays can go.
    """
    kept: list[Statement] = []
    needed = set(needed)
    for statement in reversed(body):
        if statement.names and needed.isdisjoint(statement.names):
            continue
        bodies = []
        if len(statement.bodies) == 1:
            while True:  # what a step uses, the step before it must leave behind
                shorter, before = living(statement.bodies[0], needed)
                if before <= needed:
                    break
                needed |= before
            bodies = [shorter]
        elif statement.bodies:
            parts = [living(part, needed) for part in statement.bodies]
            bodies = [part for part, _ in parts]
            needed = parts[0][1] | parts[1][1]
        else:
            last = sorted({of for of in statement.uses if of[0] == "v"} - needed)
            if last:
                kept.append(Statement(f"del {','.join(last)}", (), ()))
            needed -= set(statement.names)
        needed |= set(statement.uses)
        kept.append(dataclasses.replace(statement, bodies=bodies))
    return kept[::-1], needed


def lines(body: list[Statement], depth: int) -> Iterator[str]:
    """Text of statements, indented by `depth`."""
    indent = " " * depth
    for statement in body:
        yield indent + statement.text
        for number, part in enumerate(statement.bodies):
            if number:
                yield indent + "else:"
            yield from lines(part, depth + 1)
            yield indent + " pass"
