"""Changes of a fit in time behind a measured current that are not linear.

Two faults of a record and one of the load, to first order in 1/U, where U is a voltage or current:

- The current amplifier compresses its peaks: it shows i (1 − |i|/U), and V_out lacks Z_L |i| i / U.
- The voltage amplifier compresses its peaks: it shows v (1 − |v|/U).
- A resistance falls with its current. Like on harmonics
  (`etid.estimators.score_tests.falling_resistance`), it adds −|u| u / U to the voltage u of the
  relaxations, filtered by them: they are the load without its series resistance.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from etid.circuits.impedance import AbstractImpedance
from etid.estimators.output_error.information import Slopes, padded_size
from etid.estimators.output_error.prediction import IMPULSE, Change, Records, impulse
from etid.estimators.score_tests.other_in_time import in_time, shared_noise
from etid.estimators.unknowns import Nuisance
from etid.signals.filtering import hold, simulate


def bends(records: Records, impedance: AbstractImpedance, nuisance: Nuisance, at: Slopes) -> Change:
    """Derivatives of the predicted voltage with respect to the three changes.

    The signs are those of the predicted minus the measured voltage: a compressed voltage and a
    falling resistance have a positive size, a compressed current a negative one.

    Args:
        records: One recording.
        impedance: The load.
        nuisance: Other unknowns of the recording.
        at: The residual and the impulse response of the load.

    Returns:
        The derivatives for the current amplifier, for the voltage amplifier, and, last, for a
        resistance that falls. Their effect on the noise is not counted.
    """
    load = in_time(records, impedance)
    system, series = hold(load, records.sample_rate), load.D[0]
    # The square of noise has a mean. So the signals are the best estimates from both records,
    # whose noise does not depend on the residual.
    known = shared_noise(records, at)

    def bent(
        signal: Float[Array, " interval"], response: Float[Array, " lag"]
    ) -> Float[Array, " interval"]:
        """|v| v of the best estimate of a signal, which has this response to the noise."""
        size = padded_size(signal.size)
        of_noise = jnp.fft.irfft(jnp.fft.rfft(response, size) * known, size)
        v = (signal - of_noise[: signal.size]) * records.used
        return jnp.abs(v) * v

    def filtered(signal: Float[Array, " interval"]) -> Float[Array, " interval"]:
        """The voltage of the load if this is its current, with straight lines between samples."""
        lines = jnp.zeros_like(records.hold).at[:, 0].set(signal)
        lines = lines.at[:-1, 1].set(jnp.diff(signal))
        return simulate(system, lines, jnp.zeros_like(nuisance.state))[0]

    current, noise = records.hold[:, 0], impulse()[:, 0]
    v_out = simulate(system, records.hold, nuisance.state)[0]
    bent_current = bent(current, noise)
    bent_relaxing = bent(v_out - series * current, at.h - series * noise)
    by_current, by_fall = jax.vmap(filtered)(jnp.stack([bent_current, bent_relaxing]))
    by_fall = by_fall - series * bent_relaxing
    columns = jnp.stack([by_current, bent(v_out, at.h), by_fall], axis=1)
    return Change(columns, jnp.zeros((IMPULSE + 1, columns.shape[1])))
