"""The minimum of a sum of squares, with its derivative by the implicit function theorem."""

import dataclasses
from collections.abc import Callable
from inspect import unwrap
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from etid.solvers.levenberg_marquardt import LevenbergMarquardt, State

Terms = Callable[[Float[Array, " parameter"], Any], Float[Array, " term"]]
Search = Callable[[Float[Array, " parameter"], Any], tuple[Float[Array, " parameter"], Any]]


def minimum(
    terms: Terms, search: Search, start: Float[Array, " parameter"], args: Any
) -> tuple[Float[Array, " parameter"], Any]:
    """The minimum of Σ r² over q, and what else the search returns, which has no derivative.

    Args:
        terms: r(q, args). Only a derivative traces it.
        search: The minimum from a start and args, and anything else. Both functions hold no arrays.
        start: First q.
        args: Arrays of the problem.
    """
    inputs = terms, search, start, args
    # Optimistix wants functions without a wrapper, also where a hook checks types.
    return optx.ImplicitAdjoint().apply(unwrap(_found), unwrap(_gradient), inputs, frozenset())


def _found(inputs: Any) -> Any:
    _, search, start, args, _ = inputs
    return search(start, args)


def _gradient(q: Array, _: Any, inputs: Any) -> Array:
    """∂(½ Σ r²)/∂q, which vanishes at the minimum."""
    terms, _, _, args, *_ = inputs
    return jax.grad(lambda q: 0.5 * jnp.sum(terms(q, args) ** 2))(q)


def least_squares(
    terms: Terms,
    solver: LevenbergMarquardt,
    start: Float[Array, " parameter"],
    args: Any,
    max_steps: int,
) -> optx.Solution:
    """The minimum of Σ r² over q, as by `optimistix.least_squares`.

    That function traces the terms to learn their shapes, and the solver once more. Here the terms
    are traced only for a derivative: the solver evaluates its own equations.

    Args:
        terms: r(q, args); a function that holds no arrays.
        solver: Its equations are those of these terms; `ftol` may be an array.
        start: First q.
        args: Arrays of the problem.
        max_steps: Largest number of trial steps.
    """

    def search(start: Array, of: Any) -> tuple[Array, Any]:
        args, ftol = of
        return stepped(terms, dataclasses.replace(solver, ftol=ftol), start, args, max_steps)

    of = args, jnp.asarray(solver.ftol)
    value, (steps, result, equations) = minimum(lambda q, of: terms(q, of[0]), search, start, of)
    stats = {"num_steps": steps, "normal_equations": equations}
    return optx.Solution(value=value, result=result, aux=None, stats=stats, state=None)


def stepped(
    terms: Terms | None,
    solver: LevenbergMarquardt,
    start: Float[Array, " parameter"],
    args: Any,
    max_steps: int,
) -> tuple[Float[Array, " parameter"], Any]:
    """The minimum; the number of steps, the verdict, and the normal equations there.

    The arguments are those of `least_squares`; `terms` is None if the solver has equations of its
    own. The result has no derivative.
    """

    def fn(q: Array, args: Any) -> tuple[Array, None]:
        assert terms is not None
        return terms(q, args), None

    # JAX remembers the trace of this function: its shapes and its use in the loop need only one.
    equations = solver.equations
    evaluate = jax.jit(lambda q: equations(terms, q, args))
    solver = dataclasses.replace(solver, equations=lambda _, q, __: evaluate(q))
    shapes = jax.eval_shape(evaluate, start)
    nothing = jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes)

    def goes_on(carry: tuple[Array, State, Array]) -> Array:
        _, state, steps = carry
        return ~state.terminate & (state.result == optx.RESULTS.successful) & (steps < max_steps)

    def step(carry: tuple[Array, State, Array]) -> tuple[Array, State, Array]:
        q, state, steps = carry
        q, state, _ = solver.step(fn, q, args, {}, state, frozenset())
        return q, state, steps + 1

    state = solver.started(start, nothing)
    finite = jnp.isfinite(start).all()
    state = dataclasses.replace(
        state,
        result=optx.RESULTS.where(finite, state.result, optx.RESULTS.nonfinite),
    )
    q, state, steps = jax.lax.while_loop(goes_on, step, (start, state, jnp.array(0)))
    result = optx.RESULTS.where(
        (state.result == optx.RESULTS.successful) & ~state.terminate,
        optx.RESULTS.nonlinear_max_steps_reached,
        state.result,
    )
    return q, (steps, result, state.accepted)
