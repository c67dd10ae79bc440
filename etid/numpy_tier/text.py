"""A jaxpr as a function of NumPy arrays."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from etid.numpy_tier import algebra, arrays, elementwise  # noqa: F401 (they register their rules)
from etid.numpy_tier.source import lines, living
from etid.numpy_tier.translator import Translator

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
    results = t.all_full(t.inline(program, operands), program.out_avals)
    names = [of.name for of in results]
    body, _ = living(t.blocks[0].body, set(names))
    head = f"def program({','.join(of.name for of in operands)}):"
    return "\n".join([head, *lines(body, 1), f" return [{','.join(names)}]"]), t.names
