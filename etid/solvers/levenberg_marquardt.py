"""Levenberg-Marquardt on normal equations, built from optimistix parts.

`optimistix.LevenbergMarquardt` carries the residual and its Jacobian in the solver's state. Under
`vmap`, a step of one lane selects between two copies of this state for all lanes. With thousands of
samples, that costs about twelve times as much as the step itself. Here the state holds only the
objective, its gradient and the p×p Gauss-Newton matrix. These solve the damped step;
`optimistix.ClassicalTrustRegion` accepts it and sets the damping.

Three properties make the method independent of the scale of parameters and residual:

- **Marquardt scaling.** The step is solved in z = D y with D² = diag(JᵀJ), the largest value so far
  (Moré 1978). To multiply a parameter by a constant therefore changes no iterate.
- **Stopping on an angle.** The relative offset of Bates & Watts (1981) is the sine of the angle
  between the residual and the tangent plane. It has no unit. Times √(samples) it is the distance to
  the minimum in standard errors. A step too small to move the parameters is *not* convergence: a
  solver that cannot move must not report success.
- **Rejection of trial steps whose residual or slope is not finite**, as if their objective were
  infinite.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int, PyTree

from etid.solvers.matrices import diagonal

RIDGE = 1e-13  # of the scaled matrix, for directions that double precision cannot resolve
ROUNDING = 4.0  # rounding error of the model [ε]
IDLE_STEPS = 3  # accepted steps in a row without progress, while the steps grow fivefold
ACCELERATION = 0.75  # largest second-order part relative to the step (Transtrum and Sethna)
STALLED_STEP = 1e-15  # a relative step that no longer changes the parameters in double precision


class NormalEquations(eqx.Module):
    """Objective ½|r|², gradient Jᵀr and Gauss-Newton matrix JᵀJ of a residual r."""

    objective: Float[Array, ""]
    gradient: Float[Array, " parameter"]
    matrix: Float[Array, "parameter parameter"]

    @classmethod
    def of(
        cls, terms: Float[Array, " term"], rows: Float[Array, "parameter term"]
    ) -> "NormalEquations":
        """Those of terms r whose derivatives with respect to each parameter are `rows`, Jᵀ."""
        return cls(0.5 * jnp.dot(terms, terms), rows @ terms, rows @ rows.T).finite()

    def scaled(self, by: Float[Array, " parameter"]) -> "NormalEquations":
        """The normal equations in the parameters z = `by` · y."""
        matrix = self.matrix / by[:, None] / by[None, :]
        return NormalEquations(self.objective, self.gradient / by, matrix)

    def finite(self) -> "NormalEquations":
        """The normal equations, with an infinite objective if value or slope is not finite.

        A point whose slope is not finite is useless too: no step can start from it.
        """
        finite = jnp.isfinite(self.objective) & jnp.isfinite(self.gradient).all()
        return dataclasses.replace(self, objective=jnp.where(finite, self.objective, jnp.inf))

    def step(self, damping: Float[Array, ""]) -> Float[Array, " parameter"]:
        """−(JᵀJ + damping · I)⁻¹ Jᵀr; not finite if this matrix is not positive definite."""
        damped = self.matrix + damping * np.eye(self.gradient.size)
        return -cho_solve(cho_factor(damped), self.gradient)

    def newton(self) -> Float[Array, " parameter"]:
        """The step without damping; directions without effect take no part."""
        scale = jnp.sqrt(diagonal(self.matrix))
        scale = jnp.where(scale > 0, scale, 1.0)
        return self.scaled(scale).step(jnp.asarray(RIDGE, scale.dtype)) / scale

    @property
    def info(self) -> Any:  # FunctionInfo.EvalGradHessian
        """The same for the search of optimistix."""
        matrix = lx.MatrixLinearOperator(self.matrix, lx.positive_semidefinite_tag)
        return optx.FunctionInfo.EvalGradHessian(self.objective, self.gradient, matrix)


def normal_equations(
    residual: Callable[[Float[Array, " parameter"], Any], Float[Array, " sample"]],
    y: Float[Array, " parameter"],
    args: Any = None,
) -> NormalEquations:
    """Normal equations of `residual(y, args)`, by forward differentiation."""

    def twice(
        y: Float[Array, " parameter"],
    ) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
        r = residual(y, args)
        return r, r

    jacobian, r = jax.jacfwd(twice, has_aux=True)(y)
    return NormalEquations.of(r, jacobian.T)


Residual = Callable[[Array, Any], tuple[Array, Any]]
"""A residual function of optimistix: (y, args) to the residual and an auxiliary output."""


class State(eqx.Module):
    """What a step needs of those before it."""

    first_step: Bool[Array, ""]
    y_eval: Float[Array, " parameter"]
    accepted: NormalEquations
    scale: Float[Array, " parameter"]
    search_state: Any
    terminate: Bool[Array, ""]
    result: optx.RESULTS
    accepted_steps: Int[Array, ""]
    idle: Int[Array, ""]


def _value(fn: Residual) -> Callable[[Array, Any], Array]:
    """`fn` without its auxiliary output."""
    return lambda y, args: fn(y, args)[0]


def _select(pred: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """`new` where `pred`, else `old`."""
    return jax.tree.map(lambda a, b: jnp.where(pred, a, b), new, old)


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt for `optimistix.least_squares`, with O(p²) state.

    The residual function takes and returns one-dimensional arrays.

    Attributes:
        rtol: Stop when the relative offset is below this. The relative offset is |Q₁ᵀ r| / |r|,
            where Q₁ is a basis of the range of J.
        atol: Stop when the remaining scaled Gauss-Newton step is below this times the scaled
            parameters (for problems without noise, where the residual itself vanishes).
        ftol: Stop when several accepted steps in a row each reduce |r|² by less than this fraction,
            and each predicted no larger reduction. A valley whose floor is flat within rounding,
            for example of a superfluous pole, never meets the two criteria above.
        damping: Damping of the first step, relative to the unit diagonal of the scaled matrix.
        norm: Norm of the scaled step and parameters.
        search: Accepts or rejects the step and sets the damping.
        equations: Evaluates the normal equations of `fn(y, args)`.
        bend: Jᵀ r″ of `fn(y, args)` at y, from (y, step, args), where r″ is the second derivative
            along the step. With it, steps follow the curvature of the model (Transtrum and Sethna
            2012, arXiv:1201.5885), which takes fewer of them in curved valleys.
    """

    rtol: float | Float[Array, ""] = 1e-6  # pyright: ignore[reportIncompatibleVariableOverride]
    atol: float = 1e-12
    ftol: float | Float[Array, ""] = 1e-8
    damping: float | Float[Array, ""] = 1e-2
    norm: Callable[[PyTree], Array] = optx.two_norm
    # MINPACK's threshold, and two constants that are not powers of each other. With 10 and 1/10 the
    # damping returns again and again to the value just rejected; a curved valley then takes three
    # times as many steps.
    search: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion(
        high_cutoff=0.75, high_constant=5.0, low_constant=0.25
    )
    equations: Callable[[Any, Array, Any], NormalEquations] = normal_equations
    bend: Callable[[Array, Array, Any], Array] | None = None

    def init(
        self,
        fn: Residual,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree[jax.ShapeDtypeStruct],
        aux_struct: PyTree[jax.ShapeDtypeStruct],
        tags: frozenset[object],
    ) -> State:
        """The state before the first step, for normal equations with one matrix."""
        del fn, args, options, f_struct, aux_struct, tags
        matrix = jnp.zeros((y.size, y.size), y.dtype)
        return self.started(y, NormalEquations(jnp.zeros((), y.dtype), jnp.zeros_like(y), matrix))

    def started(self, y: Array, zero: NormalEquations) -> State:
        """The state before the first step, which evaluates `y` itself; `zero` is of zeros."""
        return State(
            first_step=jnp.array(True),
            y_eval=y,
            accepted=zero,
            scale=jnp.zeros_like(y),
            search_state=self.search.init(y, zero.info),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
            accepted_steps=jnp.array(0),
            idle=jnp.array(0),
        )

    def step(
        self,
        fn: Residual,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        state: State,
        tags: frozenset[object],
    ) -> tuple[Array, State, None]:
        """Evaluate the trial point, accept or reject it, and propose the next trial point."""
        del options, tags
        trial = self.equations(_value(fn), state.y_eval, args)
        step_size, accept, _, search_state = self.search.step(
            state.first_step,
            y,
            state.y_eval,
            state.accepted.info,
            trial.info,
            state.search_state,
        )
        accept = accept & jnp.isfinite(trial.objective) | state.first_step
        tried = state.y_eval - y
        promised = -self.search.predict_reduction(tried, state.accepted.info)
        reduced = state.accepted.objective - trial.objective
        negligible = jnp.maximum(jnp.abs(reduced), promised) <= self.ftol * trial.objective
        # One such step proves nothing: a step after a rejection is short, so it reduces little.
        idle = jnp.where(negligible & ~state.first_step, state.idle + 1, 0)
        idle = jnp.where(accept, idle, state.idle)
        accepted = _select(accept, trial, state.accepted)
        y = jnp.where(accept, state.y_eval, y)
        sizes = jnp.sqrt(diagonal(accepted.matrix))
        scale = jnp.maximum(state.scale, sizes)
        safe = jnp.where(scale > 0, scale, 1.0)

        # The step is solved in z = D y.
        scaled = accepted.scaled(safe)
        size, limits = step_size / self.damping, jnp.finfo(y.dtype)
        damping = jnp.where(size > limits.eps, 1 / size, limits.max)
        # If the factorisation fails, the proposed step is not finite. The next trial rejects it and
        # raises the damping.
        # The step without damping, of which the tests below ask, is solved at once with it.
        both = jnp.stack([damping, jnp.asarray(RIDGE, y.dtype)])
        proposed, newton = jax.vmap(scaled.step)(both)
        size = self.norm(safe * y)
        offset = -jnp.dot(newton, scaled.gradient)  # |Q₁ᵀ r|²
        squares = 2 * accepted.objective
        converged = offset <= self.rtol**2 * squares
        # The rounding error of the residual is ε times the model, which is about |J y|. A reduction
        # of |r|² below |r| times this error is invisible, and a rejected step then means nothing.
        model = self.norm(sizes * y)
        unseen = offset <= ROUNDING * jnp.finfo(y.dtype).eps * jnp.sqrt(squares) * model
        converged = converged | (unseen & ~accept)
        converged = converged | (idle >= IDLE_STEPS) | (self.norm(newton) <= self.atol * size)
        stalled = (self.norm(safe * tried) <= STALLED_STEP * size) & ~state.first_step
        finite = jnp.isfinite(accepted.objective)
        terminate = converged | stalled | ~finite
        failed = ~finite | (stalled & ~converged)
        result = optx.RESULTS.where(
            failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        if (bend := self.bend) is not None:

            def bent_step() -> Array:
                bent = bend(y, proposed / safe, args) / safe
                bent = eqx.tree_at(lambda e: e.gradient, scaled, bent)
                turned = bent.step(damping)
                small = 2 * self.norm(turned) <= ACCELERATION * self.norm(proposed)
                return proposed + jnp.where(small, 0.5 * turned, 0.0)

            proposed = jax.lax.cond(terminate, lambda: proposed, bent_step)
        state = State(
            first_step=jnp.array(False),
            y_eval=y + proposed / safe,
            accepted=accepted,
            scale=scale,
            search_state=search_state,
            terminate=terminate,
            result=result,
            accepted_steps=state.accepted_steps + jnp.where(accept, 1, 0),
            idle=idle,
        )
        return y, state, None

    def terminate(
        self,
        fn: Residual,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        state: State,
        tags: frozenset[object],
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether to stop, and the verdict so far."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(
        self,
        fn: Residual,
        y: Array,
        aux: Any,
        args: PyTree,
        options: dict[str, Any],
        state: State,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Array, Any, dict[str, Any]]:
        """Return the normal equations at the solution as statistics: the covariance needs them."""
        del fn, args, options, tags, result
        stats = {"normal_equations": state.accepted, "accepted_steps": state.accepted_steps}
        return y, aux, stats
