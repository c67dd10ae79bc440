"""One step of Levenberg-Marquardt, from a state that is set by hand."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from etid.solvers.levenberg_marquardt import (
    LevenbergMarquardt,
)

TARGET = jnp.array([5.0, -2.0])
DAMPING = 1e-2
NEVER = LevenbergMarquardt(rtol=0.0, atol=0.0, ftol=1e-8, damping=DAMPING)  # converged by size


def distance(y, args):
    """JᵀJ is one, and a residual of 1 is left."""
    del args
    return jnp.append(y - TARGET, 1.0), None


@eqx.filter_jit
def stepped(solver, y, state):
    y, state, _ = solver.step(distance, y, None, {}, state, frozenset())
    return y, state


def after(solver, y, trials):
    """The states after the first step from y, and after one to each of the trials in turn."""
    state = solver.init(distance, y, None, {}, None, None, frozenset())
    states = []
    for trial in (y, *trials):
        y, state = stepped(solver, y, dataclasses.replace(state, y_eval=trial))
        states.append((y, state))
    return states


@pytest.mark.parametrize(("part", "accepted"), [(0.3, True), (0.37, True), (0.38, False)])
def test_a_step_is_bent_where_the_second_order_is_small_beside_it(part, accepted):
    """2 |a| ≤ ¾ |v|; the step is v + ½ a then."""
    y = TARGET + jnp.array([30.0, 40.0])

    def bend(y, step, args):
        return part * (y - TARGET)

    solver = LevenbergMarquardt(damping=DAMPING, bend=bend)
    [(_, state)] = after(solver, y, [])
    plain = -(y - TARGET) / (1 + DAMPING)
    np.testing.assert_allclose(state.y_eval - y, plain * (1 + 0.5 * part * accepted), rtol=1e-12)


def test_three_steps_that_change_nothing_are_the_end():
    y = TARGET + 1e-5  # Σ r² of 1 can fall by 2e-10
    trials = [TARGET + 1e-5 * (1 - i / 10) for i in range(1, 4)]
    states = after(NEVER, y, trials)
    assert [int(state.idle) for _, state in states] == [0, 1, 2, 3]
    assert [int(state.accepted_steps) for _, state in states] == [1, 2, 3, 4]
    assert [bool(state.terminate) for _, state in states] == [False] * 3 + [True]
    assert states[-1][1].result == optx.RESULTS.successful


def test_a_step_that_changes_something_begins_the_count_anew_and_a_rejected_one_keeps_it():
    y = TARGET + 3.0
    little, much, worse = y - 1e-9, y - 1.0, y + 10.0
    states = after(NEVER, y, [little, worse, little - 1e-9, much])
    assert [int(state.idle) for _, state in states] == [0, 1, 1, 2, 0]
    assert [int(state.accepted_steps) for _, state in states] == [1, 2, 2, 3, 4]
    np.testing.assert_array_equal(states[2][0], little)  # a worse point is not taken
    assert not any(bool(state.terminate) for _, state in states)


def test_a_step_of_rounding_size_far_from_the_minimum_is_a_failure():
    y = TARGET + 3.0
    states = after(NEVER, y, [y])
    assert not bool(states[0][1].terminate)  # the first step goes nowhere by definition
    assert bool(states[1][1].terminate)
    assert states[1][1].result == optx.RESULTS.nonlinear_divergence
    # Where it is converged as well, it is none.
    converged = dataclasses.replace(NEVER, rtol=1e-6)
    near = jax.tree.map(lambda a: a + 1e-9, TARGET)
    assert after(converged, near, [near])[1][1].result == optx.RESULTS.successful
