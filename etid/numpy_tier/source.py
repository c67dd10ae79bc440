"""Statements of a translated program: without dead code, as text, and as a function."""

import dataclasses
from collections.abc import Iterator


@dataclasses.dataclass(frozen=True)
class Assign:
    """`names = text`, at once if there are several; `uses` are the names in the text.

    Several names need a text that makes as many values. The names `last` are not used after it:
    their arrays can go.
    """

    names: list[str]
    text: str
    uses: list[str]
    last: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Carry:
    """`names = values` at once: what a loop begins with, or hands to its next step."""

    names: list[str]
    values: list[str]


@dataclasses.dataclass(frozen=True)
class Leave:
    """Leave the loop unless `condition` holds."""

    condition: str


@dataclasses.dataclass(frozen=True)
class Append:
    """Append a value to a list."""

    to: str
    value: str


@dataclasses.dataclass(frozen=True)
class Choice:
    """One of two bodies; both assign `names`."""

    condition: str
    true: "list[Statement]"
    false: "list[Statement]"
    names: list[str]


@dataclasses.dataclass(frozen=True)
class Loop:
    """A body that is repeated; `names` are what it leaves behind.

    `head` is the text of the loop's first line.
    """

    head: str
    body: "list[Statement]"
    names: list[str]


Statement = Assign | Carry | Leave | Append | Choice | Loop


def living(
    body: list[Statement], needed: set[str], outside: frozenset[str] = frozenset()
) -> tuple[list[Statement], set[str]]:
    """The statements that determine the names `needed` after them, and the names that these use.

    Args:
        body: Statements.
        needed: Names that are used after them.
        outside: Names that are used after the loop around them.
    """
    kept: list[Statement] = []
    needed = set(needed)
    for statement in reversed(body):
        match statement:
            case Assign(names, text, uses):
                if needed.isdisjoint(names):
                    continue
                last = {of for of in uses if not of.startswith("c")} - needed  # no constants
                statement = Assign(names, text, uses, tuple(sorted(last)))
                needed = (needed - set(names)) | set(uses)
            case Carry(names, values):
                pairs = [(a, b) for a, b in zip(names, values, strict=True) if a in needed]
                if not pairs:
                    continue
                of, values = [a for a, _ in pairs], [b for _, b in pairs]
                needed = (needed - set(of)) | set(values)
                statement = Carry(of, values)
            case Leave(condition):
                needed |= {condition} | outside
            case Append(to, value):
                if to not in needed:
                    continue
                needed.add(value)
            case Choice(condition, true, false, names):
                if needed.isdisjoint(names):
                    continue
                true, of_true = living(true, needed, outside)
                false, of_false = living(false, needed, outside)
                needed = of_true | of_false | {condition}
                statement = Choice(condition, true, false, names)
            case Loop(head, inner, names):
                if needed.isdisjoint(names):
                    continue
                after = frozenset(needed)
                while True:  # what a step uses, the step before it must leave behind
                    shorter, before = living(inner, needed, after)
                    if before <= needed:
                        break
                    needed |= before
                statement = Loop(head, shorter, names)
        kept.append(statement)
    return kept[::-1], needed


def lines(body: list[Statement], depth: int) -> Iterator[str]:
    """Text of statements, indented by `depth`."""
    indent = " " * depth
    if not body:
        yield indent + "pass"
    for statement in body:
        match statement:
            case Assign(names, text, _, last):
                yield f"{indent}{','.join(names)}={text}"
                if last:
                    yield f"{indent}del {','.join(last)}"
            case Carry(names, values):
                yield f"{indent}{','.join(names)}={','.join(values)}"
            case Leave(condition):
                yield f"{indent}if not {condition}: break"
            case Append(to, value):
                yield f"{indent}{to}.append({value})"
            case Choice(condition, true, false, _):
                yield f"{indent}if {condition}:"
                yield from lines(true, depth + 1)
                yield f"{indent}else:"
                yield from lines(false, depth + 1)
            case Loop(head, inner, _):
                yield f"{indent}{head}:"
                yield from lines(inner, depth + 1)
