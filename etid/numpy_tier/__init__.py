"""Who runs a traced function: NumPy, by which small programs answer at once, or XLA.

XLA takes about 7 ms to compile each kernel of a program, be it large or small. A program that runs
once or a few times on small arrays is therefore done sooner without XLA. `translated` turns a
jaxpr into the source of one Python function that calls NumPy and SciPy.

- `tiers` decides who runs a function; `waiting` tells a person who waits for XLA.
- `text` makes the function of a jaxpr.
- `translator` walks over its equations. It inlines calls, folds constants, merges equal statements
  and moves what does not change out of loops.
- `elementwise`, `arrays` and `algebra` have one rule for each primitive.
- `functions` and `indexing` are what the text calls.
- `source` drops dead statements and writes the others.

This package knows nothing of etid's models.
"""

from etid.numpy_tier.text import translated
from etid.numpy_tier.translator import UntranslatableError

__all__ = ["UntranslatableError", "translated"]
