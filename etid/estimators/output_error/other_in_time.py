"""Score tests of a fit in time whether a load is another circuit than the fitted one.

Like `etid.likelihood.scores`, they test for one more relaxation,
ΔZ = ε |Z(j/τ)| / (1 + sτ). In time this is one more state of the load. The same simulation gives
the slope of the predicted voltage with respect to ε.

The residual is coloured, because G filters the noise of V_th. The residual and the slopes are
therefore transformed to frequencies. There the noise is independent and has the power

    P(θ) = σ_out² |K|² + σ_th² |G|²,

by whose root √P they are divided. The slopes need V_th without noise. The best estimate from both
records is V_th − σ_th² G* r / P, where r is the residual; its noise does not depend on r.

Behind a measured current the relaxations reach to the end of the band: one more pole in either
channel, or a capacitance parallel to the load, is a fast relaxation, once delay and elements are
fitted. Their scores have 0.85 to 1.0 of the standard deviations that the best test of each of these
faults has.

Three more changes behind a measured current are not linear: two faults of a record and one of the
load, to first order in 1/U, where U is a voltage or current.

- The current amplifier compresses its peaks: it shows i (1 − |i|/U), and V_out lacks Z_L |i| i / U.
- The voltage amplifier compresses its peaks: it shows v (1 − |v|/U).
- A resistance falls with its current. Like on harmonics
  (`etid.likelihood.scores`), it adds −|u| u / U to the voltage u of the
  relaxations, filtered by them: they are the load without its series resistance.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from etid.circuits.directions import SEEN, relaxations
from etid.circuits.impedance import AbstractImpedance, realise
from etid.estimators.output_error.information import Slopes, bin_weights, noise_power, padded_size
from etid.estimators.output_error.prediction import (
    IMPULSE,
    Change,
    Records,
    impulse,
    impulse_response,
    measured_impulse,
    predict,
    residual_variance,
)
from etid.estimators.unknowns import Nuisance
from etid.likelihood.scores import Linear, Scores, smooth
from etid.results.driver import SourceImpedance
from etid.results.feed import CurrentSource
from etid.signals.filtering import CUTOFF, StateSpace, hold, simulate
from etid.signals.transfer import as_complex, frequency_variable
from etid.solvers.matrices import inverse

# [Hz] Faster relaxations resemble delays and the fast poles of the driver. At 40 dB these poles are
# more uncertain than a linear distribution allows: one of three damp skins had z = 13 at 140 kHz.
HIGHEST = 5e3
SHIFTED = 2.0  # standard errors by which a change that counts moves an element
# Effective value of a change that counts, relative to the signal. The errors of the interpolation
# and of the ladder of a constant phase look like a change in part: at 80 dB, |z| > 3.9 refused 6 of
# 640 undisturbed pulses, and a ladder had z up to 5.
EXACT = 2e-5
PASSED = 0.5  # part of the power that the interpolation must pass
BESIDE = 8  # bins on either side over which the power of V_th is averaged


def _in_time(records: Records, impedance: AbstractImpedance) -> StateSpace:
    """The load in continuous time."""
    load = impedance.in_time(records.sample_rate, records.hold.shape[0])
    return load if isinstance(load, StateSpace) else realise(load, records.sample_rate)


def relaxed(
    records: Records,
    source: SourceImpedance | CurrentSource,
    impedance: AbstractImpedance,
    nuisance: Nuisance,
) -> Change:
    """Derivatives with respect to one more relaxation, for each time constant."""
    rate, load = records.sample_rate, _in_time(records, impedance)
    highest = CUTOFF * rate if isinstance(source, CurrentSource) else jnp.asarray(HIGHEST)
    band = jnp.stack([rate / records.intervals, highest])
    corner, level = relaxations(lambda f: impedance(frequency_variable(f)), band[:1], band[1:])
    corner, count = 2 * np.pi * corner, corner.size
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


def _usable(k: Complex[Array, " bin"]) -> Bool[Array, " bin"]:
    """Frequencies that the interpolation, whose response this is, lets pass."""
    return jnp.abs(k) ** 2 > PASSED


def _shared_noise(records: Records, at: Slopes) -> Complex[Array, " bin"]:
    """Estimate of the noise of V_th, σ_th² G* r / P, where the interpolation passes it [V].

    It is the part of the noise that the residual shows. The rest does not depend on the residual.
    """
    rows = at.residual.shape[0]
    size, volts = padded_size(rows), jnp.sqrt(residual_variance(records, at.h))
    power, h = noise_power(records, at.h, size), jnp.fft.rfft(at.h, size)
    of_th = jnp.where(
        _usable(jnp.fft.rfft(impulse()[:, 0], size)), records.sigma_th**2 / power, 0.0
    )
    return jnp.fft.rfft(at.residual * volts, size) * jnp.conj(h) * as_complex(of_th)


def _smooth(power: Float[Array, " bin"]) -> Float[Array, " bin"]:
    """Means over neighbouring bins."""
    bins = np.arange(power.size)
    first, last = np.maximum(bins - BESIDE, 0), np.minimum(bins + BESIDE + 1, power.size)
    total = jnp.concatenate([jnp.zeros(1), jnp.cumsum(power)])
    return (total[last] - total[first]) / (last - first).astype(float)


def bends(records: Records, impedance: AbstractImpedance, nuisance: Nuisance, at: Slopes) -> Change:
    """Derivatives of the predicted voltage with respect to the three changes.

    The signs are those of the predicted minus the measured voltage: a compressed voltage and a
    falling resistance have a positive size, a compressed current a negative one.

    The last is a resistance that falls. Their effect on the noise is not counted.
    """
    load = _in_time(records, impedance)
    system, series = hold(load, records.sample_rate), load.D[0]
    # The square of noise has a mean. So the signals are the best estimates from both records,
    # whose noise does not depend on the residual.
    known = _shared_noise(records, at)

    def bent(
        signal: Float[Array, " interval"], response: Float[Array, " lag"]
    ) -> Float[Array, " interval"]:
        """|v| v of a signal v, which has this response to the noise."""
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


def score(
    records: Records,
    change: Change,
    at: Slopes,
    source_cov: Float[Array, "m m"],
    first: int,
    rest: Float[Array, " q"],
    precision: Float[Array, " q"],
    elements: int,
) -> Scores:
    """Score of each change.

    The elements are the first parameters, and the source, of which `source_cov` is the covariance,
    begins at `first`. `rest` is the gradient of the priors of the others, and `precision` that of
    these priors.
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
    k, power = jnp.fft.rfft(impulse()[:, 0], size), noise_power(records, at.h, size)
    usable = _usable(k)
    scale = jnp.where(usable, jnp.sqrt(jnp.asarray(bin_weights(size)) / power), 0.0)
    residual, of_th = jnp.fft.rfft(at.residual * volts, size), _shared_noise(records, at)
    # The slopes with the best estimate of V_th. The slope of the delay, which is the last one,
    # contains V_out: it gets G times this estimate.
    noise = jnp.fft.rfft(of_lag, size, axis=0) * of_th[:, None]
    of_out = jnp.where(usable, records.sigma_out**2 / power, 0.0)
    by_delay = jnp.fft.rfft(measured_impulse()[:, 1], size) * jnp.conj(k) * as_complex(of_out)
    noise = noise.at[:, -1].set(-by_delay * residual)
    rows = jnp.fft.rfft(of_time, size, axis=0) - noise
    # A Wiener filter removes the noise of this estimate from the slopes: it would count as
    # information. The slopes of initial state and offset have no noise.
    v_th = jnp.fft.rfft(records.hold[:, 0] * records.used, size) - k * of_th
    left = records.sigma_th**2 * of_out * jnp.abs(k) ** 4 * records.intervals
    share = jnp.where(usable, jnp.maximum(1 - left / _smooth(jnp.abs(v_th) ** 2), 0.0), 0.0)
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
    priors = jnp.diag(known)
    # A parameter that the record does not determine, such as an initial state, has no effect.
    covariance = inverse(by_parameter @ by_parameter.T + priors, drop=True)
    linear = Linear(by_parameter, ones, ones, terms(residual), rest, priors, covariance)
    return smooth(linear, by_change, elements)


class Shown(NamedTuple):
    """What the scores of a fit show.

    Attributes:
        other: Whether the load is another circuit, or a record has a fault that looks like one.
        falls: Whether a resistance that falls with its current explains the residual best.
    """

    other: Bool[Array, ""]
    falls: Bool[Array, ""]

    @classmethod
    def behind_current(
        cls,
        found: Scores,
        errors: Float[Array, " element"],
        chi2: Float[Array, ""],
        least: Float[Array, ""] | float,
    ) -> "Shown":
        """Judge the scores behind a measured current; the last one is a resistance that falls.

        `errors` are those of the logarithms of the elements. The noise of a record is known to a
        few per cent only, which χ² shows; the error of the prediction may have the |z| `least`.
        """
        z = jnp.nan_to_num(found.z) / jnp.sqrt(jnp.maximum(chi2, 1.0))
        shift = jnp.max(jnp.abs(found.size[:, None] * found.slope) / errors[None, :], axis=1)
        seen = (jnp.abs(z) > jnp.maximum(SEEN, least)) & (shift > SHIFTED)
        return cls(jnp.any(seen), seen[-1] & (z[-1] >= jnp.max(jnp.abs(z))))
