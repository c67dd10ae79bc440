"""The fit of one pulse at one electrode: the best delay of a grid, and two steps from there.

The gain in a band is Ĝ = G e^(−jωτ) + aliases + the effect of the curvature of G over the band. The
last two terms are small. They are computed with the start values and subtracted before the fit.

Both steps use the derivatives at the start. If the start is off by ε, the first step leaves an
error of the order of ε², and the second one of ε³.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.circuits.circuit import AbstractCircuit, impedance_at, with_slopes
from etid.circuits.directions import DIRECTIONS, ON_LOADS, At, spread
from etid.display.discrepancy import Smooth, functions
from etid.display.gain_bands import Bands
from etid.display.noise import cleared
from etid.estimators.maximum_likelihood.given_driver import GivenDriver
from etid.estimators.maximum_likelihood.rows import source_of
from etid.estimators.online import LATEST
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.source_prior import DELAY_WIDTH
from etid.precision import Module, array_function, namespace
from etid.signals.harmonics import real_parts
from etid.signals.transfer import (
    AnyArray,
    as_complex,
    combined,
    from_parts,
    power,
    reciprocal,
)
from etid.solvers.matrices import inverse_of_few, root

STEP = LATEST / 15  # [samples] spacing of the grid of delays
DELAYS = STEP * np.arange(-15, 16)  # [samples]
SEARCH = 40  # largest number of steps of a search
SETTLED = 1.0  # distance to the minimum before the last step [standard errors of one pulse]


def _unit(angle: Float[AnyArray, "..."]) -> Complex[AnyArray, "..."]:
    """e^(j angle)."""
    xp = namespace(angle)
    return from_parts(xp.cos(angle), xp.sin(angle))


class Expected(NamedTuple):
    """What a load makes of the pulse, without a delay.

    Attributes:
        gain: G in each band.
        slope: Its derivatives with respect to the logarithms of the elements.
        spread: Its derivative with respect to a spread of the time constants, ε in
            `etid.circuits.directions`.
        aliased: Aliases, for a delay of 0.
    """

    gain: Complex[AnyArray, "*lane band"]
    slope: Complex[AnyArray, "*lane element band"]
    spread: Complex[AnyArray, "*lane band"]
    aliased: Complex[AnyArray, "*lane band"]


class GainModel(Module):
    """Model of the gain of a pulse, or of pulses along leading axes.

    Attributes:
        circuit: Structure of the load.
        bands: The unloaded pulse and its bands.
        source: Z_th in each band [Ω].
        source_alias: Z_th at the frequency from which the aliases of a band come [Ω].
        turn: Phase of a delay of one sample [rad].
        turns: e^(jωτ) for each delay of `DELAYS`.
        noise_freedom: Degrees of freedom of the variance of the noise.
        source_error: Errors of log Z_th by the calibrations: independent ones, each for a standard
            deviation of 1.
        faults: Gain, crosstalk and capacitance of the instrument by the same errors; None if it has
            no tolerances.
        discrepancy: Functions of the error δ of a circuit that is not exact; None if it is.
    """

    circuit: AbstractCircuit
    bands: Bands
    source: Complex[AnyArray, " band"]
    source_alias: Complex[AnyArray, " band"]
    turn: Float[AnyArray, " band"]
    turns: Complex[AnyArray, "delay band"]
    noise_freedom: Float[AnyArray, ""]
    source_error: Complex[AnyArray, "z band"]
    faults: Float[AnyArray, "z 3"] | None = None
    discrepancy: Float[AnyArray, "function band"] | None = None

    @classmethod
    def of(
        cls,
        circuit: AbstractCircuit,
        bands: Bands,
        known: GivenDriver,
        source_alias: Complex[Array, " band"],
        noise_freedom: int,
        discrepancy: float,
    ) -> "GainModel":
        """The model of loads behind the driver `known`, with the phases of all `DELAYS`.

        Args:
            circuit: Structure of the loads.
            bands: The unloaded pulse and its bands.
            known: The driver in these bands.
            source_alias: Z_th at the frequency from which the aliases of a band come [Ω].
            noise_freedom: Degrees of freedom of the variance of the noise.
            discrepancy: Standard deviation of the real and of the imaginary part of δ.
        """
        loaded = source_of(known).z_loaded(combined(known.mean, known.slope))
        source = loaded - as_complex(known.resistance)
        turn = 2 * jnp.pi * bands.frequency / bands.sample_rate
        turns = _unit(jnp.asarray(DELAYS)[:, None] * turn[None, :])
        freedom = jnp.asarray(float(noise_freedom))
        by_source = known.slope * (loaded * reciprocal(source))[None, :]
        independent = root(known.cov).T
        error = combined(independent, by_source)
        faults = None if known.faults is None else independent @ known.faults[1]
        of = circuit, bands, source, source_alias, turn, turns, freedom, error, faults
        return cls(*of, jnp.asarray(functions(bands, discrepancy)) if discrepancy else None)

    def errors_along(
        self, gain: Complex[Array, " band"], weights: Complex[Array, "value band"]
    ) -> Float[Array, "value error"]:
        """Re Σ conj(w) `by_error`; all electrodes have the same errors, one matrix product."""
        by_source = real_parts(jnp.conj(gain * (gain - 1))[None, :] * weights)
        found, weights = by_source @ real_parts(self.source_error).T, real_parts(weights)
        if self.faults is not None:
            found = found + weights @ real_parts(self._by_fault(gain)).T @ self.faults.T
        if self.discrepancy is None:
            return found
        return jnp.concatenate([found, weights @ real_parts(self._by_delta(gain)).T], 1)

    def by_error(
        self, gain: Complex[AnyArray, "*row band"]
    ) -> Complex[AnyArray, "*row error band"]:
        """Changes of a gain by each independent error of calibrations, instrument and circuit."""
        # ∂G/∂ log Z_th = −G (1 − G)
        found = (gain * (gain - 1))[..., None, :] * self.source_error
        if self.faults is not None:
            by_fault = self._by_fault(gain)
            found = found + from_parts(self.faults @ by_fault.real, self.faults @ by_fault.imag)
        if self.discrepancy is None:
            return found
        return namespace(gain).concatenate([found, self._by_delta(gain)], -2)

    def _by_delta(
        self, gain: Complex[AnyArray, "*row band"]
    ) -> Complex[AnyArray, "*row coefficient band"]:
        """Changes of a gain by each coefficient of δ, of its real and of its imaginary part."""
        real = gain[..., None, :] * as_complex(self.discrepancy)
        return namespace(gain).concatenate([real, 1j * real], -2)

    def smooth(
        self,
        gain: Complex[AnyArray, "*row band"],
        delay: Float[AnyArray, "*row"],
        weight: Float[AnyArray, "*row band"],
    ) -> Smooth | None:
        """What makes parts of variance 1 of noise and δ in the residual of a delayed pulse.

        Args:
            gain: Measured gain.
            delay: Delay [samples].
            weight: Weight of |Ĝ − G|² in each band.
        """
        if self.discrepancy is None:
            return None
        return Smooth.of(self.discrepancy, gain * self.turned(delay), weight)

    @array_function
    def _by_fault(self, gain: Complex[AnyArray, "*row band"]) -> Complex[AnyArray, "*row 3 band"]:
        """Changes of a gain by each error of the instrument that acts on loads."""
        left, by_z = 1 - gain, (1 - gain) ** 2 * reciprocal(self.source)
        z = self.source * gain * reciprocal(left)
        at = At(self.bands.frequency, z, gain[..., None, :], by_z[..., None, :])
        each = [DIRECTIONS[name].change(at)[..., 0, :] for name in ON_LOADS]
        return namespace(gain).concatenate(each, -2)

    def expected(self, logs: Float[AnyArray, "*row element"]) -> "Expected":
        """The gain of a load, and its derivatives."""
        frequency = self.bands.frequency
        z, by_element = with_slopes(self.circuit, logs, frequency)
        admittance = reciprocal(z + self.source)
        by_z = self.source * admittance * admittance

        def impedance(frequency: Float[AnyArray, " band"]) -> Complex[AnyArray, "*row band"]:
            return impedance_at(self.circuit, logs, frequency)

        exponents = bool(self.circuit.exponents())
        alike = At(frequency, z, impedance=impedance, exponents=exponents)
        above = impedance(self.bands.sample_rate - frequency)
        other = above * reciprocal(above + self.source_alias)
        aliased = namespace(other).conj(other) * self.bands.alias
        slope = by_element * by_z[..., None, :]
        return Expected(z * admittance, slope, spread(alike) * by_z, aliased)

    def departure(self, at: "Expected", delay: Float[Array, ""]) -> Complex[Array, " band"]:
        """Ĝ − G e^(−jωτ): aliases, and the effect of the curvature of G over a band."""
        departure = at.aliased * _unit(2 * jnp.pi * delay)
        departure = departure + self.bands.departure(at.gain, delay)
        return departure * jnp.conj(self.turned(delay))

    def turned(self, delay: Float[AnyArray, "*row"]) -> Complex[AnyArray, "*row band"]:
        """e^(jωτ) from a table and a Taylor series: a sine costs as much as the rest of the fit."""
        xp = namespace(delay)
        near = xp.clip(xp.round((delay - DELAYS[0]) / STEP), 0, DELAYS.size - 1).astype(int)
        angle = (delay - xp.asarray(DELAYS)[near])[..., None] * self.turn
        square = angle * angle
        cosine = 1 - square / 2 * (1 - square / 12 * (1 - square / 30))
        sine = angle * (1 - square / 6 * (1 - square / 20 * (1 - square / 42)))
        return self.turns[near] * from_parts(cosine, sine)

    def patterns(
        self,
        delay: Float[AnyArray, "*row"],
        weight: Float[AnyArray, "*row band"],
        line: Float[AnyArray, "*row line"],
        smooth: Smooth | None,
    ) -> Float[AnyArray, "*row pattern part"]:
        """Lines of the mains in the residual of a delayed pulse [standard deviations].

        Args:
            delay: Delay [samples].
            weight: Weight of |Ĝ − G|² in each band.
            line: Deviation of each line, for a pulse of the amplitude of the unloaded record [V].
            smooth: What else the residual is multiplied by.
        """
        xp = namespace(weight, line)
        scale = self.turned(delay) * as_complex(xp.sqrt(weight))
        deviation = xp.repeat(line, 2, axis=-1)[..., None]
        lines = self.bands.lines * scale[..., None, :]
        return real_parts(lines if smooth is None else smooth(lines)) * deviation

    def undelayed(self, logs: Float[AnyArray, "*row element"]) -> Complex[AnyArray, "*row band"]:
        """The gain without a delay."""
        z = impedance_at(self.circuit, logs, self.bands.frequency)
        return z * reciprocal(z + self.source)


def first_largest(values: Float[Array, " value"]) -> Int[Array, ""]:
    """Number of the largest value, as of `argmax`, for which XLA takes five times as long."""
    number = jnp.arange(values.size)
    return jnp.min(jnp.where(values == values.max(), number, values.size - 1))


def nearest_delay(
    model: GainModel, gain: Complex[Array, " band"], expected: Complex[Array, " band"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The delay at which an expected gain is nearest to `gain` [samples], and the distance there.

    The distance is weighted and squared, without a constant: the weighted square of `gain`.
    """
    product = as_complex(model.bands.weight) * jnp.conj(expected) * gain
    turns = jnp.concatenate([model.turns.real, -model.turns.imag], axis=1)
    alike = turns @ jnp.concatenate([product.real, product.imag])
    at = first_largest(alike)
    # A parabola through three values: a step of the grid, 0.1 samples, is a hundred standard
    # errors.
    around = alike[jnp.clip(at, 1, DELAYS.size - 2) + jnp.arange(-1, 2)]
    curved = around[0] - 2 * around[1] + around[2]
    delay = DELAYS[0] + STEP * (at.astype(around.dtype) + 0.5 * (around[0] - around[2]) / curved)
    inside = (at > 0) & (at < DELAYS.size - 1) & (curved < 0)
    distance = jnp.sum(model.bands.weight * power(expected)) - 2 * alike.max()
    return jnp.where(inside, delay, jnp.asarray(DELAYS)[at]), distance


