"""Loops and branches, of which the bodies are functions of a translated program."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Body = Callable[..., Sequence[Any]]


def branch(*bodies_and_number: Any) -> Sequence[Any]:
    """Results of the body of this number, or of the nearest one that there is."""
    *bodies, number = bodies_and_number
    return bodies[min(max(int(number), 0), len(bodies) - 1)]()


def repeat(goes_on: Body, step: Body, *start: Any) -> Sequence[Any]:
    """The state after steps, while `goes_on` of it holds."""
    state: Sequence[Any] = start
    while goes_on(*state)[0]:
        state = step(*state)
    return state


def repeat_lanes(goes_on: Body, step: Body, *state: Any) -> Sequence[Any]:
    """The same for lanes side by side; those that have ended keep their state."""
    while (running := goes_on(*state)[0]).any():
        state = tuple(
            np.where(running.reshape(running.shape + (1,) * (old.ndim - running.ndim)), new, old)
            for new, old in zip(step(*state), state, strict=True)
        )
    return state


def scan(step: Body, *operands: Any, steps: range, length: int, avals: Sequence[Any]) -> list[Any]:
    """The state after steps over rows, and arrays of the rows that the steps have made.

    Args:
        step: The next state and its rows, from a state and a row of each array.
        *operands: The first state, and the arrays.
        steps: Numbers of the rows, in their order.
        length: Length of the state.
        avals: Shapes and types of the arrays to make.
    """
    state, arrays = operands[:length], operands[length:]
    made = [np.empty(aval.shape, aval.dtype) for aval in avals]
    for number in steps:
        found = step(*state, *[array[number] for array in arrays])
        state = found[:length]
        for array, row in zip(made, found[length:], strict=True):
            array[number] = row
    return [*state, *made]
