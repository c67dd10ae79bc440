"""The fit of one pulse at one electrode: the likeliest delay, and a step from there.

The gain in a band is Ĝ = G e^(−jωτ) + what has aliased + what a band makes of a curve; the last two
are small, and taken out as the elements before the pulse have them.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.circuit import AbstractCircuit
from etid.estimators.estimate import DELAY_WIDTH
from etid.online.gain_bands import Bands
from etid.signals.transfer import as_complex, power, reciprocal
from etid.solvers.matrices import inverse_of_few

STEP = 0.1  # [samples]
DELAYS = STEP * np.arange(-15, 16)  # [samples] one of a trigger, half a one of a window
DAMPING, LOWER, RAISE = 1e-2, 0.1, 8.0  # of the first step, after a good one, after a bad one
SETTLED = 1.0  # standard errors of a pulse from the minimum, before the last step


def _unit(angle: Float[Array, "..."]) -> Complex[Array, "..."]:
    """e^(j angle)."""
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


class GainModel(eqx.Module):
    """What a pulse should be.

    Attributes:
        circuit: Structure of the load.
        bands: The unloaded pulse.
        source: Z_th [Ω].
        source_alias: Z_th where aliases come from [Ω].
        turn: Turn of the gain by a delay of one sample [rad].
        turns: e^(jωτ) for each of `DELAYS`.
    """

    circuit: AbstractCircuit
    bands: Bands
    source: Complex[Array, " band"]
    source_alias: Complex[Array, " band"]
    turn: Float[Array, " band"]
    turns: Complex[Array, "delay band"]

    @classmethod
    def of(
        cls,
        circuit: AbstractCircuit,
        bands: Bands,
        source: Complex[Array, " band"],
        source_alias: Complex[Array, " band"],
    ) -> "GainModel":
        """The model with the turns of its delays."""
        turn = 2 * jnp.pi * bands.frequency / bands.sample_rate
        turns = _unit(jnp.asarray(DELAYS)[:, None] * turn[None, :])
        return cls(circuit, bands, source, source_alias, turn, turns)

    def gain(
        self, logs: Float[Array, " element"]
    ) -> tuple[Complex[Array, " band"], Complex[Array, "element band"]]:
        """G and its derivative by the elements."""

        def load(logs):
            return self.circuit.with_log_values(logs).response(self.bands.frequency)

        z = load(logs)
        by_element = jax.vmap(lambda v: jax.jvp(load, (logs,), (v,))[1])(jnp.eye(logs.size))
        admittance = reciprocal(z + self.source)
        return z * admittance, by_element * (self.source * admittance * admittance)[None, :]

    def departure(self, own: Float[Array, " own"]) -> Complex[Array, " band"]:
        """What Ĝ holds besides G e^(−jωτ): aliases, and what a band makes of a curve."""
        load, delay = self.circuit.with_log_values(own[:-1]), own[-1]
        above = load.response(self.bands.sample_rate - self.bands.frequency)
        aliased = jnp.conj(above * reciprocal(above + self.source_alias)) * self.bands.alias
        departure = aliased * _unit(2 * jnp.pi * delay)
        departure = departure + self.bands.departure(self.undelayed(own[:-1]), delay)
        return departure * jnp.conj(self.turned(delay))

    def turned(self, delay: Float[Array, ""]) -> Complex[Array, " band"]:
        """e^(jωτ), from a table and its Taylor series: a sine costs as much as all the rest."""
        near = jnp.clip(jnp.round((delay - DELAYS[0]) / STEP), 0, DELAYS.size - 1).astype(int)
        angle = (delay - jnp.asarray(DELAYS)[near]) * self.turn
        square = angle * angle
        cosine = 1 - square / 2 * (1 - square / 12 * (1 - square / 30))
        sine = angle * (1 - square / 6 * (1 - square / 20 * (1 - square / 42)))
        return self.turns[near] * jax.lax.complex(cosine, sine)

    def distances(
        self, gain: Complex[Array, " band"], expected: Complex[Array, " band"]
    ) -> Float[Array, " delay"]:
        """How far `gain` is from what is expected, for each delay of `DELAYS`."""
        product = as_complex(self.bands.weight) * jnp.conj(expected) * gain
        parts = jnp.concatenate([product.real, -product.imag])
        turns = jnp.concatenate([self.turns.real, self.turns.imag], axis=1)
        return jnp.sum(self.bands.weight * power(expected)) - 2 * turns @ parts

    def undelayed(self, logs: Float[Array, " element"]) -> Complex[Array, " band"]:
        """The gain without a delay."""
        z = self.circuit.with_log_values(logs).response(self.bands.frequency)
        return z * reciprocal(z + self.source)


def nearest(
    model: GainModel, gain: Complex[Array, " band"], logs: Float[Array, "start element"]
) -> tuple[Float[Array, " own"], Float[Array, ""]]:
    """Which of several elements, with which delay, comes next to a gain, and how near."""
    distances = jax.vmap(lambda one: model.distances(gain, model.undelayed(one)))(logs)
    best = jnp.argmin(distances)
    start, at = best // DELAYS.size, best % DELAYS.size
    # A parabola through the distances beside it: a tenth of a sample is a hundred standard errors.
    around = distances[start, jnp.clip(at, 1, DELAYS.size - 2) + jnp.arange(-1, 2)]
    curved = around[0] - 2 * around[1] + around[2]
    delay = DELAYS[0] + STEP * (at.astype(around.dtype) + 0.5 * (around[0] - around[2]) / curved)
    inside = (at > 0) & (at < DELAYS.size - 1) & (curved > 0)
    delay = jnp.where(inside, delay, jnp.asarray(DELAYS)[at])
    return jnp.append(logs[start], delay), distances.reshape(-1)[best]


class Equations(NamedTuple):
    """Normal equations of a pulse, and of what was known before it.

    Attributes:
        objective: Σ r² of both.
        squares: Σ r² of the pulse.
        gradient: Jᵀr of both.
        curvature: JᵀJ of the pulse.
        matrix: JᵀJ of both.
    """

    objective: Float[Array, ""]
    squares: Float[Array, ""]
    gradient: Float[Array, " own"]
    curvature: Float[Array, "own own"]
    matrix: Float[Array, "own own"]


def minimum(
    equations: Callable[[Float[Array, " own"]], Equations],
    start: Float[Array, " own"],
    damping: Float[Array, ""],
) -> tuple[Float[Array, " own"], Equations, Float[Array, ""], Float[Array, ""]]:
    """A step of Levenberg and Marquardt's and, where that was the last but one, one of Newton's.

    Returns:
        The minimum, or what was reached of the way to it; the last equations; by how much Σ r² was
        to fall from there; and the damping with which to go on.
    """
    before = equations(start)
    matrix = before.matrix + damping * jnp.diag(jnp.diagonal(before.matrix))
    trial = start - inverse_of_few(matrix) @ before.gradient
    after = equations(trial)
    better = after.objective <= before.objective
    own = jnp.where(better, trial, start)
    at = jax.tree.map(lambda new, old: jnp.where(better, new, old), after, before)
    step = inverse_of_few(at.matrix) @ at.gradient
    decrement = jnp.dot(step, at.gradient)
    own = jnp.where(decrement < SETTLED**2, own - step, own)
    return own, at, decrement, damping * jnp.where(better, LOWER, RAISE)


class Pulse(eqx.Module):
    """What is minimised for one electrode at one pulse."""

    model: GainModel
    gain: Complex[Array, " band"]
    variance: Float[Array, ""]
    centre: Float[Array, " element"]
    information: Float[Array, "element element"]

    def terms(self, q: Float[Array, " own"]) -> Float[Array, "own1 part"]:
        """Derivatives of the residual and, last, the residual, in standard deviations."""
        of = self.model
        weight = as_complex(jnp.sqrt(of.bands.weight / self.variance))
        model, slope = of.gain(q[:-1])
        # By the delay it is jω Ĝ e^(jωτ), of which the noise is left out: it would be information.
        by_delay = model * jax.lax.complex(jnp.zeros_like(of.turn), of.turn)
        residual = self.gain * of.turned(q[-1]) - model
        rows = jnp.concatenate([-slope, by_delay[None, :], residual[None, :]]) * weight[None, :]
        return jnp.concatenate([rows.real, rows.imag], axis=1)

    def equations(self, q: Float[Array, " own"]) -> Equations:
        """Normal equations."""
        terms = self.terms(q)
        products = terms @ terms.T
        off = q[:-1] - self.centre
        pull = jnp.append(self.information @ off, q[-1] / DELAY_WIDTH**2)
        squares, curvature = products[-1, -1], products[:-1, :-1]
        prior = jnp.pad(self.information, (0, 1)).at[-1, -1].set(1 / DELAY_WIDTH**2)
        return Equations(
            squares + jnp.dot(pull, jnp.append(off, q[-1])),
            squares,
            products[:-1, -1] + pull,
            curvature,
            curvature + prior,
        )
