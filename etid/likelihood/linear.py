"""Least squares near a point, for rows: steps, inverses, and Levenberg-Marquardt on a few terms.

All matrices are scaled to a unit diagonal before they are solved, because the parameters of a fit
have different units. In a search the scale is the largest diagonal so far (Moré 1978).

In a curved valley steps can follow its curvature: with the second derivative r″ of the residual
along a step, half of the step that r″ alone would cause is added (Transtrum and Sethna 2012,
arXiv:1201.5885).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from etid.precision import namespace
from etid.signals.transfer import AnyArray

Arrays = TypeVar("Arrays")

RIDGE = 1e-13  # of the scaled matrix, for directions that double precision cannot resolve
SMALLEST = 1e-12  # the same for an inverse
GOOD = 0.75  # of the reduction that a step promises, from which on the next is damped less
LEAST = 1e-12  # damping after a step that failed, at least
ACCELERATION = 0.75  # largest second-order part relative to the step (Transtrum and Sethna)
LEFT = 1e-7  # of a right side, which its solution may leave
PRODUCTS = 50  # largest number of products for a solution; it takes two or three
DIFFERENCE = 0.1  # of a step, for its second derivative (ibid.)


class NormalEquations(NamedTuple):
    """Objective ½|r|², gradient Jᵀr and Gauss-Newton matrix JᵀJ of a residual r.

    Attributes:
        objective: ½|r|².
        gradient: Jᵀr.
        matrix: JᵀJ.
        terms: r; None if no step asks for its curvature.
        rows: Jᵀ; None in the same case.
    """

    objective: Float[AnyArray, "*row"]
    gradient: Float[AnyArray, "*row q"]
    matrix: Float[AnyArray, "*row q q"]
    terms: Float[AnyArray, "*row term"] | None = None
    rows: Float[AnyArray, "*row q term"] | None = None

    @classmethod
    def of(
        cls, terms: Float[AnyArray, "*row term"], rows: Float[AnyArray, "*row q term"]
    ) -> "NormalEquations":
        """Those of terms and of their derivatives; infinite if one of them is not finite."""
        xp = namespace(terms)
        objective, gradient = 0.5 * (terms**2).sum(-1), (rows @ terms[..., None])[..., 0]
        finite = xp.isfinite(objective) & xp.isfinite(gradient).all(-1)
        objective = xp.where(finite, objective, np.inf)
        return cls(objective, gradient, rows @ rows.swapaxes(-1, -2), terms, rows)

    def along(self, free: Bool[AnyArray, "*#row q"]) -> "NormalEquations":
        """The same with the other parameters fixed."""
        xp, both = namespace(self.matrix, free), free[..., :, None] & free[..., None, :]
        matrix = xp.where(both, self.matrix, np.eye(free.shape[-1]))
        return self._replace(gradient=xp.where(free, self.gradient, 0.0), matrix=matrix)

    @property
    def scale(self) -> Float[AnyArray, "*row q"]:
        """Roots of the diagonal of JᵀJ; 1 where it is 0."""
        return _scale(self.matrix)

    def step(
        self,
        damping: Float[AnyArray, "*row"] | float = 0.0,
        scale: Float[AnyArray, "*row q"] | None = None,
    ) -> Float[AnyArray, "*row q"]:
        """−(JᵀJ + damping · D²)⁻¹ Jᵀr, where D is the scale."""
        xp, by = namespace(self.matrix), self.scale if scale is None else scale
        ridge = xp.asarray(damping + RIDGE)[..., None, None] * np.eye(by.shape[-1])
        scaled = self.matrix / by[..., :, None] / by[..., None, :] + ridge
        return -xp.linalg.solve(scaled, (self.gradient / by)[..., None])[..., 0] / by

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


@runtime_checkable
class Problem(Protocol):
    """Terms of rows to minimise."""

    def equations(self, q: Float[AnyArray, "*row q"]) -> NormalEquations:
        """The normal equations at a point."""
        ...

    def of(self, rows: Int[np.ndarray, " some"]) -> "Problem":
        """Some of the rows."""
        ...


@runtime_checkable
class Curved(Problem, Protocol):
    """Terms whose curvature steps can follow."""

    def bend(
        self,
        q: Float[AnyArray, "*row q"],
        at: NormalEquations,
        move: Float[AnyArray, "*row q"],
    ) -> Float[AnyArray, "*row q"]:
        """Jᵀ r″ of a step from a point, where the normal equations are known."""
        ...


class State(NamedTuple):
    """Where Levenberg-Marquardt is.

    Attributes:
        q: The best point.
        equations: The normal equations there.
        enough: Reduction of the objective by a step, below which a row may be at its minimum.
        scale: Largest scale of the equations so far.
        damping: Damping of the next step, relative to the diagonal.
        idle: Steps in a row that have not reduced the objective by more than is enough.
        move: The next step.
        moves: Whether it is taken.
        steps: Number of steps.
    """

    q: Float[AnyArray, "*row q"]
    equations: NormalEquations
    enough: Float[AnyArray, "*row"]
    scale: Float[AnyArray, "*row q"]
    damping: Float[AnyArray, "*row"]
    idle: Int[AnyArray, "*row"]
    move: Float[AnyArray, "*row q"]
    moves: Bool[AnyArray, "*row"]
    steps: Int[AnyArray, "*row"]


@dataclasses.dataclass(frozen=True)
class LevenbergMarquardt:
    """The minimum of a few terms.

    Attributes:
        damping: Damping of the first step.
        steps: Largest number of steps.
        patience: So many steps in a row that bring no more than is enough end the search; the last
            of them is not taken.
        curved: Whether steps follow the curvature of the terms, which are then `Curved`.
        relative: Part of the objective that is always enough.
        free: Parameters that move; None for all.
    """

    damping: Float[AnyArray, ""] | float
    steps: int
    patience: int = 1
    curved: bool = False
    relative: float = 0.0
    free: Bool[AnyArray, " q"] | None = None

    def __call__(
        self,
        problem: Problem,
        start: Float[AnyArray, "*row q"],
        first: NormalEquations,
        enough: Float[AnyArray, "*row"] | float,
    ) -> State:
        """The minimum from a first point, where the normal equations are known."""
        xp = namespace(start)
        none = xp.zeros_like(first.objective)
        counted, finite = xp.zeros(none.shape, int), xp.isfinite(first.objective)
        of = enough + none, xp.zeros_like(start), self.damping + none, counted, start
        return self.further(
            problem, self._proposed(problem, State(start, first, *of, finite, counted))
        )

    def further(self, problem: Problem, state: State) -> State:
        """The minimum from where a search was."""
        if namespace(state.q) is np:
            return self._row_by_row(problem, state)
        return repeated(lambda state: self._step(problem, state), state, self.steps)

    def _row_by_row(self, problem: Problem, whole: State) -> State:
        """Steps of the rows that still move, in NumPy."""
        state, rows = whole, None
        for _ in range(self.steps):
            if not state.moves.all():
                live = np.flatnonzero(state.moves)
                whole = state if rows is None else replaced(whole, rows, state)
                if not live.size:
                    return whole
                rows = live if rows is None else rows[live]
                problem, state = problem.of(live), taken(state, live)
            state = self._step(problem, state)
        return state if rows is None else replaced(whole, rows, state)

    def _proposed(self, problem: Problem, state: State) -> State:
        xp, at = namespace(state.q), state.equations
        at = at if self.free is None else at.along(self.free)
        scale = xp.maximum(state.scale, at.scale)
        move = at.step(state.damping, scale)
        ends = state.idle + (at.promised(move) <= self._enough(state)) >= self.patience
        if self.curved:
            bent = at._replace(gradient=cast("Curved", problem).bend(state.q, at, move))
            turned = 0.5 * bent.step(state.damping, scale)
            sizes = [xp.sqrt(((one * scale) ** 2).sum(-1)) for one in (turned, move)]
            small = 4 * sizes[0] <= ACCELERATION * sizes[1]
            move = move + xp.where(small[..., None], turned, 0.0)
        return state._replace(scale=scale, move=move, moves=state.moves & ~ends)

    def _step(self, problem: Problem, state: State) -> State:
        xp = namespace(state.q)
        trial = xp.where(state.moves[..., None], state.q + state.move, state.q)
        new, old = problem.equations(trial), state.equations
        promised, reduced = old.promised(state.move), old.objective - new.objective
        finite = xp.isfinite(new.gradient).all(-1)
        better = state.moves & finite & (reduced >= 0)
        good = better & (reduced >= GOOD * promised)
        damping = xp.where(better, state.damping, xp.maximum(state.damping, LEAST) * 4)
        damping = xp.where(good, 0.2 * state.damping, damping)
        small = xp.maximum(promised, reduced) <= self._enough(state)
        idle = xp.where(better, xp.where(small, state.idle + 1, 0), state.idle)
        q, *kept = chosen(better, (trial, *new), (state.q, *old))
        steps = state.steps + state.moves
        found = state._replace(q=q, damping=damping, idle=idle, steps=steps)
        return self._proposed(problem, found._replace(equations=NormalEquations(*kept)))

    def _enough(self, state: State) -> Float[AnyArray, "*row"]:
        least = self.relative * state.equations.objective
        return namespace(least).maximum(state.enough, least)


def bend(
    at: NormalEquations,
    ahead: Float[AnyArray, "*row term"],
    move: Float[AnyArray, "*row q"],
) -> Float[AnyArray, "*row q"]:
    """Jᵀ r″ of a step, from the terms `DIFFERENCE` of it ahead of the point."""
    assert at.rows is not None
    slope = (at.rows * move[..., :, None]).sum(-2)
    bent = 2 / DIFFERENCE * ((ahead - at.terms) / DIFFERENCE - slope)
    return (at.rows @ bent[..., None])[..., 0]


def taken(of: Arrays, rows: np.ndarray) -> Arrays:
    """Some rows of all arrays."""
    return jax.tree.map(lambda leaf: leaf[rows], of)


def replaced(of: Arrays, rows: np.ndarray, by: Arrays) -> Arrays:
    """All arrays, some rows of which are replaced."""

    def one(leaf: np.ndarray, other: np.ndarray) -> np.ndarray:
        leaf = leaf.copy()  # the impedance of a resistor is one number at all frequencies
        leaf[rows] = other
        return leaf

    return jax.tree.map(one, of, by)


def chosen(
    rows: Bool[AnyArray, "*row"], new: Sequence[AnyArray], old: Sequence[AnyArray]
) -> list[AnyArray]:
    """Arrays of `new` in these rows, of `old` in the others; None stays None."""
    xp, found = namespace(rows), []
    for a, b in zip(new, old, strict=True):
        wide = None if a is None else rows.reshape(rows.shape + (1,) * (a.ndim - rows.ndim))
        found.append(None if a is None else xp.where(wide, a, b))
    return found


def repeated(step: Callable[[Any], Any], state: Any, steps: int) -> Any:
    """Steps until no row `moves`: a loop of Python for NumPy, one of JAX for JAX."""
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


class _Conjugate(NamedTuple):
    """Where conjugate gradients are: solution, what is left, next direction, size of what is left.

    `moves` says whether this is not small yet.
    """

    x: Float[AnyArray, " q"]
    left: Float[AnyArray, " q"]
    way: Float[AnyArray, " q"]
    size: Float[AnyArray, ""]
    moves: Bool[AnyArray, ""]


def conjugate_gradients(
    product: Callable[[Any], Any], inverse: Float[AnyArray, "q q"], b: Float[AnyArray, " q"]
) -> Float[AnyArray, " q"]:
    """Solution of H x = b under JAX, with derivatives in b.

    `jax.scipy.sparse.linalg.cg` fails in the gradient of many rows (`jax.vmap`).

    Args:
        product: H times a vector; H is positive definite.
        inverse: Nearly the inverse of H; the better it is, the fewer products are needed.
        b: The right side.
    """

    def solve(product: Callable[[Any], Any], b: Float[AnyArray, " q"]) -> Float[AnyArray, " q"]:
        way = inverse @ b
        whole = b @ way

        def step(of: _Conjugate) -> _Conjugate:
            along = product(of.way)
            far = of.size / (of.way @ along)
            left = of.left - far * along
            back = inverse @ left
            size = left @ back
            x, way = of.x + far * of.way, back + size / of.size * of.way
            return _Conjugate(x, left, way, size, size > LEFT**2 * whole)

        start = _Conjugate(namespace(b).zeros_like(b), b, way, whole, whole > 0)
        return repeated(step, start, PRODUCTS).x

    return jax.lax.custom_linear_solve(product, b, solve, solve, symmetric=True)
