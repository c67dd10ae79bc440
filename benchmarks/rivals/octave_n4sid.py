"""Octave's `n4sid` of one state from current to voltage."""

import functools

from benchmarks.rivals.octave import batch

batch = functools.partial(batch, "n4sid")