class Equations(NamedTuple):
    """Normal equations of a pulse and of the prior from the pulses before it.

    `J` are the derivatives of the residual r.

    Attributes:
        objective: Σ r² of pulse and prior.
        squares: Σ r² of the pulse alone.
        gradient: Jᵀr of pulse and prior.
        curvature: JᵀJ of the pulse alone.
        matrix: JᵀJ of pulse and prior.
    """

    objective: Float[Array, ""]
    squares: Float[Array, ""]
    gradient: Float[Array, " own"]
    curvature: Float[Array, "own own"]
    matrix: Float[Array, "own own"]


class _Search(NamedTuple):
    """State of `searched`."""

    own: Float[Array, " own"]
    at: Equations
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    unsettled: Bool[Array, ""]


def minimum(
    pulse: "Pulse", start: LoadUnknowns, expected: Expected
) -> tuple[Float[Array, " own"], Equations, Float[Array, ""], Float[Array, " part"]]:
    """One Gauss-Newton step; near the minimum one more, with the same derivatives.

    Args:
        pulse: The objective.
        start: Where to begin.
        expected: The gain at `start`.

    Returns:
        The parameters after these steps, the last normal equations that were accepted, the
        reduction of Σ r² that these predict, and the residual at the minimum.
    """
    own = start.vector()
    jacobian = pulse.jacobian(expected)
    first = pulse.residual(expected.gain, start.delay_samples)
    before = pulse.equations(start, jacobian, first)
    inverse = inverse_of_few(before.matrix)
    trial = own - inverse @ before.gradient
    reached = LoadUnknowns.of(trial)
    residual = pulse.residual(pulse.model.undelayed(reached.log_elements), reached.delay_samples)
    pull, distance = pulse.prior(reached)
    squares = jnp.dot(residual, residual)
    objective = squares + distance
    better = objective <= before.objective
    own = jnp.where(better, trial, own)
    at = before._replace(
        objective=jnp.where(better, objective, before.objective),
        squares=jnp.where(better, squares, before.squares),
        gradient=jnp.where(better, jacobian @ residual + pull, before.gradient),
    )
    step = inverse @ at.gradient
    decrement = jnp.dot(step, at.gradient)
    step = jnp.where(decrement < SETTLED**2, step, 0.0)
    return own - step, at, decrement, jnp.where(better, residual, first) - step @ jacobian


