"""Changes of a module that its tests should notice, one at a time.

Annotations, docstrings, `assert`s for the type checker and decorators are left alone: what they
change no test should see. So is what changes nothing by construction: the order of arguments of a
function that does not know it, and `zip(..., strict=True)`. Of errors only the text is changed.
Three times a tiny constant is as tiny, so it becomes 1. A mutant of `os.sched_setaffinity` could
act on other processes.
"""

import ast
import copy
import dataclasses
import random
from collections.abc import Iterator

ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.MatMult: ast.Mult, ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
# Functions that do not know the order of their arguments.
SYMMETRIC = {"array_equal", "gcd", "hypot", "lcm", "logaddexp", "max", "maximum", "min", "minimum"}
TINY = 1e-12


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    path: str  # of the module, below the root
    line: int  # where it is
    kind: str  # what was done
    before: str  # the code there
    after: str  # what takes its place
    span: tuple[int, int]  # first and last byte of it
    inside: bool  # whether a call runs it; else it is run when the module is imported

    def applied(self, source: str) -> str:
        """The module with it."""
        text = source.encode()
        return (text[: self.span[0]] + self.after.encode() + text[self.span[1] :]).decode()


def _changed(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What may stand in the place of a node."""
    new = copy.deepcopy(node)
    match new:
        case ast.BinOp(left=left, right=right, op=op):
            if isinstance(op, ast.Add | ast.Sub):
                yield "term dropped", left
            if type(op) in ARITHMETIC:
                yield "operator", ast.BinOp(left, ARITHMETIC[type(op)](), right)
        case ast.Compare(left=left, ops=[op], comparators=of) if type(op) in COMPARISONS:
            yield "comparison", ast.Compare(left, [COMPARISONS[type(op)]()], of)
        case ast.BoolOp(op=op, values=values):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield "condition", ast.BoolOp(other, values)
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield "sign", operand
        case ast.Constant(value=bool() as value):
            yield "constant", ast.Constant(not value)
        case ast.Constant(value=int() as value):
            yield "constant", ast.Constant(value + 1)
        case ast.Constant(value=float() as value):
            yield "constant", ast.Constant(3 * value if abs(value) > TINY else 1.0)
        case ast.Call(func=func, args=[first, second, *rest], keywords=keywords) if not (
            isinstance(first, ast.Starred) or isinstance(second, ast.Starred)
        ):
            name = func.attr if isinstance(func, ast.Attribute) else getattr(func, "id", "")
            if name not in SYMMETRIC and ast.dump(first) != ast.dump(second):
                yield "arguments swapped", ast.Call(func, [second, first, *rest], keywords)
        case ast.If(test=test):
            yield "condition negated", ast.UnaryOp(ast.Not(), test)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            yield "condition negated", ast.IfExp(test, orelse, body)
        case ast.AugAssign() | ast.Expr(value=ast.Call()):
            yield "statement deleted", ast.Pass()
        case ast.Tuple(elts=elements, ctx=ast.Load()) | ast.List(elts=elements, ctx=ast.Load()):
            if exchanged := _exchanged(elements):
                yield "columns exchanged", type(new)(exchanged, ast.Load())
        case ast.Dict(keys=keys, values=values):
            if exchanged := _exchanged(values):
                yield "columns exchanged", ast.Dict(keys, exchanged)
        case ast.Constant(value=str() as value) if any(map(str.isalpha, value)):
            yield "text", ast.Constant(_other_text(value))
        case ast.JoinedStr(values=values):
            yield from (("text", ast.JoinedStr(other)) for other in _other_parts(values))
        case _:
            pass


def _exchanged(elements: list[ast.expr]) -> list[ast.expr]:
    """The elements with the first two exchanged; empty if that changes nothing."""
    if len(elements) < 2 or ast.dump(elements[0]) == ast.dump(elements[1]):
        return []
    if any(isinstance(one, ast.Starred) for one in elements[:2]):
        return []
    return [elements[1], elements[0], *elements[2:]]


def _other_text(text: str) -> str:
    """A text without its last word; a single word is written backwards, or twice."""
    head, _, _ = text.rstrip().rpartition(" ")
    return head or (text[::-1] if text[::-1] != text else 2 * text)


def _other_parts(values: list[ast.expr]) -> Iterator[list[ast.expr]]:
    """Parts of an f-string: two values exchanged, and another text beside them."""
    shown = [i for i, one in enumerate(values) if isinstance(one, ast.FormattedValue)]
    if len(shown) > 1 and ast.dump(values[shown[0]]) != ast.dump(values[shown[-1]]):
        first, last = shown[0], shown[-1]
        yield [
            *values[:first], values[last], *values[first + 1 : last], values[first],
            *values[last + 1 :],
        ]  # fmt: skip
    for i, one in enumerate(values):
        text = one.value if isinstance(one, ast.Constant) else None
        if isinstance(text, str) and any(map(str.isalpha, text)):
            yield [*values[:i], ast.Constant(_other_text(text)), *values[i + 1 :]]
            return


def _parts(
    node: ast.AST, inside: bool = False, said: bool = False
) -> Iterator[tuple[ast.AST, bool]]:
    """Nodes whose change a test should see, from outside in; and whether a function has them.

    Args:
        node: The outermost one.
        inside: Whether a function has it.
        said: Whether it is a part of an error, whose text alone is changed.
    """
    said = said or isinstance(node, ast.Raise)
    if not said or isinstance(node, ast.Constant | ast.JoinedStr):
        yield node, inside
    if isinstance(node, ast.JoinedStr):
        return  # the places of its parts are not those of the file
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        within = inside or (name == "body" and isinstance(node, ast.FunctionDef | ast.Lambda))
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST) and not _is_silent(part):
                yield from _parts(part, within, said)


def _is_silent(node: ast.AST) -> bool:
    silent = ast.Assert | ast.Import | ast.ImportFrom
    affinity = isinstance(node, ast.Call) and "sched_setaffinity" in ast.unparse(node.func)
    strict = isinstance(node, ast.keyword) and node.arg == "strict"
    docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return affinity or strict or docstring or isinstance(node, silent)


def mutants(path: str, source: str) -> list[Mutant]:
    """All mutants of a module, in its order."""
    text = source.encode()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node, inside in _parts(ast.parse(source)):
        place = node.test if isinstance(node, ast.If) else node
        for kind, other in _changed(node):
            assert isinstance(place, ast.expr | ast.stmt)  # all that is changed has a place
            assert place.end_lineno is not None
            assert place.end_col_offset is not None
            begin = starts[place.lineno - 1] + place.col_offset
            end = starts[place.end_lineno - 1] + place.end_col_offset
            try:
                after = ast.unparse(ast.fix_missing_locations(other))
            except ValueError:
                continue  # an f-string that Python cannot write in one line
            if isinstance(other, ast.expr):
                after = f"({after})"
            before = text[begin:end].decode()
            span = begin, end
            found.append(Mutant(path, place.lineno, kind, before, after, span, inside))
    return [one for one in found if _compiles(one.applied(source))]


def _compiles(source: str) -> bool:
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def drawn(every: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """As many of them as were asked for; the first of them are what a smaller number draws."""
    order = list(every)
    random.Random(seed).shuffle(order)
    return order[:count]
