"""One tick: the states of all electrodes after one more pulse, as one compiled program."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from etid.estimators.judgement import SUCCESSFUL
from etid.estimators.starts import circuit_starts
from etid.estimators.unknowns import LoadUnknowns
from etid.online import changes
from etid.online.changes import driver_change
from etid.online.electrode import (
    Measured,
    after_pulse,
    anew,
    predicted,
    suspicion,
    tracked,
)
from etid.online.gain_bands import Bands
from etid.online.projection import Seen
from etid.online.pulse_fit import Expected, GainModel
from etid.online.state import ElectrodeState, TrackerState
from etid.results.verdicts import RESULTS, first_verdict
from etid.signals.transfer import as_complex, power

STEADY = 0.1  # relative change of amplitude up to which the mean of a window is its offset
FLAT = 4.0  # power relative to that of noise alone; below this, the pulse is `flat`


@jax.jit  # `program` and `equinox.filter_jit` would cost a tenth of a tick at every call
def updated(
    model: GainModel,
    change: Float[Array, ""],
    limit: Float[Array, ""],
    state: TrackerState,
    seen: Seen,
    amplitude: Float[Array, " lane"],
) -> TrackerState:
    """The state after one more pulse.

    Args:
        model: Model of the gain.
        change: Standard deviation of the random walk [1/√pulse].
        limit: Limit of the tests for a change.
        state: State before the pulse.
        seen: The bands of the windows.
        amplitude: Relative amplitude of the pulse.
    """
    before, number = state.electrodes, state.number + 1
    measured = measured_pulse(model.bands, seen, amplitude, before)
    information = jax.vmap(lambda of: predicted(of, change))(before.information)
    logs = LoadUnknowns.of(before.own).log_elements
    expected = _expected(model, logs, number)
    found = jax.vmap(lambda *of: tracked(model, *of))(before, measured, expected, information)
    common = model.circuit.scaling()[0]
    suspected = jax.vmap(lambda a, b, c: suspicion(a, b, c, common, limit))(
        before, found, information
    )
    running = before.pulses > 0
    wanted = (~running | suspected.jump | suspected.drift) & (measured.bad == SUCCESSFUL)
    starts = circuit_starts(model.circuit, None)
    fresh = jax.lax.cond(
        wanted.any(),
        jax.vmap(lambda of, want, logs: anew(model, of, starts, want, logs)),
        lambda *_: found,
        measured,
        wanted,
        logs,
    )
    powers = model.circuit.scaling()[0]
    after = jax.vmap(lambda a, b, c, d, e, f: after_pulse(a, b, c, d, e, f, limit, number, powers))(
        before, measured, information, found, fresh, suspected
    )
    counts = running & measured.steady & (measured.bad == SUCCESSFUL)
    event = driver_change(suspected.jump, suspected.z.T, counts, running)
    return TrackerState(after, number, event, state.driver_changed | event)


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
    bands: Bands, seen: Seen, amplitude: Float[Array, " lane"], before: ElectrodeState
) -> Measured:
    """Gains of a pulse, and the verdict on its samples.

    Args:
        bands: The unloaded pulse.
        seen: The bands of the windows.
        amplitude: Relative amplitude of the pulse.
        before: State before the pulse.
    """
    relative = jnp.where(amplitude > 0, amplitude, 1.0)
    known = jnp.isfinite(before.amplitude)
    lacking = jnp.where(known, (relative - before.amplitude) / relative, 0.0)
    # In the steady state the mean of V_out is 0: a transformer passes no direct voltage.
    mean = seen.means().whole
    finite = jnp.isfinite(mean) & jnp.isfinite(seen.variance)
    steady = jnp.abs(lacking) < STEADY
    offset = jnp.where(finite & steady, mean, before.offset)
    unknown = ~jnp.isfinite(offset)
    gains = bands.measure(seen, lacking, jnp.where(unknown, 0.0, offset))
    signal = power(gains.gain) @ bands.weight
    noise = 2 * jnp.sum(bands.weight > 0, dtype=float) * gains.variance
    flat = (signal < FLAT * noise) | ~(amplitude > 0)
    level = jnp.sqrt(jnp.maximum(signal - noise, 0.0) / jnp.sum(bands.weight)) / relative
    shown = power(seen.gain()) @ bands.weight  # of the samples alone
    repeated = jnp.any(shown[:, None] == before.shown, axis=1)
    bad = jax.vmap(
        lambda finite, clipped, unknown, flat, repeated, unconnected: first_verdict(
            (~finite, RESULTS.nonfinite_samples),
            (clipped, RESULTS.saturated),
            (unknown, RESULTS.too_short),
            (flat, RESULTS.flat),
            (repeated, RESULTS.repeated),
            (unconnected, RESULTS.unconnected),
        )
    )(finite, seen.clipped, unknown, flat, repeated, jnp.abs(level - 1) < 1 - changes.OPEN)
    return Measured(
        gain=gains.gain * as_complex(1 / relative)[:, None],
        variance=gains.variance / relative**2,
        weight=gains.weight * relative[:, None] ** 2,
        level=level,
        amplitude=amplitude,
        offset=offset,
        steady=steady,
        shown=shown,
        bad=bad,
    )
