"""Octave's `arx` of first order from current to voltage, the input advanced by a sample."""

import functools

from benchmarks.rivals.octave import batch

batch = functools.partial(batch, "arx")
