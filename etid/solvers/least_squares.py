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
        solver: Its equations are those of these terms.
        start: First q.
        args: Arrays of the problem.
        max_steps: Largest number of trial steps.
    """
    inputs = terms, solver, start, args, max_steps
    # Optimistix wants functions without a wrapper, also where a hook checks types.
    found = optx.ImplicitAdjoint().apply(unwrap(_minimum), unwrap(_gradient), inputs, frozenset())
    value, (steps, result, equations) = found
    stats = {"num_steps": steps, "normal_equations": equations}
    return optx.Solution(value=value, result=result, aux=None, stats=stats, state=None)


def _minimum(inputs: Any) -> Any:
    """The minimum; the number of steps, the verdict, and the normal equations there."""
    terms, solver, start, args, max_steps, _ = inputs

    def fn(q: Array, args: Any) -> tuple[Array, None]:
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


def _gradient(q: Array, _: Any, inputs: Any) -> Array:
    """∂(½ Σ r²)/∂q, which vanishes at the minimum."""
    terms, _, _, args, *_ = inputs
    return jax.grad(lambda q: 0.5 * jnp.sum(terms(q, args) ** 2))(q)
