"""Runs a jaxpr with NumPy, and decides whether NumPy or XLA runs a function.

XLA takes about 7 ms to compile each kernel of a program, be it large or small. A program that runs
once or a few times on small arrays is therefore done sooner without XLA. `translated` turns a
jaxpr into the source of one Python function that calls NumPy and SciPy.

- `tiers` decides who runs a function, and tells a person who waits for XLA.
- `translator` walks over the equations of a jaxpr, and `source` writes the statements.
- `primitives` has one rule for each primitive, and `algebra` those of matrices.

This package knows nothing of etid's models.
"""

from etid.numpy_tier.source import UntranslatableError
from etid.numpy_tier.translator import translated

__all__ = ["UntranslatableError", "translated"]
