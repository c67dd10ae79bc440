"""Least squares near a point, for rows: steps, inverses, and Levenberg-Marquardt on a few terms.

All matrices are scaled to a unit diagonal before they are solved, because the parameters of a fit
have different units (Moré 1978).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from etid.precision import namespace
from etid.signals.transfer import AnyArray

RIDGE = 1e-13  # of the scaled matrix, for directions that double precision cannot resolve
SMALLEST = 1e-12  # the same for an inverse


class NormalEquations(NamedTuple):
    """Objective ½|r|², gradient Jᵀr and Gauss-Newton matrix JᵀJ of a residual r."""

    objective: Float[AnyArray, "*row"]
    gradient: Float[AnyArray, "*row q"]
    matrix: Float[AnyArray, "*row q q"]

    def step(self, damping: Float[AnyArray, "*row"] | float = 0.0) -> Float[AnyArray, "*row q"]:
        """−(JᵀJ + damping · D)⁻¹ Jᵀr, where D is the diagonal of JᵀJ."""
        xp = namespace(self.matrix)
        scale = _scale(self.matrix)
        ridge = xp.asarray(damping + RIDGE)[..., None, None] * np.eye(scale.shape[-1])
        scaled = self.matrix / scale[..., :, None] / scale[..., None, :] + ridge
        return -xp.linalg.solve(scaled, (self.gradient / scale)[..., None])[..., 0] / scale

    def promised(self, step: Float[AnyArray, "*row q"]) -> Float[AnyArray, "*row"]:
        """Reduction of the objective by a Gauss-Newton step."""
        return -0.5 * (step * self.gradient).sum(-1)


def inverse(matrix: Float[AnyArray, "*row q q"]) -> Float[AnyArray, "*row q q"]:
    """Inverse of a positive semidefinite matrix."""
    xp, scale = namespace(matrix), _scale(matrix)
    outer = scale[..., :, None] * scale[..., None, :]
    found = xp.linalg.inv(matrix / outer + SMALLEST * np.eye(scale.shape[-1]))
    return 0.5 * (found + found.swapaxes(-1, -2)) / outer


def diagonal(matrix: Float[AnyArray, "*row q q"]) -> Float[AnyArray, "*row q"]:
    """The diagonal."""
    return namespace(matrix).diagonal(matrix, axis1=-2, axis2=-1)


def _scale(matrix: Float[AnyArray, "*row q q"]) -> Float[AnyArray, "*row q"]:
    xp = namespace(matrix)
    scale = xp.sqrt(xp.maximum(diagonal(matrix), 0.0))
    return xp.where(scale > 0, scale, 1.0)


class State(NamedTuple):
    """Where Levenberg-Marquardt is.

    Attributes:
        q: The best point.
        equations: The normal equations there.
        damping: Damping of the next step, relative to the diagonal.
        move: The next step.
        moves: Whether it is taken.
    """

    q: Float[AnyArray, "*row q"]
    equations: NormalEquations
    damping: Float[AnyArray, "*row"]
    move: Float[AnyArray, "*row q"]
    moves: Bool[AnyArray, "*row"]


def levenberg_marquardt(
    equations: Callable[[Float[AnyArray, "*row q"]], NormalEquations],
    start: Float[AnyArray, "*row q"],
    first: NormalEquations,
    damping: float,
    enough: Float[AnyArray, "*row"],
    steps: int,
) -> State:
    """The minimum of a few terms.

    Args:
        equations: The normal equations at a point.
        start: The first point.
        first: The normal equations there.
        damping: Damping of the first step.
        enough: Reduction of the objective by the next step, below which a row is at its minimum.
        steps: Largest number of steps.
    """
    xp = namespace(start)

    def proposed(
        q: Float[AnyArray, "*row q"],
        equations: NormalEquations,
        damping: Float[AnyArray, "*row"],
        moves: Bool[AnyArray, "*row"],
    ) -> State:
        move = equations.step(damping)
        return State(q, equations, damping, move, moves & (equations.promised(move) > enough))

    def step(state: State) -> State:
        trial = xp.where(state.moves[..., None], state.q + state.move, state.q)
        new, old = equations(trial), state.equations
        finite = xp.isfinite(new.gradient).all(-1)
        better = state.moves & finite & (new.objective <= old.objective)
        damping = xp.where(better, state.damping * 0.2, xp.maximum(state.damping, 1e-6) * 10)
        q, *kept = chosen(better, (trial, *new), (state.q, *old))
        return proposed(q, NormalEquations(*kept), damping, state.moves)

    damped, finite = xp.full_like(first.objective, damping), xp.isfinite(first.objective)
    return repeated(step, proposed(start, first, damped, finite), steps)


def chosen(
    rows: Bool[AnyArray, "*row"], new: Sequence[AnyArray], old: Sequence[AnyArray]
) -> list[AnyArray]:
    """Arrays of `new` in these rows, of `old` in the others."""
    xp = namespace(rows)
    of = zip(new, old, strict=True)
    return [xp.where(rows.reshape(rows.shape + (1,) * (a.ndim - rows.ndim)), a, b) for a, b in of]


def repeated(step: Callable[[State], State], state: State, steps: int) -> State:
    """Steps until no row moves: a loop of Python for NumPy, one of JAX for JAX."""
    if namespace(state.moves) is np:
        for _ in range(steps):
            if not state.moves.any():
                break
            state = step(state)
        return state
    _, state = jax.lax.while_loop(
        lambda of: (of[0] < steps) & of[1].moves.any(),
        lambda of: (of[0] + 1, step(of[1])),
        (0, state),
    )
    return state