def searched(
    equations: Callable[[Float[Array, " own"]], Equations],
    start: Float[Array, " own"],
    wanted: Bool[Array, ""],
) -> Float[Array, " own"]:
    """Levenberg-Marquardt steps until the next one predicts less than `SETTLED`.

    Args:
        equations: The normal equations.
        start: Where to begin.
        wanted: Whether the result is used; otherwise it is the start.

    Returns:
        The best parameters of at most `SEARCH` steps.
    """

    def far(at: Equations) -> Bool[Array, ""]:
        return ~(jnp.dot(at.gradient, inverse_of_few(at.matrix) @ at.gradient) < SETTLED**2)

    def going(carry: _Search) -> Bool[Array, ""]:
        return carry.unsettled & (carry.steps < SEARCH)

    def stepped(carry: _Search) -> _Search:
        diagonal = jnp.diag(jnp.diagonal(carry.at.matrix))
        trial = carry.own - inverse_of_few(carry.at.matrix + carry.damping * diagonal) @ (
            carry.at.gradient
        )
        after = equations(trial)
        better = after.objective <= carry.at.objective
        own, at = jax.tree.map(partial(jnp.where, better), (trial, after), (carry.own, carry.at))
        damping = carry.damping * jnp.where(better, 0.1, 8.0)
        return _Search(own, at, damping, carry.steps + 1, far(at))

    at = equations(start)
    first = _Search(start, at, jnp.asarray(1e-2), jnp.zeros((), int), wanted & far(at))
    return jax.lax.while_loop(going, stepped, first).own


