"""Is a load the circuit that is fitted? Score tests of a fit in time.

Those of `etid.estimators.score_tests.other_circuit` ask for one more relaxation,
ΔZ = ε |Z(j/τ)| / (1 + sτ). In time it is one more state of the load, and the slope of the predicted
voltage by ε comes from the same simulation.

The residual is coloured, G having filtered the noise of V_th. Residual and slopes are therefore
taken to frequencies, where the noise is independent with the power

    P(θ) = σ_out² |K|² + σ_th² |G|²,

and divided by √P. P moves with the parameters, by which the slopes are free of what the noise of
V_th in them has in common with the residual, as in `etid.estimators.output_error.prediction`.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from etid.circuits.impedance import AbstractImpedance
from etid.estimators.output_error.information import Slopes, bin_weights, noise_power, padded_size
from etid.estimators.output_error.prediction import (
    Records,
    impulse,
    impulse_response,
    predict,
    residual_variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests.other_circuit import Scores, relaxations, scores
from etid.estimators.unknowns import Nuisance
from etid.results.driver import SourceImpedance, connected, realise
from etid.signals.filtering import StateSpace, hold
from etid.signals.transfer import as_complex
from etid.solvers.matrices import inverse

# Hz. Faster relaxations look like delays and like the driver's fast poles, which at 40 dB are in
# doubt further than a linear distribution holds: of three damp skins one had z = 13 at 140 kHz.
HIGHEST = 5e3
PASSED = 0.5  # of the power, which the interpolation must let through
BESIDE = 8  # bins to either side, with which the power of V_th is averaged


class Relaxed(eqx.Module):
    """How voltage and impulse response change by each ε.

    Attributes:
        v_out: Terminal voltage [V].
        h: Impulse response.
    """

    v_out: Float[Array, "interval change"]
    h: Float[Array, "lag change"]


def relaxed(
    records: Records,
    source: SourceImpedance,
    impedance: AbstractImpedance,
    nuisance: Nuisance,
) -> Relaxed:
    """Derivatives by one more relaxation of each time constant.

    Args:
        records: One recording.
        source: Z_th.
        impedance: The load.
        nuisance: What else is unknown of it.
    """
    rate = records.sample_rate
    corner, level = relaxations(impedance, rate / records.intervals, jnp.asarray(HIGHEST))
    load, count = realise(impedance.rational(), rate), corner.size
    A = jax.scipy.linalg.block_diag(load.A, -jnp.diag(corner))
    B = jnp.concatenate([load.B, corner[:, None]])
    state = jnp.concatenate([nuisance.state, jnp.zeros(count)])
    nuisance = dataclasses.replace(nuisance, state=state)

    def simulated(epsilon):
        C = jnp.concatenate([load.C, epsilon * level])
        system = hold(connected(source, StateSpace(A, B, C, load.D)), rate)
        return predict(system, records, nuisance), impulse_response(system)

    return Relaxed(*jax.jacfwd(simulated)(jnp.zeros(count)))


def _smooth(power: Float[Array, " bin"]) -> Float[Array, " bin"]:
    """Means over neighbouring bins."""
    bins = np.arange(power.size)
    first, last = np.maximum(bins - BESIDE, 0), np.minimum(bins + BESIDE + 1, power.size)
    total = jnp.concatenate([jnp.zeros(1), jnp.cumsum(power)])
    return (total[last] - total[first]) / (last - first).astype(float)


def score(
    records: Records,
    change: Relaxed,
    at: Slopes,
    source_cov: Float[Array, "m m"],
    first: int,
    rest: Float[Array, " q"],
    precision: Float[Array, " q"],
    elements: int,
) -> Scores:
    """Score of each relaxation.

    Args:
        records: One recording.
        change: Derivatives by the relaxations.
        at: Those by the parameters.
        source_cov: Covariance of the parameters of the source.
        first: Place of these among the parameters.
        rest: Gradient of the priors of the others.
        precision: Of these priors.
        elements: How many parameters, the first, are the logarithms of elements.
    """
    # Parameters of the source in standard deviations.
    values, vectors = jnp.linalg.eigh(source_cov)
    root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]
    last = first + root.shape[0]

    def by_z(slope):
        return jnp.concatenate(
            [slope[:, :first], slope[:, first:last] @ root, slope[:, last:]], axis=1
        )

    known = jnp.zeros_like(precision).at[first:last].set(1.0) + precision
    # In volts, which the scaled residual is not.
    s = residual_variance(records, at.h)
    s_slope = 2 * records.sigma_th**2 * at.h @ at.slope
    jacobian = at.jacobian + at.residual[:, None] * s_slope[None, :] / (2 * s)
    volts = jnp.sqrt(s)
    of_time = jnp.concatenate(
        [change.v_out * records.used[:, None], by_z(jacobian) * volts], axis=1
    )
    of_lag = jnp.concatenate([change.h, by_z(at.slope)], axis=1)

    size = padded_size(of_time.shape[0])
    h, passed = jnp.fft.rfft(at.h, size), jnp.abs(jnp.fft.rfft(impulse()[:, 0], size)) ** 2
    power = noise_power(records, at.h, size)
    usable = passed > PASSED
    scale = jnp.where(usable, jnp.sqrt(jnp.asarray(bin_weights(size)) / power), 0.0)
    residual = jnp.fft.rfft(at.residual * volts, size)
    by_lag = jnp.fft.rfft(of_lag, size, axis=0)
    wider = (h.real[:, None] * by_lag.real + h.imag[:, None] * by_lag.imag) * (
        records.sigma_th**2 / power
    )[:, None]
    rows = jnp.fft.rfft(of_time, size, axis=0) - residual[:, None] * as_complex(wider)
    # The noise of V_th in the slopes, which would count as information, is left out as Wiener does.
    # Initial state and offset, before the delay at the end, have none.
    v_th = _smooth(jnp.abs(jnp.fft.rfft(records.hold[:, 0] * records.used, size)) ** 2)
    share = jnp.maximum(1 - records.sigma_th**2 * passed * records.intervals / v_th, 0.0)
    count = change.v_out.shape[1]
    noisy = np.arange(count + precision.size) < count + last
    noisy[-1] = True
    rows = rows * as_complex(jnp.where(noisy[None, :], share[:, None], 1.0))

    def terms(spectrum):
        weighed = spectrum * as_complex(scale).reshape(-1, *[1] * (spectrum.ndim - 1))
        return jnp.concatenate([weighed.real, weighed.imag]).T

    scaled = terms(rows)
    by_change, by_parameter = scaled[:count], scaled[count:]
    ones = jnp.ones(scaled.shape[1])
    linear = Linear(by_parameter, ones, ones, jnp.diag(known))
    return scores(
        by_change,
        linear,
        terms(residual),
        rest,
        jnp.diag(known),
        # What the record does not determine, an initial state for instance, has no effect.
        inverse(linear.curvature().expected, drop=True),
        slice(elements),
    )
