"""Room for what is compiled.

XLA maps memory for every executable. Linux allows a process 65 530 mappings, and beyond them the
compiler crashes: one process would, that runs all tests, or all cells of a map.
"""

import pathlib

import jax

ENOUGH = 30_000  # half of what Linux allows; one test file needs a few thousand


def make_room() -> None:
    """Forget what was compiled before the process runs out of mappings."""
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > ENOUGH:
        jax.clear_caches()
