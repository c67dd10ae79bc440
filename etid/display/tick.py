"""One tick: the states of all electrodes after one more pulse, as one compiled program.

For each electrode a tick has the verdict on the samples, the fit with the prediction, the tests for
a change, a fit of the pulse alone where it is new or suspected, and the state after it.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from etid.display.alarms import Innovation, PulseScores, averaged, driver_change
from etid.display.discrepancy import Smooth
from etid.display.gain_bands import Bands
from etid.display.noise import Noise, cleared, directions
from etid.display.projection import BandSums
from etid.display.pulse_fit import (
    DELAYS,
    SETTLED,
    Equations,
    Expected,
    GainModel,
    Pulse,
    minimum,
    nearest_delay,
    searched,
)
from etid.display.state import DRIFT, JUMP, NONE, OPEN, REPEATED, ElectrodeState
from etid.estimators.judgement import MAX_STEPS_REACHED, SUCCESSFUL
from etid.estimators.unknowns import LoadUnknowns
from etid.likelihood.noise import misses
from etid.likelihood.starts import LEVELS
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.harmonics import real_parts
from etid.signals.transfer import as_complex, power
from etid.solvers.matrices import inverse_of_few, root_of_few

STEADY = 0.1  # relative change of amplitude up to which the mean of a window is its offset
PATIENCE = 5  # pulses in a row that do not fit, after which an electrode starts again


class Measured(NamedTuple):
    """What a pulse shows at one electrode, or at all of them along a leading axis.

    Attributes:
        gain: Measured gain.
        variance: E|noise|² of a Fourier coefficient of V_out [V²].
        weight: Weight of |Ĝ − G|² in each band.
        line: Deviation of each line of the mains, for a pulse of amplitude 1 [V].
        level: Effective value of the gain.
        amplitude: Amplitude of the pulse, relative to that of the unloaded record.
        offset: Offset of the converter [V].
        steady: Whether the amplitude is nearly that of the pulse before.
        repeated: Whether the window is an old one.
        bad: Verdict on the samples.
    """

    gain: Complex[Array, "*lane band"]
    variance: Float[Array, "*lane"]
    weight: Float[Array, "*lane band"]
    line: Float[Array, "*lane line"]
    level: Float[Array, "*lane"]
    amplitude: Float[Array, "*lane"]
    offset: Float[Array, "*lane"]
    steady: Bool[Array, "*lane"]
    repeated: Bool[Array, "*lane"]
    bad: RESULTS


class Attempt(NamedTuple):
    """A fit of one pulse.

    Attributes:
        own: Logarithms of the elements [SI] and delay [samples].
        information: Information of this pulse about the elements.
        spread: Its inverse.
        chi2: χ² of the pulse.
        rrse: RRSE of the pulse.
        result: Verdict.
        scores: Scores of a gain and of a spread.
        residual: Residual of the pulse that no gain and no spread explains, of variance 1 if the
            noise is as expected.
        lines: Lines of the mains, as the residual.
        rough: The residual with what δ makes of it, which is the same in each pulse.
    """

    own: Float[Array, "*lane own"]
    information: Float[Array, "*lane element element"]
    spread: Float[Array, "*lane element element"]
    chi2: Float[Array, "*lane"]
    rrse: Float[Array, "*lane"]
    result: RESULTS
    scores: PulseScores
    residual: Float[Array, "*lane part"]
    lines: Float[Array, "*lane pattern part"]
    rough: Float[Array, "*lane part"]


class Suspicion(NamedTuple):
    """The tests of a pulse for a change.

    Attributes:
        jump: Whether the pulse does not fit its prediction.
        drift: Whether the moving mean of the innovations is not zero.
        again: Whether the electrode is identified from this pulse alone.
        mean: Moving mean of the innovations.
        mean_cov: Its covariance.
        element: The element that explains the drift best.
        z: Components of innovation and moving mean along a change of Z_th [standard deviations].
    """

    jump: Bool[Array, "*lane"]
    drift: Bool[Array, "*lane"]
    again: Bool[Array, "*lane"]
    mean: Float[Array, "*lane element"]
    mean_cov: Float[Array, "*lane element element"]
    element: Int[Array, "*lane"]
    z: Float[Array, "*lane 2"]


@jax.jit  # `program` and `equinox.filter_jit` would cost a tenth of a tick at every call
def updated(
    model: GainModel,
    change: Float[Array, ""],
    limit: Float[Array, ""],
    before: ElectrodeState,
    noise: Noise,
    number: Int[Array, ""],
    driver_changed: Bool[Array, ""],
    sums: BandSums,
    amplitude: Float[Array, " lane"],
) -> tuple[ElectrodeState, Noise, Int[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """The fields of `TrackerState` after one more pulse, without its windows.

    Args:
        model: Model of the gain.
        change: Standard deviation of the random walk [1/√pulse].
        limit: Limit of the tests for a change.
        before: Estimates before the pulse.
        noise: Noise before the pulse.
        number: Number of the pulse before.
        driver_changed: Whether any pulse before showed a change of the driver.
        sums: What the windows show.
        amplitude: Relative amplitude of the pulse.
    """
    number = number + 1
    powers = jnp.asarray(model.circuit.scaling()[0])  # also how a change of Z_th moves the elements
    measured = measured_pulse(model.bands, sums, amplitude, before, noise)
    information = jax.vmap(lambda of: predicted(of, change))(before.information)
    logs = LoadUnknowns.of(before.own).log_elements
    expected = _expected(model, logs, number)

    def tracked(
        logs: Float[Array, " element"],
        measured: Measured,
        expected: Expected,
        information: Float[Array, "element element"],
    ) -> Attempt:
        delay, _ = nearest_delay(model, measured.gain, expected.gain)
        return attempt(model, measured, LoadUnknowns(logs, delay), expected, logs, information)

    found = jax.vmap(tracked)(logs, measured, expected, information)
    running = before.pulses > 0

    suspect = jax.vmap(partial(suspicion, common=powers, limit=limit))

    # Hum that begins now is a misfit until it is known, and would be a change of the driver. With
    # the hum that it shows, the pulse must fit its prediction.
    def heard(noise: Noise) -> tuple[Measured, Attempt, Noise]:
        known = jax.vmap(partial(noise_after, model.bands.hum))(noise, measured, found)
        other = measured_pulse(model.bands, sums, amplitude, before, known)
        fit = jax.vmap(tracked)(logs, other, expected, information)
        known = dataclasses.replace(known, residual=fit.rough)
        fits = ~suspect(before, fit, information).jump
        better = running & fits & (found.result == RESULTS.misfit)
        return jax.vmap(lambda which, *of: jax.tree.map(partial(jnp.where, which), *of))(
            better, (other, fit, known), (measured, found, noise)
        )

    measured, found, noise = jax.lax.cond(
        jnp.any(running & (found.result == RESULTS.misfit)),
        heard,
        lambda noise: (measured, found, noise),
        noise,
    )
    suspected = suspect(before, found, information)
    wanted = suspected.again & (measured.bad == SUCCESSFUL)
    typical = model.circuit.log_values()
    starts = jnp.stack([typical + math.log(factor) * powers for factor in LEVELS])
    fresh = jax.lax.cond(
        wanted.any(),
        jax.vmap(lambda of, want, logs: anew(model, of, starts, want, logs)),
        lambda *_: found,
        measured,
        wanted,
        logs,
    )
    used = jax.vmap(lambda again, *of: jax.tree.map(partial(jnp.where, again), *of))(
        suspected.again, fresh, found
    )
    after = jax.vmap(partial(after_pulse, limit=limit, number=number))(
        before, measured, information, used, suspected
    )
    counts = running & measured.steady & (measured.bad == SUCCESSFUL)
    event = driver_change(suspected.jump, suspected.z.T, counts, running)
    noise = jax.vmap(partial(noise_after, model.bands.hum))(noise, measured, used)
    return after, noise, number, event, driver_changed | event


def _expected(
    model: GainModel, logs: Float[Array, "lane element"], number: Int[Array, ""]
) -> Expected:
    """The expected gains, computed once.

    XLA repeats a computation in every loop that reads its result, here a dozen times. It computes
    the result of a branch only once. `number` is positive, which XLA does not know.
    """
    evaluate = jax.vmap(model.expected)
    shapes = jax.eval_shape(evaluate, logs)
    return jax.lax.cond(
        number > 0,
        evaluate,
        lambda _: jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes),
        logs,
    )


def measured_pulse(
    bands: Bands,
    sums: BandSums,
    amplitude: Float[Array, " lane"],
    before: ElectrodeState,
    noise: Noise,
) -> Measured:
    """Gains of a pulse, and the verdict on its samples."""
    relative = jnp.where(amplitude > 0, amplitude, 1.0)
    known = jnp.isfinite(before.amplitude)
    lacking = jnp.where(known, (relative - before.amplitude) / relative, 0.0)
    # In the steady state the mean of V_out is 0: a transformer passes no direct voltage.
    mean = sums.means().whole
    finite = jnp.isfinite(mean) & jnp.isfinite(sums.variance)
    steady = jnp.abs(lacking) < STEADY
    offset = jnp.where(finite & steady, mean, before.offset)
    unknown = ~jnp.isfinite(offset)
    gain, weight = bands.measure(sums, noise.bands, lacking, jnp.where(unknown, 0.0, offset))
    variance = jnp.asarray(sums.variance)
    signal = power(gain) @ bands.weight
    power_of_noise = 2 * jnp.sum(bands.weight > 0, dtype=float) * variance
    flat = (signal < 4 * power_of_noise) | ~(amplitude > 0)
    left = jnp.maximum(signal - power_of_noise, 0.0)
    level = jnp.sqrt(left / jnp.sum(bands.weight)) / relative
    bad = jax.vmap(
        lambda finite, clipped, unknown, flat, repeated, unconnected: first_verdict(
            (~finite, RESULTS.nonfinite_samples),
            (clipped, RESULTS.saturated),
            (unknown, RESULTS.too_short),
            (flat, RESULTS.flat),
            (repeated, RESULTS.repeated),
            (unconnected, RESULTS.unconnected),
        )
    )(finite, sums.clipped, unknown, flat, sums.repeated, jnp.abs(level - 1) < 1 - OPEN)
    return Measured(
        gain=gain * as_complex(1 / relative)[:, None],
        variance=variance / relative**2,
        weight=weight * relative[:, None] ** 2,
        line=noise.line / relative[:, None],
        level=level,
        amplitude=amplitude,
        offset=offset,
        steady=steady,
        repeated=jnp.asarray(sums.repeated),
        bad=bad,
    )


def predicted(
    information: Float[Array, "element element"], change: Float[Array, ""]
) -> Float[Array, "element element"]:
    """Λ⁻ = (Λ⁻¹ + q² 1)⁻¹, which also holds for a singular Λ."""
    elements = information.shape[0]
    lost = inverse_of_few(jnp.eye(elements) + change**2 * information)
    return information - change**2 * (information @ lost @ information)


def attempt(
    model: GainModel,
    measured: Measured,
    start: LoadUnknowns,
    expected: Expected,
    centre: Float[Array, " element"],
    information: Float[Array, "element element"],
) -> Attempt:
    """The fit of a pulse from a start near its minimum."""
    gain = measured.gain - model.departure(expected, start.delay_samples)
    smooth = model.smooth(gain, start.delay_samples, measured.weight)
    patterns = model.patterns(start.delay_samples, measured.weight, measured.line, smooth)
    lines = directions(patterns)
    pulse = Pulse(model, gain, measured.weight, centre, information, lines, smooth)
    own, at, decrement, residual = minimum(pulse, start, expected)
    weight = measured.weight
    freedom = 2 * jnp.sum(weight > 0, dtype=at.squares.dtype) - own.size
    chi2 = at.squares / freedom
    # The cube root of χ² is nearly normal (Wilson and Hilferty 1931). Noise exceeds 5.2 standard
    # deviations once in 10⁷ pulses.
    width = 2 / 9 * (1 / freedom + 1 / model.noise_freedom)
    noisy = chi2 < (1 - width + 5.2 * jnp.sqrt(width)) ** 3
    rrse = jnp.sqrt(at.squares / jnp.sum(weight * power(gain)))
    by_delay = at.curvature[:-1, -1]
    told = at.curvature[:-1, :-1] - jnp.outer(by_delay, by_delay) / at.curvature[-1, -1]
    inverse = inverse_of_few(at.curvature)
    scores, unexplained = PulseScores.of(pulse, expected, residual, inverse)
    late = jnp.abs(LoadUnknowns.of(own).delay_samples) > DELAYS[-1]
    result = first_verdict(
        (measured.bad != SUCCESSFUL, measured.bad),
        (~jnp.isfinite(own).all(), RESULTS.nonphysical),
        (~(decrement < SETTLED**2), MAX_STEPS_REACHED),
        (misses(chi2, rrse) & ~noisy | late, RESULTS.misfit),
    )
    # What the parameters do not take of the noise in each part.
    jacobian = pulse.jacobian(expected)
    left = 1 - jnp.sum((inverse_of_few(at.matrix) @ jacobian) * jacobian, axis=0)
    rough = unexplained = unexplained / jnp.sqrt(left)
    if smooth is not None:
        parts = jax.lax.complex(*jnp.split(unexplained, 2))
        rough = real_parts(smooth.undone(parts[None]))[0]
    return Attempt(
        own,
        told,
        inverse[:-1, :-1],
        chi2,
        rrse,
        result,
        scores,
        unexplained,
        cleared(patterns, lines),
        rough,
    )


def anew(
    model: GainModel,
    measured: Measured,
    starts: Float[Array, "start element"],
    wanted: Bool[Array, ""],
    logs: Float[Array, " element"],
) -> Attempt:
    """The fit of a pulse alone, from the nearest of several starts.

    Args:
        model: Model of the gain.
        measured: The pulse.
        starts: Logarithms of the elements.
        wanted: Whether the result is used; otherwise the search ends at once.
        logs: One more start: a search that has not settled continues with the next pulse.
    """
    logs = jnp.concatenate([starts, logs[None, :]])
    gains = jax.vmap(model.undelayed)(logs)
    delays, distances = jax.vmap(lambda one: nearest_delay(model, measured.gain, one))(gains)
    # `argmin` would take a start without a number: a search that diverged would never end.
    number = jnp.argmin(jnp.where(jnp.isfinite(distances), distances, jnp.inf))
    start, delay, weight = logs[number], delays[number], measured.weight
    nothing = jnp.zeros((starts.shape[1], starts.shape[1]))

    # With the departure of each step: that of a distant start moves the minimum by several standard
    # errors, out of reach of the two steps that follow.
    def equations(
        weight: Float[Array, " band"],
        smooth: Smooth | None,
        lines: Float[Array, "pattern part"],
        q: Float[Array, " own"],
    ) -> Equations:
        own = LoadUnknowns.of(q)
        expected = model.expected(own.log_elements)
        gain = measured.gain - model.departure(expected, own.delay_samples)
        pulse = Pulse(model, gain, weight, start, nothing, lines, smooth)
        residual = pulse.residual(expected.gain, own.delay_samples)
        return pulse.equations(own, pulse.jacobian(expected), residual)

    def reached(
        weight: Float[Array, " band"], smooth: Smooth | None, own: LoadUnknowns
    ) -> LoadUnknowns:
        lines = directions(model.patterns(delay, weight, measured.line, smooth))
        of = partial(equations, weight, smooth, lines)
        return LoadUnknowns.of(searched(of, own.vector(), wanted))

    own = LoadUnknowns(start, delay)
    if model.discrepancy is None:
        own = reached(weight, None, own)
    else:
        # Far away, where the residual is large, a smooth δ would explain nearly all of it. A δ that
        # is another one in each band leads near the minimum.
        squares = jnp.sum(model.discrepancy**2, axis=0) * power(measured.gain)
        own = reached(weight / (1 + 2 * weight * squares), None, own)
        own = reached(weight, model.smooth(measured.gain, own.delay_samples, weight), own)
    expected = model.expected(own.log_elements)
    fit = attempt(model, measured, own, expected, own.log_elements, nothing)
    unknown = ~jnp.all(jnp.diagonal(fit.spread) < 1)
    result = first_verdict((fit.result != SUCCESSFUL, fit.result), (unknown, RESULTS.insensitive))
    return fit._replace(result=result)


def noise_after(
    hum: Bool[Array, " band"], noise: Noise, measured: Measured, used: Attempt
) -> Noise:
    """Noise at one electrode after one pulse."""
    settled = (used.result == SUCCESSFUL) | (used.result == RESULTS.misfit)
    shown = settled & measured.steady & jnp.isfinite(used.residual).all()
    return noise.after(hum, used.residual, used.rough, used.lines, shown)


def turned(
    information: Float[Array, "element element"],
    before: Float[Array, "element element"],
    after: Float[Array, "element element"],
) -> Float[Array, "element element"]:
    """Information about the elements, brought from one linearisation to another.

    A weak pulse hardly knows one direction, which turns from estimate to estimate. Several pulses,
    each linearised elsewhere, would seem to know it well. With L Lᵀ and M Mᵀ, what one pulse tells
    `before` and `after`, M L⁻¹ turns the directions of one into those of the other.
    """
    back = root_of_few(before).T @ inverse_of_few(before)  # L⁻¹
    turn = root_of_few(after) @ back
    moved = turn @ information @ turn.T
    return jnp.where(jnp.isfinite(moved).all(), moved, information)


def suspicion(
    state: ElectrodeState,
    found: Attempt,
    information: Float[Array, "element element"],
    common: Float[Array, " element"],
    limit: Float[Array, ""],
) -> Suspicion:
    """Test one pulse of an electrode; see `etid.display.alarms`."""
    before, after = LoadUnknowns.of(state.own), LoadUnknowns.of(found.own)
    off = after.log_elements - before.log_elements
    new = Innovation.of(off + found.spread @ information @ off, found.spread, information)
    moving = averaged(state.mean, state.mean_cov, new)
    running, fits = state.pulses > 0, found.result == SUCCESSFUL
    jump = running & ~(fits & (new.statistic() <= limit))
    drift = running & fits & (moving.statistic() > limit)
    return Suspicion(
        jump,
        drift,
        ~running | jump | drift,
        moving.d,
        moving.cov,
        moving.element(),
        jnp.stack([new.along(common), moving.along(common)]),
    )


def after_pulse(
    state: ElectrodeState,
    measured: Measured,
    information: Float[Array, "element element"],
    used: Attempt,
    suspected: Suspicion,
    limit: Float[Array, ""],
    number: Int[Array, ""],
) -> ElectrodeState:
    """State of one electrode after one pulse."""
    running, good = state.pulses > 0, used.result == SUCCESSFUL
    factor = LoadUnknowns.of(used.own).log_elements - LoadUnknowns.of(state.own).log_elements
    moved = Innovation.of(factor, used.spread, information)
    jumped = suspected.jump & good & (moved.statistic() > limit)
    drifted = suspected.drift & good & ~jumped
    old = measured.repeated & ~state.repeated
    event = jnp.where(jumped, JUMP, jnp.where(drifted, DRIFT, jnp.where(old, REPEATED, NONE)))
    changed = jumped | drifted

    silent = measured.amplitude == 0
    missed = jnp.where(good, 0, state.missed + jnp.where(silent, 0, 1))
    lost = running & ((missed >= PATIENCE) | (measured.bad == RESULTS.unconnected))
    restarted = good & suspected.again
    one = jnp.where(restarted, 1, state.pulses + 1)
    sums = used.scores.sums + jnp.where(restarted, 0.0, state.scores)
    sums = jnp.where(good, sums, state.scores)
    wrong = good & used.scores._replace(sums=sums).wrong()
    fits = running & good & ~suspected.jump & ~wrong
    reached = jnp.maximum(state.confirmed, measured.amplitude)
    begun = ~running & (used.result == MAX_STEPS_REACHED)
    shape = used.information / jnp.sum(measured.weight)
    summed = turned(information, state.shape, shape) + used.information
    gained = jnp.where(restarted, used.information, summed)
    followed, ended = good & ~suspected.again, good | lost
    return ElectrodeState(
        own=jnp.where(good | begun, used.own, state.own),
        information=jnp.where(lost, 0.0, jnp.where(good, gained, information)),
        pulses=jnp.where(lost, 0, jnp.where(good, one, state.pulses)),
        missed=missed,
        amplitude=measured.amplitude,
        offset=measured.offset,
        repeated=measured.repeated,
        confirmed=jnp.where(fits, reached, jnp.where(silent, state.confirmed, 0.0)),
        scores=sums,
        shape=jnp.where(good, shape, state.shape),
        level=jnp.where(silent, state.level, measured.level),
        variance=jnp.where(silent, state.variance, measured.variance),
        chi2=jnp.where(silent, state.chi2, used.chi2),
        rrse=jnp.where(silent, state.rrse, used.rrse),
        result=RESULTS.where(
            silent, state.result, RESULTS.where(wrong, RESULTS.misfit, used.result)
        ),
        mean=jnp.where(followed, suspected.mean, jnp.where(ended, 0.0, state.mean)),
        mean_cov=jnp.where(followed, suspected.mean_cov, jnp.where(ended, 0.0, state.mean_cov)),
        event=event.astype(int),
        factor=jnp.where(changed, factor, state.factor),
        element=jnp.where(
            jumped, moved.element(), jnp.where(drifted, suspected.element, state.element)
        ),
        drifted=jnp.where(drifted, number, state.drifted),
    )
