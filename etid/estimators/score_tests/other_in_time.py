"""Score tests of a fit in time whether a load is another circuit than the fitted one.

Like `etid.estimators.score_tests.other_circuit`, they test for one more relaxation,
ΔZ = ε |Z(j/τ)| / (1 + sτ). In time this is one more state of the load. The same simulation gives
the slope of the predicted voltage with respect to ε.

The residual is coloured, because G filters the noise of V_th. The residual and the slopes are
therefore transformed to frequencies. There the noise is independent and has the power

    P(θ) = σ_out² |K|² + σ_th² |G|²,

by whose root √P they are divided. P depends on the parameters. This dependence removes from the
slopes the noise of V_th that they share with the residual, as in
`etid.estimators.output_error.prediction`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from etid.circuits.impedance import AbstractImpedance, realise
from etid.estimators.output_error.information import Slopes, bin_weights, noise_power, padded_size
from etid.estimators.output_error.prediction import (
    Change,
    Records,
    impulse,
    impulse_response,
    predict,
    residual_variance,
)
from etid.estimators.sandwich import Linear
from etid.estimators.score_tests.other_circuit import Score, relaxations, scores
from etid.estimators.unknowns import Nuisance
from etid.results.driver import SourceImpedance
from etid.results.feed import CurrentSource
from etid.signals.filtering import StateSpace, hold
from etid.signals.transfer import as_complex
from etid.solvers.matrices import inverse

# [Hz] Faster relaxations resemble delays and the fast poles of the driver. At 40 dB these poles are
# more uncertain than a linear distribution allows: one of three damp skins had z = 13 at 140 kHz.
HIGHEST = 5e3
PASSED = 0.5  # part of the power that the interpolation must pass
BESIDE = 8  # bins on either side over which the power of V_th is averaged


def relaxed(
    records: Records,
    source: SourceImpedance | CurrentSource,
    impedance: AbstractImpedance,
    nuisance: Nuisance,
) -> Change:
    """Derivatives with respect to one more relaxation, for each time constant.

    Args:
        records: One recording.
        source: Z_th, or the source of a measured current.
        impedance: The load.
        nuisance: Other unknowns of the recording.
    """
    rate = records.sample_rate
    corner, level = relaxations(impedance, rate / records.intervals, jnp.asarray(HIGHEST))
    load, count = impedance.in_time(rate, records.hold.shape[0]), corner.size
    load = load if isinstance(load, StateSpace) else realise(load, rate)
    A = jax.scipy.linalg.block_diag(load.A, -jnp.diag(corner))
    B = jnp.concatenate([load.B, corner[:, None]])
    state = jnp.concatenate([nuisance.state, jnp.zeros(count)])
    nuisance = dataclasses.replace(nuisance, state=state)

    def simulated(
        epsilon: Float[Array, " change"],
    ) -> tuple[Float[Array, " interval"], Float[Array, " lag"]]:
        C = jnp.concatenate([load.C, epsilon * level])
        system = hold(source.connected(StateSpace(A, B, C, load.D)), rate)
        return predict(system, records, nuisance), impulse_response(system)

    return Change(*jax.jacfwd(simulated)(jnp.zeros(count)))


def _smooth(power: Float[Array, " bin"]) -> Float[Array, " bin"]:
    """Means over neighbouring bins."""
    bins = np.arange(power.size)
    first, last = np.maximum(bins - BESIDE, 0), np.minimum(bins + BESIDE + 1, power.size)
    total = jnp.concatenate([jnp.zeros(1), jnp.cumsum(power)])
    return (total[last] - total[first]) / (last - first).astype(float)


def score(
    records: Records,
    change: Change,
    at: Slopes,
    source_cov: Float[Array, "m m"],
    first: int,
    rest: Float[Array, " q"],
    precision: Float[Array, " q"],
    elements: int,
) -> Score:
    """Score of each relaxation.

    Args:
        records: One recording.
        change: Derivatives with respect to the relaxations.
        at: Derivatives with respect to the parameters.
        source_cov: Covariance of the parameters of the source.
        first: Index of the first parameter of the source.
        rest: Gradient of the priors of the other parameters.
        precision: Precision of these priors.
        elements: Number of elements; their logarithms are the first parameters.
    """
    # Parameters of the source in standard deviations.
    values, vectors = jnp.linalg.eigh(source_cov)
    root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]
    last = first + root.shape[0]

    def by_z(slope: Float[Array, "row q"]) -> Float[Array, "row q"]:
        return jnp.concatenate(
            [slope[:, :first], slope[:, first:last] @ root, slope[:, last:]], axis=1
        )

    known = jnp.zeros_like(precision).at[first:last].set(1.0) + precision
    # In volts; the scaled residual is in standard deviations.
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
    # A Wiener filter removes the noise of V_th from the slopes: it would count as information. The
    # slopes of initial state and offset have no noise. They come before the delay, which is last.
    v_th = _smooth(jnp.abs(jnp.fft.rfft(records.hold[:, 0] * records.used, size)) ** 2)
    share = jnp.maximum(1 - records.sigma_th**2 * passed * records.intervals / v_th, 0.0)
    count = change.v_out.shape[1]
    noisy = np.arange(count + precision.size) < count + last
    noisy[-1] = True
    rows = rows * as_complex(jnp.where(noisy[None, :], share[:, None], 1.0))

    def terms(spectrum: Complex[Array, "frequency ..."]) -> Float[Array, "... part"]:
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
        # A parameter that the record does not determine, such as an initial state, has no effect.
        inverse(linear.curvature().expected, drop=True),
        slice(elements),
    )