class Pulse(Module):
    """The objective for one electrode at one pulse, or for several along leading axes.

    Attributes:
        model: Model of the gain.
        gain: Measured gain, without aliases and curvature.
        weight: Weight of |Ĝ − G|² in each band.
        centre: Logarithms of the elements before the pulse [SI].
        information: Inverse covariance of `centre`.
        lines: Lines of the mains of which the residual is cleared (`etid.display.noise`).
        smooth: What makes parts of variance 1 of noise and δ; None without δ.
    """

    model: GainModel
    gain: Complex[AnyArray, "*row band"]
    weight: Float[AnyArray, "*row band"]
    centre: Float[AnyArray, "*row element"]
    information: Float[AnyArray, "*row element element"]
    lines: Float[AnyArray, "*row pattern part"]
    smooth: Smooth | None

    def whitened(
        self, gains: Complex[AnyArray, "*row value band"]
    ) -> Float[AnyArray, "*row value part"]:
        """Gains in standard deviations of the noise."""
        root = as_complex(namespace(self.weight).sqrt(self.weight))
        values = gains * root[..., None, :]
        values = values if self.smooth is None else self.smooth(values)
        return cleared(real_parts(values), self.lines)

    def errors_along(
        self, gain: Complex[Array, " band"], directions: Float[Array, "value part"]
    ) -> Float[Array, "value error"]:
        """Components of the independent errors of the gain along directions of the residual."""
        parts = jnp.split(cleared(directions, self.lines[::-1]), 2, axis=1)
        weights = jax.lax.complex(*parts)
        weights = weights if self.smooth is None else self.smooth.transposed(weights)
        weights = weights * as_complex(jnp.sqrt(self.weight))[None, :]
        return self.model.errors_along(gain, weights)

    def by_x(self, gain: Complex[AnyArray, "*row band"]) -> Float[AnyArray, "*row part"]:
        """Variance of the residual by the noise of the unloaded record."""
        xp, of = namespace(gain), self.model.bands
        each = power(gain) * of.variance_x * self.weight / xp.where(of.weight > 0, of.weight, 1.0)
        return xp.concatenate([each, each], -1)

    def jacobian(self, expected: Expected) -> Float[AnyArray, "*row own part"]:
        """Derivatives of the residual with respect to the elements and the delay."""
        xp, turn = namespace(expected.gain), self.model.turn
        # The derivative with respect to the delay is jω Ĝ e^(jωτ). Here the model replaces Ĝ:
        # otherwise the noise of Ĝ would count as information.
        by_delay = expected.gain * from_parts(xp.zeros_like(turn), turn)
        return self.whitened(xp.concatenate([-expected.slope, by_delay[..., None, :]], -2))

    def residual(
        self, expected: Complex[Array, " band"], delay: Float[Array, ""]
    ) -> Float[Array, " part"]:
        """Measured minus expected gain [standard deviations], for a delay [samples]."""
        return self.whitened((self.gain * self.model.turned(delay) - expected)[None])[0]

    def prior(self, own: LoadUnknowns) -> tuple[Float[Array, " own"], Float[Array, ""]]:
        """Squared distance from what is known before the pulse: half its gradient, and itself."""
        off, late = own.log_elements - self.centre, own.delay_samples
        pull = LoadUnknowns(self.information @ off, late / DELAY_WIDTH**2).vector()
        return pull, jnp.dot(pull, LoadUnknowns(off, late).vector())

    def equations(
        self,
        own: LoadUnknowns,
        jacobian: Float[Array, "own part"],
        residual: Float[Array, " part"],
    ) -> Equations:
        """Normal equations of the pulse and of the prior.

        Args:
            own: Where they are wanted.
            jacobian: Derivatives of the residual there.
            residual: Residual there.
        """
        (pull, distance), squares = self.prior(own), jnp.dot(residual, residual)
        curvature = jacobian @ jacobian.T
        # A stated delay is no help: a window begins up to half a sample beside its pulse.
        prior = jnp.pad(self.information, (0, 1)).at[-1, -1].set(1 / DELAY_WIDTH**2)
        return Equations(
            squares + distance,
            squares,
            jacobian @ residual + pull,
            curvature,
            curvature + prior,
        )
